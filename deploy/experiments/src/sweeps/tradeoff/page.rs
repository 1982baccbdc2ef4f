//! The page of a trade-off: a row for each level with what it gives and what it costs, and C51 beside DIM at equal frames and at equal time.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::Context;
use driml_machine::units::rough_duration;

use super::{
    cells::{signed, verdict},
    equal_time::{dim_table, equal_time},
    exactness,
    results::{LevelOf, Measure, PointResult, Results},
};
use crate::{
    page::{Page, Table, Values, cell},
    stats::{Interval, Spread, apart_by_chance},
};

/// What the bench gives, as the data has it.
pub(super) const SPEEDS: [&str; 6] = [
    "update_seconds",
    "rows_gain",
    "act_seconds",
    "act_gain",
    "weights_bytes",
    "frame_bytes",
];
/// The errors against the reference, as the data has them.
pub(super) const ERRORS: [&str; 8] = [
    "loss_error",
    "gradient_error",
    "gradient_angle",
    "q_rms_error",
    "q_max_error",
    "same_action_learner",
    "same_action_actor",
    "actor_q_rms_error",
];
/// The cells of [`SPEEDS`].
pub(super) fn speed_cells(point: &PointResult) -> [String; 6] {
    let Some(speed) = &point.speed else {
        return [const { String::new() }; 6];
    };
    [
        format!("{:.6}", speed.update_seconds),
        format!("{:.4}", speed.rows_gain),
        format!("{:.9}", speed.act_seconds),
        format!("{:.4}", speed.act_gain),
        speed.weights_bytes.to_string(),
        speed.frame_bytes.to_string(),
    ]
}

/// The cells of [`ERRORS`].
pub(super) fn error_cells(point: &PointResult) -> [String; 8] {
    let Some(it) = &point.exactness else {
        return [const { String::new() }; 8];
    };
    [
        it.loss,
        it.gradient,
        it.angle,
        it.q_rms,
        it.q_max,
        it.same_learner,
        it.same_actor,
        it.actor_q_rms,
    ]
    .map(|number| format!("{number:.3e}"))
}

/// The page of what was run.
pub(super) fn page(results: &Results) -> anyhow::Result<Page> {
    let common = &results.settings.common;
    let random = Spread::of(results.random.iter().copied());
    let equal = equal_time(results)?;
    let sizes = error_sizes(results)?;
    let (judged, by_chance) = by_chance(results);
    let mut got: Vec<String> = results.levels.iter().map(|of| found(results, of)).collect();
    got.extend(equal.iter().map(|it| it.in_words.clone()));
    let mut values = Values::default();
    values
        .set("env", &common.env)
        .set("preset", &common.preset)
        .set("frames", common.frames)
        .when("has_sets", !common.sets.is_empty())
        .set("sets", common.sets.join(", "))
        .set("load", load(results))
        .items("got", got)
        .when("some_missing", !results.missing.is_empty())
        .set("missing", results.missing.join(", "))
        .set("episodes", common.episodes)
        .set("seeds", seeds(results))
        .when("is_judged", judged > 0)
        .set("judged", judged)
        .set("by_chance", format!("{by_chance:.1}"))
        .set("rows", sizes.rows)
        .set("states", sizes.states)
        .set(
            "random",
            random.map_or("-".into(), |it| format!("{:.2}", it.mean)),
        )
        .set("above_random", above_random(results))
        .set("gains", gains(results))
        .set("rest", rest(results))
        .set("errors", errors(results))
        .set(
            "dim",
            if equal.is_empty() {
                String::new()
            } else {
                dim_table(&equal)
            },
        )
        .when("dim_is_there", !equal.is_empty())
        .items("dials", dials(results))
        .when("some_left_out", !results.left_out.is_empty())
        .set("left_out", results.left_out.join("; "));
    Ok(Page::new(
        include_str!("../tradeoff.md"),
        values,
        &results.commands.join("`, then `"),
        results.smoke,
    ))
}

