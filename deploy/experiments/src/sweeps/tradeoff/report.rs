//! Writes data, figures and page of a trade-off. The text of the page is the template `tradeoff.md.j2`.

use std::collections::{BTreeMap, BTreeSet};

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_launch::metrics::rounded;
use driml_machine::error::Usage;
use minijinja::{Value, context};
use serde::Serialize;

use super::{
    measured,
    menu::Common,
    results::{
        FRAMES_PER_SECOND, GREEDY, MEASURES, Measure, PointResult, Results, Row, SeedResult,
        TRAINING,
    },
};
use crate::{
    cache::Session,
    plot::{Band, combine_seeds},
    stats::{Interval, Spread, difference, false_positive_rate, mean},
};

/// The columns of the benchmark and of the errors against the reference.
const MEASURED: &str = "update_seconds,rows_gain,act_seconds,act_gain,weights_bytes,frame_bytes,loss_error,gradient_error,gradient_angle,\
    q_rms_error,q_max_error,same_action_learner,same_action_actor,actor_q_rms_error";
/// The columns of the comparison of C51 and agents with DIM at equal frames and equal time.
const EQUAL_TIME: &str = "agent,base,equal_seconds,\
    minus_base_at_equal_frames,minus_base_at_equal_frames_low,minus_base_at_equal_frames_high,\
    minus_base_at_equal_time,minus_base_at_equal_time_low,minus_base_at_equal_time_high";
const DIM: &str = "DIM";

pub(super) fn write_report(session: Session, results: &Results) -> anyhow::Result<()> {
    let of_dim = results.level_rows().filter(|row| row.dial.name == DIM);
    let equal: Vec<_> = of_dim.filter_map(|row| EqualTime::from_row(&row)).collect();
    write_runs(&session, results)?;
    write_levels(&session, results)?;
    session.write_csv("equal_time", EQUAL_TIME, equal.iter().map(EqualTime::cells))?;
    for (stem, returns, name) in [
        ("pareto", GREEDY, "greedy"),
        ("pareto_training", TRAINING, "training"),
    ] {
        session.save_figure(stem, &pareto_figure(results, returns, name))?;
    }
    session.save_figure("wall", &wall_figure(results))?;
    let values = page_values(results, &equal)?;
    session.write_page(include_str!("../tradeoff.md.j2"), values)
}

fn write_runs(session: &Session, results: &Results) -> anyhow::Result<()> {
    let names = MEASURES.map(|it| it.name).join(",");
    let columns = format!("point,agent,seed,updates,updates_per_second,weights_sha256,{names}");
    let all = results.points.iter();
    let all = all.flat_map(|(key, point)| point.seeds.iter().map(move |it| (key, it)));
    let rows = all.map(|(key, it)| {
        let summary = &it.run.summary;
        let speed = (summary.updates, rounded(summary.updates_per_second));
        let measured = MEASURES.map(|measure| (measure.get)(it).map(rounded));
        let of = (key, &summary.agent, it.seed);
        (of, speed, &summary.weights_sha256, measured)
    });
    session.write_csv("runs", &columns, rows)
}

fn write_levels(session: &Session, results: &Results) -> anyhow::Result<()> {
    let mut columns = format!("dial,level,base,seeds,{MEASURED}");
    for name in MEASURES.map(|it| it.name) {
        columns += &format!(",{name},{name}_low,{name}_high");
        columns += &format!(",{name}_minus_base,{name}_minus_base_low,{name}_minus_base_high");
    }
    let rows = results.rows_by_dial().flatten().map(|row| {
        let measured = |name: &str| row.result.measured.get(name).copied().map(rounded);
        let of_runs = MEASURES.map(|measure| {
            let difference = row.difference(measure).filter(|_| !row.is_base);
            [row.result.mean(measure), difference].map(interval_cells)
        });
        (
            (&row.dial.name, row.name, &row.dial.base),
            row.result.seeds.len(),
            MEASURED.split(',').map(measured).collect::<Vec<_>>(),
            of_runs,
        )
    });
    session.write_csv("levels", &columns, rows)
}

/// Returns the cells for mean, low end and high end; missing numbers are empty.
fn interval_cells(interval: Option<Interval>) -> [Option<f64>; 3] {
    let (low, high) = interval.and_then(|it| it.ends).unzip();
    [interval.map(|it| it.mean), low, high].map(|it| it.map(rounded))
}

/// The training returns of C51 (the base) and an agent with DIM (the level). Arrays are [base, level], with a value for each run.
#[derive(Serialize)]
struct EqualTime {
    agent: String,
    base: String,
    /// The mean seconds after which the runs of the faster of the two end.
    seconds: f64,
    end: [Vec<f64>; 2],
    then: [Vec<f64>; 2],
}

