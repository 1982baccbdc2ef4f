//! Data, figures and page of a trade-off.

use super::{
    equal_time::{EQUAL_TIME, equal_time},
    figures, page,
    results::{LevelOf, Measure, PointResult, Results},
};
use crate::{cache::Session, page::Table};

const MEASURES: [(&str, Measure); 7] = [
    ("greedy_return", Measure::Greedy),
    ("training_return", Measure::Training),
    ("frames_per_second", Measure::FramesPerSecond),
    ("wall_seconds", Measure::WallSeconds),
    ("rss_mib", Measure::Memory),
    ("weights_behind_updates", Measure::Behind),
    ("weights_behind_seconds", Measure::BehindSeconds),
];

/// Writes them all.
pub(super) fn report(session: Session, results: &Results) -> anyhow::Result<()> {
    write_runs(&session, results)?;
    write_levels(&session, results)?;
    write_equal_time(&session, results)?;
    for (stem, returns, name) in [
        ("pareto", Measure::Greedy, "greedy"),
        ("pareto_training", Measure::Training, "training"),
    ] {
        session.figure(stem, &figures::pareto(results, returns, name))?;
    }
    session.figure("wall", &figures::wall(results)?)?;
    session.finish(&page::page(results)?)
}

fn write_runs(session: &Session, results: &Results) -> anyhow::Result<()> {
    let mut header = vec![
        "point",
        "agent",
        "seed",
        "updates",
        "updates_per_second",
        "weights_sha256",
    ];
    header.extend(MEASURES.map(|(name, _)| name));
    let mut rows = Vec::new();
    for (key, point) in &results.points {
        for it in &point.seeds {
            let summary = &it.ran.summary;
            let mut row = vec![
                key.clone(),
                summary.agent.clone(),
                it.seed.to_string(),
                summary.updates.to_string(),
                format!("{:.2}", summary.updates_per_second),
                summary.weights_sha256.clone(),
            ];
            let values = MEASURES.map(|(_, measure)| it.value(measure));
            row.extend(
                values.map(|value| value.map_or(String::new(), |value| format!("{value:.4}"))),
            );
            rows.push(row);
        }
    }
    session.csv("runs", &Table::new(&header, rows))
}

fn write_levels(session: &Session, results: &Results) -> anyhow::Result<()> {
    let mut header: Vec<String> = ["dial", "level", "base", "seeds"]
        .map(String::from)
        .to_vec();
    header.extend(page::SPEEDS.map(String::from));
    header.extend(page::ERRORS.map(String::from));
    for (name, _) in MEASURES {
        header.extend(["", "_low", "_high"].map(|end| format!("{name}{end}")));
        header.extend(
            ["_minus_base", "_minus_base_low", "_minus_base_high"]
                .map(|end| format!("{name}{end}")),
        );
    }
    let mut rows = Vec::new();
    for levels in results.by_dial() {
        rows.push(row(results, &levels[0], true));
        rows.extend(levels.iter().map(|of| row(results, of, false)));
    }
    let header: Vec<&str> = header.iter().map(String::as_str).collect();
    session.csv("levels", &Table::new(&header, rows))
}

/// A level, or the base that it is compared with.
fn row(results: &Results, of: &LevelOf, is_base: bool) -> Vec<String> {
    let (key, level) = match is_base {
        true => (&of.base.key, &of.dial.base),
        false => (&of.point.key, &of.level),
    };
    let point: &PointResult = &results.points[key];
    let mut row = vec![
        of.dial.name.clone(),
        level.clone(),
        of.dial.base.clone(),
        point.seeds.len().to_string(),
    ];
    row.extend(page::speed_cells(point));
    row.extend(page::error_cells(point));
    for (_, measure) in MEASURES {
        let difference = match is_base {
            true => None,
            false => results.difference(of, measure).map(|it| it.interval),
        };
        for found in [point.mean(measure), difference] {
            row.extend(found.map_or_else(Default::default, |it| it.cells()));
        }
    }
    row
}

fn write_equal_time(session: &Session, results: &Results) -> anyhow::Result<()> {
    let rows = equal_time(results)?.into_iter().map(|it| it.cells);
    session.csv("equal_time", &Table::new(&EQUAL_TIME, rows))
}