/// How many seeds the intervals are over, in words.
fn seeds(results: &Results) -> String {
    let counts = |it: Option<(usize, usize)>| match it {
        None => "no".to_owned(),
        Some((low, high)) if low == high => low.to_string(),
        Some((low, high)) => format!("{low} to {high}"),
    };
    let [bases, levels] = results.seeds().map(counts);
    let seeds = if levels == "1" { "seed" } else { "seeds" };
    format!("{levels} {seeds} of a level and {bases} of a base")
}

/// Rows and states of the errors of a base.
fn error_sizes(results: &Results) -> anyhow::Result<exactness::Sizes> {
    let point = results.levels.first().map(|of| &of.base);
    let point = point.context("a page has a level")?;
    Ok(exactness::Sizes::of(
        &results.settings.common.config(point)?,
    ))
}

/// The bases, each once.
fn bases(results: &Results) -> BTreeSet<&str> {
    let all = results.levels.iter();
    all.map(|of| of.base.key.as_str()).collect()
}

/// Whether an agent learns at all here, without which no level can cost anything.
fn above_random(results: &Results) -> String {
    let each = bases(results).into_iter().filter_map(|key| {
        let above = results.above_random(&results.points[key])?;
        let is_above = above.is_apart && above.interval.mean > 0.0;
        let apart = match above.interval.ends {
            Some(_) if !is_above => ": these seeds do not show that it has learned",
            _ => "",
        };
        Some(format!("{key} {}{apart}", signed(&above)))
    });
    each.collect::<Vec<_>>().join("; ")
}

/// What whole runs of the bases did, so that a reader sees how long one is.
fn load(results: &Results) -> String {
    let each = bases(results).into_iter().filter_map(|key| {
        let point = &results.points[key];
        let seconds = Spread::of(point.values(Measure::WallSeconds))?;
        Some(format!(
            "{key} {} ({} to {})",
            rough_duration(seconds.mean),
            rough_duration(seconds.min),
            rough_duration(seconds.max)
        ))
    });
    format!("A run of a base: {}.", each.collect::<Vec<_>>().join("; "))
}

/// A level in a sentence.
fn found(results: &Results, of: &LevelOf) -> String {
    let point = &results.points[&of.point.key];
    let speed = point.speed.as_ref().map(|it| {
        format!(
            "x{:.2} rows/s alone, x{:.2} acting",
            it.rows_gain, it.act_gain
        )
    });
    let frames = results.factor(of, Measure::FramesPerSecond);
    let frames = frames.map(|it| format!("x{it:.2} frames/s"));
    let gains: Vec<String> = speed.into_iter().chain(frames).collect();
    let cost = |returns, name: &str| {
        let found = results.difference(of, returns);
        found.map(|it| format!("{name} {}{}", signed(&it), verdict(&it)))
    };
    let costs = [
        cost(Measure::Greedy, "greedy return"),
        cost(Measure::Training, "training return"),
    ];
    let costs: Vec<String> = costs.into_iter().flatten().collect();
    format!(
        "{} ({}): {}; {}",
        of.name(),
        of.point.agent,
        gains.join(", "),
        match &costs[..] {
            [] => "no return".to_owned(),
            costs => costs.join("; "),
        }
    )
}

