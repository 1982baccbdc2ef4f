//! Data, figures and page of a trade-off. What the page says of the numbers is its template, `tradeoff.md`.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use serde_json::{Map, Value, json};

use super::{
    dials::{LevelOf, Point},
    exactness, figures,
    results::{GREEDY, MEASURES, PointResult, Results, TRAINING},
};
use crate::{
    cache::Session,
    page::{Page, Table, Values, interval_cells, number},
    stats::{apart_by_chance, difference, interval},
};

/// What the bench and the errors against the reference give, as the data has it, and its decimals; none for `1.234e-5`.
const MEASURED: [(&str, Option<usize>); 14] = [
    ("update_seconds", Some(6)),
    ("rows_gain", Some(4)),
    ("act_seconds", Some(9)),
    ("act_gain", Some(4)),
    ("weights_bytes", Some(0)),
    ("frame_bytes", Some(0)),
    ("loss_error", None),
    ("gradient_error", None),
    ("gradient_angle", None),
    ("q_rms_error", None),
    ("q_max_error", None),
    ("same_action_learner", None),
    ("same_action_actor", None),
    ("actor_q_rms_error", None),
];
/// C51 beside an agent with DIM in training return, as the data has it.
const EQUAL_TIME: &str = "agent,base,equal_seconds,\
    minus_base_at_equal_frames,minus_base_at_equal_frames_low,minus_base_at_equal_frames_high,\
    minus_base_at_equal_time,minus_base_at_equal_time_low,minus_base_at_equal_time_high";
/// The dial that turns DIM on.
const DIM: &str = "DIM";

/// Writes them all.
pub(super) fn report(session: Session, results: &Results) -> anyhow::Result<()> {
    let equal = equal_time(results)?;
    session.csv("runs", &runs(results))?;
    session.csv("levels", &levels(results))?;
    session.csv(
        "equal_time",
        &Table::of(EQUAL_TIME, equal.iter().map(EqualTime::cells)),
    )?;
    for (stem, returns, name) in [
        ("pareto", GREEDY, "greedy"),
        ("pareto_training", TRAINING, "training"),
    ] {
        session.figure(stem, &figures::pareto(results, returns, name))?;
    }
    session.figure("wall", &figures::wall(results)?)?;
    session.finish(&page(results, &equal)?)
}

fn runs(results: &Results) -> Table {
    let names = MEASURES.map(|it| it.name).join(",");
    let columns = format!("point,agent,seed,updates,updates_per_second,weights_sha256,{names}");
    let all = results.points.iter();
    let all = all.flat_map(|(key, point)| point.seeds.iter().map(move |it| (key, it)));
    let rows = all.map(|(key, it)| {
        let summary = &it.ran.summary;
        let head = vec![
            key.clone(),
            summary.agent.clone(),
            it.seed.to_string(),
            summary.updates.to_string(),
            format!("{:.2}", summary.updates_per_second),
            summary.weights_sha256.clone(),
        ];
        [
            head,
            MEASURES.map(|measure| number((measure.of)(it), 4)).into(),
        ]
        .concat()
    });
    Table::of(&columns, rows)
}

fn levels(results: &Results) -> Table {
    let mut columns = "dial,level,base,seeds".to_owned();
    for (name, _) in MEASURED {
        columns += &format!(",{name}");
    }
    for name in MEASURES.map(|it| it.name) {
        columns += &format!(",{name},{name}_low,{name}_high");
        columns += &format!(",{name}_minus_base,{name}_minus_base_low,{name}_minus_base_high");
    }
    let rows = results.by_dial().flat_map(|levels| {
        let base = std::iter::once((&levels[0], true));
        base.chain(levels.iter().map(|of| (of, false)))
    });
    Table::of(
        &columns,
        rows.map(|(of, is_base)| row(results, of, is_base)),
    )
}

/// A level, or the base that it is compared with.
fn row(results: &Results, of: &LevelOf, is_base: bool) -> Vec<String> {
    let (point, level) = match is_base {
        true => (&of.base, &of.dial.base),
        false => (&of.point, &of.level),
    };
    let point: &PointResult = results.at(point);
    let mut row = vec![of.dial.name.clone(), level.clone(), of.dial.base.clone()];
    row.push(point.seeds.len().to_string());
    let measured = point.measured();
    row.extend(MEASURED.map(|(name, decimals)| {
        let value = measured.get(name).and_then(Value::as_f64);
        match decimals {
            Some(decimals) => number(value, decimals),
            None => value.map_or(String::new(), |it| format!("{it:.3e}")),
        }
    }));
    for measure in MEASURES {
        let difference = results.difference(of, measure).filter(|_| !is_base);
        row.extend(interval_cells(point.mean(measure)));
        row.extend(interval_cells(difference.map(|it| it.interval)));
    }
    row
}

/// C51 beside an agent with DIM in training return: when runs of the faster of the two are done, and at the ends of all.
#[derive(Serialize)]
struct EqualTime {
    agent: String,
    base: String,
    seconds: f64,
    base_end: Vec<f64>,
    level_end: Vec<f64>,
    base_then: Vec<f64>,
    level_then: Vec<f64>,
}

impl EqualTime {
    /// As [`EQUAL_TIME`] has it.
    fn cells(&self) -> Vec<String> {
        let frames = difference(&self.base_end, &self.level_end);
        let time = difference(&self.base_then, &self.level_then);
        let head = [
            self.agent.clone(),
            self.base.clone(),
            format!("{:.3}", self.seconds),
        ];
        let both = [frames, time].map(|it| interval_cells(it.map(|it| it.interval)));
        head.into_iter().chain(both.into_iter().flatten()).collect()
    }
}

