//! C51 beside the agents with DIM in training return, at equal frames and at equal wall-clock time.
//! Runs that ended alone are compared; the time is that at which those of the faster agent were done.

use super::{
    cells::{signed, verdict},
    results::{PointResult, Results},
};
use crate::{
    page::{Table, cell},
    plot::{Over, Run},
    stats::{difference, interval},
};

/// C51 beside an agent with DIM in training return, as the data has it.
pub(super) const EQUAL_TIME: [&str; 9] = [
    "agent",
    "base",
    "equal_seconds",
    "minus_base_at_equal_frames",
    "minus_base_at_equal_frames_low",
    "minus_base_at_equal_frames_high",
    "minus_base_at_equal_time",
    "minus_base_at_equal_time_low",
    "minus_base_at_equal_time_high",
];
/// The dial that turns DIM on.
const DIM: &str = "DIM";

/// C51 beside an agent with DIM, seed by seed.
pub(super) struct EqualTime {
    agent: String,
    /// For a list of what was got.
    pub(super) in_words: String,
    row: Vec<String>,
    /// The cells of [`EQUAL_TIME`].
    pub(super) cells: Vec<String>,
}

/// C51 and the agents with DIM at equal frames and at equal wall-clock time: when runs of the faster of the two are done.
pub(super) fn equal_time(results: &Results) -> anyhow::Result<Vec<EqualTime>> {
    let mut all = Vec::new();
    for of in results.levels.iter().filter(|of| of.dial.name == DIM) {
        let base = training_curves(&results.points[&of.base.key])?;
        let level = training_curves(&results.points[&of.point.key])?;
        let ends = |curves: &[Vec<(f64, f64)>], of: fn(&(f64, f64)) -> f64| -> Vec<f64> {
            curves
                .iter()
                .filter_map(|curve| curve.last().map(of))
                .collect()
        };
        let means = [&base, &level].map(|it| interval(&ends(it, |end| end.0)));
        let [Some(one), Some(other)] = means else {
            continue;
        };
        let seconds = one.mean.min(other.mean);
        let then = |curves: &[Vec<(f64, f64)>]| -> Vec<f64> {
            curves
                .iter()
                .filter_map(|curve| at(curve, seconds))
                .collect()
        };
        let (of_base, of_level) = (then(&base), then(&level));
        let frames = difference(&ends(&base, |end| end.1), &ends(&level, |end| end.1));
        let time = difference(&of_base, &of_level);
        let (Some(frames), Some(time)) = (frames, time) else {
            continue;
        };
        let mean = |values: &[f64]| cell(interval(values), |it| it.to_string());
        let agent = of.point.agent.clone();
        let mut cells = vec![
            agent.clone(),
            of.base.agent.clone(),
            format!("{seconds:.3}"),
        ];
        cells.extend(
            [frames, time]
                .into_iter()
                .flat_map(|it| it.interval.cells()),
        );
        all.push(EqualTime {
            in_words: format!(
                "{agent} minus {}, training return: {} at equal frames{}; {} at equal wall-clock time ({seconds:.0} s){}",
                of.base.agent,
                signed(&frames),
                verdict(&frames),
                signed(&time),
                verdict(&time),
            ),
            row: vec![
                agent.clone(),
                signed(&frames),
                format!("{seconds:.0}"),
                mean(&of_base),
                mean(&of_level),
                signed(&time),
            ],
            agent,
            cells,
        });
    }
    Ok(all)
}

/// Training return over seconds, of each run.
fn training_curves(point: &PointResult) -> anyhow::Result<Vec<Vec<(f64, f64)>>> {
    let each = point
        .seeds
        .iter()
        .map(|it| Ok(Run::read(&it.ran.folder)?.values_over(Over::Seconds, "mean_return")?));
    each.collect()
}

/// The value at a time: the last one before it.
fn at(curve: &[(f64, f64)], seconds: f64) -> Option<f64> {
    let before = curve.iter().take_while(|(x, _)| *x <= seconds).last();
    before.map(|(_, value)| *value)
}

/// The table of `all`, with what it is of.
pub(super) fn dim_table(all: &[EqualTime]) -> String {
    let header = [
        "agent",
        "minus C51 at equal frames",
        "equal time [s]",
        "C51 then",
        "agent then",
        "minus C51 at equal time",
    ];
    let names: Vec<&str> = all.iter().map(|it| it.agent.as_str()).collect();
    let rows = all.iter().map(|it| it.row.clone());
    format!(
        "C51 beside {} in training return, at equal frames and at equal wall-clock time.\n\n{}",
        names.join(" and "),
        Table::new(&header, rows)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_read_at_a_time() {
        let curve = [(1.0, 0.5), (2.0, 0.6), (4.0, 0.9)];
        assert_eq!(at(&curve, 3.0), Some(0.6));
        assert_eq!(at(&curve, 0.5), None);
        assert_eq!(at(&curve, 9.0), Some(0.9));
    }
}