/// How many differences of the page's returns are judged, and how many of them would be called better or worse if no level changed
/// anything and returns were normal.
fn by_chance(results: &Results) -> (usize, f64) {
    let mut known = BTreeMap::new();
    let each = results.levels.iter().flat_map(|of| {
        let points = [&of.base, &of.point].map(|it| &results.points[&it.key]);
        [Measure::Greedy, Measure::Training].map(|it| points.map(|point| point.values(it).len()))
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

/// Rows of levels, each dial's base first.
fn by_level(
    results: &Results,
    base: impl Fn(&PointResult) -> Vec<String>,
    level: impl Fn(&LevelOf, &PointResult) -> Vec<String>,
) -> Vec<Vec<String>> {
    let mut rows: Vec<Vec<String>> = Vec::new();
    for levels in results.by_dial() {
        let of = &levels[0];
        let name = format!("{} (base)", of.dial.base);
        let head = vec![of.dial.name.clone(), name, of.base.agent.clone()];
        rows.push([head, base(&results.points[&of.base.key])].concat());
        for of in levels {
            let head = vec![
                of.dial.name.clone(),
                of.level.clone(),
                of.point.agent.clone(),
            ];
            rows.push([head, level(of, &results.points[&of.point.key])].concat());
        }
    }
    rows
}

fn gains(results: &Results) -> Table {
    let mean =
        |point: &PointResult, returns| cell(point.mean(returns), |it: Interval| it.to_string());
    let difference =
        |of: &LevelOf, returns| cell(results.difference(of, returns), |it| signed(&it));
    let rows = by_level(
        results,
        |point| {
            let frames = cell(point.mean(Measure::FramesPerSecond), |it| {
                format!("{:.0}", it.mean)
            });
            vec![
                "1".into(),
                "1".into(),
                frames,
                mean(point, Measure::Greedy),
                String::new(),
                mean(point, Measure::Training),
                String::new(),
            ]
        },
        |of, point| {
            let speed = point.speed.as_ref();
            vec![
                cell(speed, |it| format!("x{:.2}", it.rows_gain)),
                cell(speed, |it| format!("x{:.2}", it.act_gain)),
                cell(results.factor(of, Measure::FramesPerSecond), |it| {
                    format!("x{it:.2}")
                }),
                mean(point, Measure::Greedy),
                difference(of, Measure::Greedy),
                mean(point, Measure::Training),
                difference(of, Measure::Training),
            ]
        },
    );
    let header = [
        "dial",
        "level",
        "agent",
        "rows/s alone",
        "acting",
        "frames/s",
        "greedy return",
        "difference",
        "training return",
        "difference",
    ];
    Table::new(&header, rows)
}

fn rest(results: &Results) -> Table {
    let cells = |point: &PointResult| {
        let speed = point.speed.as_ref();
        let mean = |measure, decimals: usize| {
            cell(point.mean(measure), |it| format!("{:.decimals$}", it.mean))
        };
        vec![
            cell(speed, |it| format!("{:.2}", 1e3 * it.update_seconds)),
            cell(speed, |it| format!("{:.1}", 1e6 * it.act_seconds)),
            cell(speed, |it| it.frame_bytes.to_string()),
            cell(speed, |it| format!("{:.2}", it.weights_bytes as f64 / 1e6)),
            mean(Measure::Memory, 0),
            mean(Measure::WallSeconds, 0),
            mean(Measure::Behind, 0),
            mean(Measure::BehindSeconds, 2),
        ]
    };
    let header = [
        "dial",
        "level",
        "agent",
        "update [ms]",
        "action [us]",
        "frame [bytes]",
        "broadcast [MB]",
        "memory [MiB]",
        "run [s]",
        "weights behind [updates]",
        "[s]",
    ];
    Table::new(&header, by_level(results, cells, |_, point| cells(point)))
}

fn errors(results: &Results) -> Table {
    let cells = |point: &PointResult| {
        let of = point.exactness.as_ref();
        let share = |share: f64| format!("{:.1}%", 100.0 * share);
        vec![
            cell(of, |it| format!("{:.1e}", it.loss)),
            cell(of, |it| format!("{:.1e}", it.gradient)),
            cell(of, |it| format!("{:.1e}", it.angle)),
            cell(of, |it| format!("{:.1e}", it.q_rms)),
            cell(of, |it| format!("{:.1e}", it.q_max)),
            cell(of, |it| share(it.same_learner)),
            cell(of, |it| format!("{:.1e}", it.actor_q_rms)),
            cell(of, |it| share(it.same_actor)),
        ]
    };
    let header = [
        "dial",
        "level",
        "agent",
        "loss",
        "gradient",
        "1 - cosine",
        "Q, learner (rms)",
        "(largest)",
        "same action, learner",
        "Q, actor (rms)",
        "same action, actor",
    ];
    Table::new(&header, by_level(results, cells, |_, point| cells(point)))
}

fn dials(results: &Results) -> Vec<String> {
    let line = |levels: &[LevelOf]| {
        let dial = &levels[0].dial;
        format!(
            "{}, {} as its base: buys {}. Price: {}.",
            dial.name, dial.base, dial.buys, dial.costs
        )
    };
    results.by_dial().map(line).collect()
}