/// Runs that ended alone are compared, in training return: the agent after part of a run was not kept.
fn equal_time(results: &Results) -> anyhow::Result<Vec<EqualTime>> {
    let mut all = Vec::new();
    for of in results.levels.iter().filter(|of| of.dial.name == DIM) {
        let base = results.at(&of.base).training_curves()?;
        let level = results.at(&of.point).training_curves()?;
        let ends = |curves: &[Vec<(f64, f64)>]| -> (Vec<f64>, Vec<f64>) {
            curves
                .iter()
                .filter_map(|curve| curve.last())
                .copied()
                .unzip()
        };
        let ((base_seconds, base_end), (level_seconds, level_end)) = (ends(&base), ends(&level));
        let means = [interval(&base_seconds), interval(&level_seconds)];
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
        let (base_then, level_then) = (then(&base), then(&level));
        if !base_then.is_empty() && !level_then.is_empty() {
            all.push(EqualTime {
                agent: of.point.agent.clone(),
                base: of.base.agent.clone(),
                seconds,
                base_end,
                level_end,
                base_then,
                level_then,
            });
        }
    }
    Ok(all)
}

/// The value at a time: the last one before it.
fn at(curve: &[(f64, f64)], seconds: f64) -> Option<f64> {
    let before = curve.iter().take_while(|(x, _)| *x <= seconds).last();
    before.map(|(_, value)| *value)
}

/// The page of what was run.
fn page(results: &Results, equal: &[EqualTime]) -> anyhow::Result<Page> {
    let common = &results.settings.common;
    let sizes = exactness::Sizes::of(&common.config(&results.levels[0].base)?);
    let dials = results.by_dial().map(|levels| {
        let of = &levels[0];
        let each = levels.iter().map(|of| {
            let mut row = page_row(results, &of.point, &of.level);
            row.insert("frames_gain".into(), json!(results.frames_gain(of)));
            row
        });
        json!({
            "dial": of.dial,
            "base": page_row(results, &of.base, &of.dial.base),
            "levels": each.collect::<Vec<_>>(),
        })
    });
    let by_key: BTreeMap<_, _> = results.levels.iter().map(|of| (&of.base.key, of)).collect();
    let bases = by_key.iter().map(|(key, of)| {
        let mut row = page_row(results, &of.base, key);
        let above = difference(&results.random, &results.at(&of.base).values(TRAINING));
        let unsure = above.is_some_and(|it| {
            it.interval.ends.is_some() && !(it.is_apart && it.interval.mean > 0.0)
        });
        row.insert("may_have_learned_nothing".into(), unsure.into());
        row
    });
    let (judged, by_chance) = by_chance(results);
    let mut values = Values::default();
    values
        .set("settings", common)
        .set("dials", dials.collect::<Vec<_>>())
        .set("bases", bases.collect::<Vec<_>>())
        .set("equal", equal)
        .set("random", &results.random)
        .set("seeds", seeds(results))
        .set("judged", judged)
        .set("by_chance", by_chance)
        .set("rows", sizes.rows)
        .set("states", sizes.states)
        .set("missing", &results.missing)
        .set("left_out", &results.left_out);
    let commands = results.commands.join("`, then `");
    let template = include_str!("../tradeoff.md");
    Ok(Page::new(template, values, &commands, results.smoke))
}

/// A point as the template reads it: what was measured, and of each measure the numbers of its runs.
fn page_row(results: &Results, point: &Point, level: &str) -> Map<String, Value> {
    let (result, mut row) = (results.at(point), Map::new());
    row.insert("level".into(), level.into());
    row.insert("agent".into(), point.agent.clone().into());
    let measured = result.measured();
    for (name, _) in MEASURED {
        row.insert(name.into(), json!(measured.get(name)));
    }
    for measure in MEASURES {
        row.insert(measure.name.into(), json!(result.values(measure)));
    }
    row
}

/// How many seeds the intervals are over, in words.
fn seeds(results: &Results) -> String {
    let bases: BTreeSet<&str> = results
        .levels
        .iter()
        .map(|of| of.base.key.as_str())
        .collect();
    let [bases, levels] = [true, false].map(|is_base| {
        let all = results.points.iter();
        let counts = all.filter(|(key, _)| bases.contains(key.as_str()) == is_base);
        let counts: BTreeSet<usize> = counts.map(|(_, point)| point.seeds.len()).collect();
        match (counts.first(), counts.last()) {
            (Some(low), Some(high)) if low == high => low.to_string(),
            (Some(low), Some(high)) => format!("{low} to {high}"),
            _ => "no".to_owned(),
        }
    });
    let seeds = if levels == "1" { "seed" } else { "seeds" };
    format!("{levels} {seeds} of a level and {bases} of a base")
}

/// How many differences of the page's returns are judged, and how many of them would be called better or worse if no level changed
/// anything and returns were normal.
fn by_chance(results: &Results) -> (usize, f64) {
    let mut known = BTreeMap::new();
    let each = results.levels.iter().flat_map(|of| {
        let points = [&of.base, &of.point].map(|it| results.at(it));
        [GREEDY, TRAINING].map(|it| points.map(|point| point.values(it).len()))
    });
    let judged = each.filter(|counts| counts.iter().all(|&it| it > 1));
    let chances = judged.map(|counts| {
        let [base, level] = counts;
        *known
            .entry(counts)
            .or_insert_with(|| apart_by_chance(base, level))
    });
    chances.fold((0, 0.0), |(count, sum), chance| (count + 1, sum + chance))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_read_at_a_time() {
        let curve = [(1.0, 0.5), (2.0, 0.6), (4.0, 0.9)];
        for (seconds, expected) in [(3.0, Some(0.6)), (0.5, None), (9.0, Some(0.9))] {
            assert_eq!(at(&curve, seconds), expected);
        }
    }
}