impl EqualTime {
    /// Compares training returns of finished runs, because the agent at an earlier time was not kept. The times of resumed runs are left
    /// out. `None` if a side has no return at `seconds`.
    fn from_row(row: &Row<'_>) -> Option<Self> {
        let sides = [row.base, row.result];
        let [base, level] = sides.map(|point| {
            let ends = point.uninterrupted().filter_map(|it| it.curve.last());
            mean(&ends.map(|end| end.0).collect::<Vec<_>>())
        });
        let seconds = base?.min(level?);
        let at_seconds = |it: &SeedResult| value_at(&it.curve, seconds);
        let comparison = Self {
            agent: row.point.agent.clone(),
            base: row.dial.agent.clone(),
            seconds,
            end: sides.map(|point| point.values(TRAINING)),
            then: sides.map(|it| it.uninterrupted().filter_map(at_seconds).collect()),
        };
        (!comparison.then.iter().any(Vec::is_empty)).then_some(comparison)
    }

    fn cells(&self) -> impl Serialize {
        let returns = [&self.end, &self.then];
        let minus_base = returns.map(|[base, level]| interval_cells(difference(base, level)));
        (&self.agent, &self.base, rounded(self.seconds), minus_base)
    }
}

fn value_at(curve: &[(f64, f64)], seconds: f64) -> Option<f64> {
    let before = curve.iter().take_while(|(x, _)| *x <= seconds).last();
    before.map(|(_, value)| *value)
}

fn page_values(results: &Results, equal: &[EqualTime]) -> anyhow::Result<Value> {
    let common = &results.common;
    let dials = results.rows_by_dial().map(|rows| {
        let all = rows.iter().map(|row| page_row(row, common));
        let all = all.collect::<Result<Vec<_>, Usage>>()?;
        Ok(context! { dial => rows[0].dial, base => all[0], levels => all[1..] })
    });
    let (judged, false_positives) = false_positives(results);
    Ok(context! {
        settings => common,
        dials => dials.collect::<Result<Vec<_>, Usage>>()?,
        equal,
        random => results.random,
        seeds => seed_counts(results, false),
        base_seeds => seed_counts(results, true),
        judged,
        by_chance => false_positives,
        left_out => results.left_out,
        command => results.commands.join("`, then `"),
    })
}

/// Converts a row for the template: the measured numbers, and for each measure the numbers of the runs.
fn page_row(row: &Row<'_>, common: &Common) -> Result<Value, Usage> {
    let measured = |name: &'static str| (name, Value::from(row.result.measured.get(name).copied()));
    let of_runs = MEASURES.map(|it| (it.name, Value::from_serialize(row.result.values(it))));
    let named: Value = MEASURED.split(',').map(measured).chain(of_runs).collect();
    let (agent, frames_gain) = (&row.point.agent, row.frames_gain());
    let (rows, states) = measured::sizes(&common.config(row.point)?);
    Ok(context! { level => row.name, agent, rows, states, frames_gain, ..named })
}

/// Returns the numbers of seeds that bases have, or that other points have, in increasing order.
fn seed_counts(results: &Results, of_bases: bool) -> BTreeSet<usize> {
    let bases: BTreeSet<&str> = results.levels.iter().map(|of| &*of.base.key).collect();
    let all = results.points.iter();
    let some = all.filter(|(key, _)| bases.contains(key.as_str()) == of_bases);
    some.map(|(_, point)| point.seeds.len()).collect()
}

/// Returns how many differences of returns the page judges, and how many of them would be called better or worse by chance if no level
/// changed anything and returns were normally distributed.
fn false_positives(results: &Results) -> (usize, f64) {
    let mut known = BTreeMap::new();
    let each = results.level_rows().flat_map(|row| {
        let points = [row.base, row.result];
        [GREEDY, TRAINING].map(|it| points.map(|point| point.values(it).len()))
    });
    let judged = each.filter(|counts| counts.iter().all(|&it| it > 1));
    let chances = judged.map(|counts| {
        let known = known.entry(counts);
        *known.or_insert_with(|| false_positive_rate(counts[0], counts[1]))
    });
    chances.fold((0, 0.0), |(count, sum), chance| (count + 1, sum + chance))
}

const PANEL_COLUMNS: usize = 3;
const PANEL_SIZE: (f64, f64) = (330.0, 250.0);

