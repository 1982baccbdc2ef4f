//! Data of the runs, their returns over frames, and k and actions of driml-ada.
//! It compares nothing over games: `scores` does.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::{Kind, Results, k, published, short};
use crate::{
    Session,
    plot::{Curve, Run, over_seeds},
    statistics::Spread,
};

fn number(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| format!("{value:.4}"))
}

/// Writes a line a run.
pub(super) fn write_runs(session: &Session, results: &Results) -> anyhow::Result<()> {
    let header = [
        "world",
        "agent",
        "seed",
        "frames",
        "updates",
        "training_return",
        "greedy_return",
        "levels_trained_on_return",
        "unseen_levels_return",
        "mean_k",
        "wall_seconds",
        "frames_per_second",
    ];
    let rows = results.cells.iter().map(|cell| {
        let summary = &cell.ran.summary;
        let mut row = vec![
            cell.world.clone(),
            cell.agent.clone(),
            cell.seed.to_string(),
            summary.frames.to_string(),
            summary.updates.to_string(),
        ];
        row.extend(Kind::ALL.map(|kind| number(cell.score(kind))));
        row.push(number(summary.mean_k));
        row.push(format!("{:.0}", summary.wall_seconds));
        row.push(format!("{:.1}", summary.frames_per_second));
        row
    });
    session.csv("runs", &header, rows)
}

/// Writes means and standard deviations over seeds beside the paper's.
pub(super) fn write_table(session: &Session, results: &Results) -> anyhow::Result<()> {
    let header = [
        "world",
        "agent",
        "of",
        "seeds",
        "mean",
        "sd",
        "random",
        "paper_mean",
        "paper_sd",
    ];
    let mut rows = Vec::new();
    for world in results.worlds() {
        for agent in results.agents() {
            for kind in Kind::ALL {
                let Some(spread) = Spread::of(results.means(world, agent, kind)) else {
                    continue;
                };
                // The random policy has no training return; its own under the same conditions stands beside it.
                let as_random = if kind == Kind::Training {
                    Kind::Trained
                } else {
                    kind
                };
                let paper = published::paper(world, agent).filter(|_| kind == Kind::Training);
                rows.push(vec![
                    world.to_owned(),
                    agent.to_owned(),
                    kind.name().to_owned(),
                    spread.count.to_string(),
                    format!("{:.4}", spread.mean),
                    format!("{:.4}", spread.sd),
                    number(results.random[world].mean(as_random)),
                    number(paper.map(|it| it.0)),
                    number(paper.map(|it| it.1)),
                ]);
            }
        }
    }
    session.csv("table", &header, rows)
}

/// Training return over frames, a chart a game; the points are written as data too.
pub(super) fn figure(session: &Session, results: &Results) -> anyhow::Result<Figure> {
    let (mut panels, mut rows) = (Vec::new(), Vec::new());
    for world in results.worlds() {
        let mut series = Vec::new();
        if let Some(random) = results.random[world].mean(Kind::Trained) {
            let ends = vec![(0.0, random), (results.settings.frames as f64, random)];
            series.push(
                Series::line("random", 0, ends)
                    .coloured(GREY)
                    .marked(Mark::Dashed),
            );
        }
        for (index, agent) in results.settings.agents.iter().enumerate() {
            let mut each = Vec::new();
            for cell in results.of(world, agent) {
                each.push(Run::read(&cell.ran.folder)?.values("mean_return")?);
            }
            let curve = over_seeds(&each);
            rows.extend(points(&[world, agent], &curve));
            if !curve.points.is_empty() {
                series.push(Series::line(agent, index, curve.points).banded(curve.band));
            }
        }
        panels.push(Panel::Chart(Chart::new(
            short(world),
            Axis::linear("frames"),
            Axis::linear("mean return"),
            series,
        )));
    }
    let header = ["world", "agent", "frames", "mean_return", "low", "high"];
    session.csv("curves", &header, rows)?;
    Ok(Figure {
        title: format!("Training return, {} frames", results.settings.frames),
        notes: vec![
            "Mean of the last 100 training episodes, with exploration; the line is the mean over seeds, the band their range, \
             over the frames that all seeds have. Dashed: a random policy."
                .into(),
        ],
        columns: panels.len().min(if panels.len() > 4 { 4 } else { 2 }),
        panel_size: if panels.len() > 4 { (330.0, 260.0) } else { (430.0, 320.0) },
        panels,
    })
}

/// A curve as rows; a point without a band is its own.
fn points(head: &[&str], curve: &Curve) -> Vec<Vec<String>> {
    let rows = curve.points.iter().enumerate().map(|(at, (x, y))| {
        let (low, high) = curve.band.get(at).map_or((*y, *y), |band| (band.1, band.2));
        let head = head.iter().map(|&word| word.to_owned());
        let numbers = [y, &low, &high].map(|number| format!("{number:.4}"));
        head.chain([format!("{x:.0}")]).chain(numbers).collect()
    });
    rows.collect()
}

/// k of driml-ada over frames.
pub(super) fn k_figure(session: &Session, results: &Results) -> anyhow::Result<Figure> {
    let (mut series, mut rows) = (Vec::new(), Vec::new());
    for (index, world) in results.worlds().into_iter().enumerate() {
        let mut each = Vec::new();
        for cell in results.adaptive().filter(|cell| cell.world == world) {
            each.push(k::windowed(&Run::read(&cell.ran.folder)?)?);
        }
        let curve = over_seeds(&each);
        rows.extend(points(&[world], &curve));
        if !curve.points.is_empty() {
            series.push(Series::line(short(world), index, curve.points).banded(curve.band));
        }
    }
    session.csv("k", &["world", "frames", "mean_k", "low", "high"], rows)?;
    Ok(Figure {
        title: "How far ahead DRIML-ada looks".into(),
        notes: vec![
            "Mean k of the rows served in each fortieth of the run; mean and range over seeds. k ends with its episode or level, \
             so games of short levels hold it down."
                .into(),
        ],
        columns: 1,
        panel_size: (760.0, 380.0),
        panels: vec![Panel::Chart(Chart::new(
            "k over the training",
            Axis::linear("frames"),
            Axis::linear("mean k [environment steps]").showing(&[1.0]),
            series,
        ))],
    })
}

/// What driml-ada did, and how often each k was served.
pub(super) fn write_actions(session: &Session, results: &Results) -> anyhow::Result<()> {
    let (mut actions, mut ks) = (Vec::new(), Vec::new());
    for cell in results.adaptive() {
        let head = [cell.world.clone(), cell.seed.to_string()];
        let of = |histogram: &[u64]| -> Vec<Vec<String>> {
            let rows = histogram.iter().enumerate().map(|(at, count)| {
                let pair = [at.to_string(), count.to_string()];
                head.iter().cloned().chain(pair).collect()
            });
            rows.collect()
        };
        actions.extend(of(&cell.ran.summary.action_histogram));
        ks.extend(of(&cell.ran.summary.k_histogram));
    }
    session.csv("actions", &["world", "seed", "action", "count"], actions)?;
    session.csv("k_histogram", &["world", "seed", "k", "count"], ks)
}