/// Draws return against frames per second: a panel for each dial with its base, all with the same axes. A dashed line joins the Pareto
/// front of all dials. `returns` selects the return, and `name` is its name.
fn pareto_figure(results: &Results, returns: Measure, name: &str) -> Figure {
    let all = Spread::of(results.points.values().flat_map(|it| it.values(returns)));
    let (least, greatest) = all.map_or((0.0, 0.0), |it| (it.min, it.max));
    // Returns the point of a result and the bar of its interval.
    let place = |point: &PointResult| {
        let (value, speed) = (point.mean(returns)?, point.mean(FRAMES_PER_SECOND)?.mean);
        let (low, high) = value.ends.unwrap_or((value.mean, value.mean));
        // Few seeds may give an interval that is far wider than the range of all returns.
        let bar = (speed, low.max(least), high.min(greatest));
        Some(((speed, value.mean), bar))
    };
    let placed = results.points.values().filter_map(place);
    let (placed, bars): (Vec<_>, Vec<_>) = placed.unzip();
    let front = front(&placed);
    let speeds: Vec<f64> = placed.iter().map(|&(speed, _)| speed).collect();
    let values = bars.iter().flat_map(|&(_, low, high)| [low, high]);
    let values: Vec<f64> = values.collect();
    let label = format!("{name} return");
    let panels = results.rows_by_dial().map(|rows| {
        let line = Series::line("", 0, front.clone());
        let mut series = vec![line.with_colour(GREY).with_mark(Mark::Dashed)];
        series.extend(rows.iter().enumerate().filter_map(|(index, row)| {
            let (point, bar) = place(row.result)?;
            let point = Series::line(row.name, index, vec![point]);
            Some(point.with_band(vec![bar]).with_mark(Mark::Bars))
        }));
        let (x, y) = (Axis::linear("frames/s"), Axis::linear(&label));
        let (x, y) = (x.covering(&speeds), y.covering(&values));
        Panel::Chart(Chart::new(&rows[0].dial.name, x, y, series))
    });
    Figure {
        title: format!("{}: {label} against speed", results.common.env),
        notes: vec![
            format!(
                "Return ({name}), mean over seeds, and frames a second of whole runs; to the upper right is better."
            ),
            "Bars: 95% intervals, cut at the least and the greatest return of any run.".into(),
            "The dashed line is the same in all: it joins the levels of all dials than which no other is better in both.".into(),
        ],
        columns: PANEL_COLUMNS,
        panel_size: PANEL_SIZE,
        panels: panels.collect(),
    }
}

/// Returns speed and value of the Pareto front, the slowest point first: no other point is faster and no worse, or better and no slower.
fn front(placed: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let is_beaten = |it: &(f64, f64)| {
        let mut others = placed.iter().filter(|other| *other != it);
        others.any(|other| other.0 >= it.0 && other.1 >= it.1)
    };
    let mut front = placed.to_vec();
    front.retain(|it| !is_beaten(it));
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    front
}

/// Draws the training return over seconds, with a panel for each dial and its base.
fn wall_figure(results: &Results) -> Figure {
    let panels = results.rows_by_dial().map(|rows| {
        let series = rows.iter().enumerate().map(|(index, row)| {
            let each = row.result.uninterrupted().map(|it| it.curve.clone());
            combine_seeds(&each.collect::<Vec<_>>(), Band::Range).series(row.name, index)
        });
        let (x, y) = (Axis::linear("seconds"), Axis::linear("mean return"));
        Panel::Chart(Chart::new(&rows[0].dial.name, x, y, series.collect()))
    });
    Figure {
        title: format!("{}: return against wall-clock time", results.common.env),
        notes: vec![
            "Training return, mean of the last 100 episodes; mean and range over seeds. Every run has the same number of frames."
                .into(),
        ],
        columns: PANEL_COLUMNS,
        panel_size: PANEL_SIZE,
        panels: panels.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_read_at_a_time() {
        let curve = [(1.0, 0.5), (2.0, 0.6), (4.0, 0.9)];
        let found = [3.0, 0.5, 9.0].map(|seconds| value_at(&curve, seconds));
        assert_eq!(found, [Some(0.6), None, Some(0.9)]);
    }
    #[test]
    fn the_front_has_what_no_other_beats() {
        let (slow_and_good, slow_and_bad) = ((1.0, 9.0), (1.0, 2.0));
        let (between, beaten, fast_and_bad) = ((3.0, 5.0), (2.0, 4.9), (5.0, 3.0));
        let all = [slow_and_good, slow_and_bad, fast_and_bad, between, beaten];
        assert_eq!(front(&all), [slow_and_good, between, fast_and_bad]);
    }
}
