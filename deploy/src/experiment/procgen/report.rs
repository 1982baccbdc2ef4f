//! Figures, data and page of table 1: curves by game, the table beside the paper's, scores over all games, k and actions.
//! Every number on the page is made here from the runs; the text says what their length can tell.

use driml_envs::WorldName;

use super::{Cell, Kind, Results, k, published, short};
use crate::{
    experiment::{
        Page, Session,
        aggregate::{self, Estimate, Scores},
        page::Table,
        statistics::Spread,
    },
    figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series},
    plot::{self, Curve, Run, over_seeds},
};

/// Frames of the paper's runs.
const PAPER_FRAMES: f64 = 50e6;
/// Standard errors from which on a mean return counts as different from the random policy's.
const ERRORS: f64 = 2.0;
/// How a score is named.
const KINDS: [(Kind, &str); 4] = [
    (Kind::Training, "training"),
    (Kind::Trained, "greedy"),
    (Kind::Single, "levels trained on"),
    (Kind::Unseen, "unseen levels"),
];

/// Scores over all games.
struct Aggregate {
    measure: &'static str,
    kind: Kind,
    agent: String,
    games: usize,
    estimate: Estimate,
}

/// Writes everything.
pub(super) fn report(session: Session, results: &Results) -> anyhow::Result<()> {
    write_runs(&session, results)?;
    write_table(&session, results)?;
    session.figure("curves", &curves(&session, results)?)?;
    let aggregates = aggregates(results);
    let rows = aggregates.iter().map(|it| {
        let head = [it.measure, name(it.kind), &it.agent].map(String::from);
        let numbers = [it.estimate.value, it.estimate.low, it.estimate.high];
        let numbers = numbers.map(|number| format!("{number:.4}"));
        head.into_iter()
            .chain([it.games.to_string()])
            .chain(numbers)
            .collect()
    });
    let header = ["measure", "of", "agent", "games", "value", "low", "high"];
    session.csv("aggregate", &header, rows)?;
    session.figure("aggregate", &aggregate_figure(results, &aggregates))?;
    let adaptive: Vec<&Cell> = adaptive(results).collect();
    if !adaptive.is_empty() {
        session.figure("k", &k_figure(&session, results)?)?;
        write_actions(&session, results)?;
        let first = adaptive.iter().filter(|cell| cell.seed == adaptive[0].seed);
        let folders: Vec<_> = first.map(|cell| cell.ran.folder.clone()).collect();
        session.figure("affinity", &plot::affinities(&folders)?)?;
    }
    session.finish(&page(results, &aggregates, !adaptive.is_empty()))
}

/// Runs whose k follows the affinity.
fn adaptive(results: &Results) -> impl Iterator<Item = &Cell> {
    results
        .cells
        .iter()
        .filter(|cell| cell.agent == "driml-ada")
}

fn name(kind: Kind) -> &'static str {
    let known = KINDS.iter().find(|(known, _)| *known == kind);
    known.map_or("", |(_, name)| name)
}

fn number(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| format!("{value:.4}"))
}

fn write_runs(session: &Session, results: &Results) -> anyhow::Result<()> {
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
        row.extend(KINDS.map(|(kind, _)| number(cell.score(kind))));
        row.push(number(summary.mean_k));
        row.push(format!("{:.0}", summary.wall_seconds));
        row.push(format!("{:.1}", summary.frames_per_second));
        row
    });
    session.csv("runs", &header, rows)
}

fn write_table(session: &Session, results: &Results) -> anyhow::Result<()> {
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
            for (kind, name) in KINDS {
                let Some(spread) = Spread::of(results.means(world, agent, kind)) else {
                    continue;
                };
                // The random policy has no training return; its own under the same conditions stands beside it.
                let as_random = if kind == Kind::Training {
                    Kind::Trained
                } else {
                    kind
                };
                let paper = published::table_1(world, agent).filter(|_| kind == Kind::Training);
                rows.push(vec![
                    world.to_owned(),
                    agent.to_owned(),
                    name.to_owned(),
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
fn curves(session: &Session, results: &Results) -> anyhow::Result<Figure> {
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

/// The agent that the others are compared with.
fn baseline(results: &Results) -> Option<&str> {
    let agents = results.agents();
    let c51 = agents.iter().find(|agent| **agent == "c51").copied();
    c51.or(agents.first().copied())
}

/// Interquartile means of normalised scores, and probabilities of improvement over the baseline; over the games in which
/// all that is compared has scores.
fn aggregates(results: &Results) -> Vec<Aggregate> {
    let mut all = Vec::new();
    let baseline = baseline(results).unwrap_or_default();
    for kind in [Kind::Single, Kind::Unseen] {
        for agent in results.agents() {
            let scores: Scores = results
                .worlds()
                .iter()
                .map(|world| {
                    let means = results.means(world, agent, kind).into_iter();
                    means
                        .filter_map(|mean| published::normalised(world, mean))
                        .collect()
                })
                .filter(|seeds: &Vec<f64>| !seeds.is_empty())
                .collect();
            all.extend(aggregate::iqm(&scores).map(|estimate| Aggregate {
                measure: "interquartile mean",
                kind,
                agent: agent.to_owned(),
                games: scores.len(),
                estimate,
            }));
        }
    }
    for kind in [Kind::Training, Kind::Unseen] {
        for agent in results
            .agents()
            .into_iter()
            .filter(|agent| *agent != baseline)
        {
            let pairs = results.worlds().into_iter().map(|world| {
                let of = |agent: &str| results.means(world, agent, kind);
                (of(agent), of(baseline))
            });
            let both = pairs.filter(|(x, y)| !x.is_empty() && !y.is_empty());
            let (x, y): (Scores, Scores) = both.unzip();
            all.extend(aggregate::improvement(&x, &y).map(|estimate| Aggregate {
                measure: "probability of improvement",
                kind,
                agent: agent.to_owned(),
                games: x.len(),
                estimate,
            }));
        }
    }
    all
}

fn aggregate_figure(results: &Results, aggregates: &[Aggregate]) -> Figure {
    let baseline = baseline(results).unwrap_or_default();
    let panel = |title: &str, measure: &str, label: &str, kinds: [Kind; 2], level: Option<f64>| {
        let of = |agent: &&&str| {
            aggregates
                .iter()
                .any(|it| it.measure == measure && it.agent == ***agent)
        };
        let agents: Vec<String> = results
            .agents()
            .iter()
            .filter(of)
            .map(|it| (*it).to_owned())
            .collect();
        let mut series = Vec::new();
        if let Some(level) = level {
            let ends = vec![(-0.5, level), (agents.len() as f64 - 0.5, level)];
            series.push(
                Series::line("no difference", 0, ends)
                    .coloured(GREY)
                    .marked(Mark::Dashed),
            );
        }
        for (index, kind) in kinds.into_iter().enumerate() {
            let (mut points, mut band) = (Vec::new(), Vec::new());
            for it in aggregates
                .iter()
                .filter(|it| it.measure == measure && it.kind == kind)
            {
                let place = agents
                    .iter()
                    .position(|agent| *agent == it.agent)
                    .unwrap_or(0);
                let x = place as f64 + 0.16 * (index as f64 - 0.5);
                points.push((x, it.estimate.value));
                band.push((x, it.estimate.low, it.estimate.high));
            }
            if !points.is_empty() {
                series.push(
                    Series::line(name(kind), index, points)
                        .banded(band)
                        .marked(Mark::Bars),
                );
            }
        }
        Panel::Chart(Chart::new(
            title,
            Axis::names("agent", &agents),
            Axis::linear(label),
            series,
        ))
    };
    Figure {
        title: "Over all games".into(),
        notes: vec![
            "Bars: 95% of stratified bootstrap resamples over seeds. Normalised: 0 and 1 are the published minimum and maximum \
             of each game in mode easy (Cobbe et al. 2020, appendix C), an episode a level."
                .into(),
        ],
        columns: 2,
        panel_size: (430.0, 320.0),
        panels: vec![
            panel(
                "Interquartile mean of normalised scores",
                "interquartile mean",
                "normalised return",
                [Kind::Single, Kind::Unseen],
                None,
            ),
            panel(
                &format!("Probability that an agent is better than {baseline}"),
                "probability of improvement",
                "probability",
                [Kind::Training, Kind::Unseen],
                Some(0.5),
            ),
        ],
    }
}

/// k of driml-ada over frames.
fn k_figure(session: &Session, results: &Results) -> anyhow::Result<Figure> {
    let (mut series, mut rows) = (Vec::new(), Vec::new());
    for (index, world) in results.worlds().into_iter().enumerate() {
        let mut each = Vec::new();
        for cell in adaptive(results).filter(|cell| cell.world == world) {
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
fn write_actions(session: &Session, results: &Results) -> anyhow::Result<()> {
    let (mut actions, mut ks) = (Vec::new(), Vec::new());
    for cell in adaptive(results) {
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

fn page(results: &Results, aggregates: &[Aggregate], adaptive: bool) -> Page {
    let settings = &results.settings;
    let share = settings.frames as f64 / PAPER_FRAMES;
    let mut figures = vec![
        ("curves".into(), "Training return by game".into()),
        ("aggregate".into(), "Scores over all games".into()),
    ];
    let mut data: Vec<(String, String)> = vec![
        ("runs".into(), "every run".into()),
        (
            "table".into(),
            "means and standard deviations over seeds, with the paper's".into(),
        ),
        ("curves".into(), "the lines of the first figure".into()),
        ("aggregate".into(), "the scores over all games".into()),
    ];
    let mut tables = vec![table_1(results), greedy(results)];
    if adaptive {
        tables.push(actions(results));
        figures.push(("k".into(), "k of DRIML-ada over the training".into()));
        figures.push((
            "affinity".into(),
            "The action affinity at the end, first seed".into(),
        ));
        data.push(("k".into(), "the lines of the figure of k".into()));
        data.push((
            "k_histogram".into(),
            "rows served with each k; 0 is none".into(),
        ));
        data.push(("actions".into(), "transitions with each action".into()));
    }
    Page {
        title: "Procgen (Table 1)".into(),
        claim: "After 50 million frames, C51 with a DIM objective earns more on most of the sixteen games: normalised by C51, \
                DRIML-ada scores 1.9 and DRIML-fix 1.48."
            .into(),
        command: results.command.clone(),
        expected: vec![
            format!(
                "{} frames are {}% of the paper's. That is enough to see whether an agent has learned anything on a game at \
                 all, and how fast its first steps are.",
                settings.frames,
                percent(share)
            ),
            "It is not enough to confirm or refute the order of table 1: what an auxiliary loss gains late in a training cannot \
             be seen, and with few seeds only large differences are differences at all."
                .into(),
        ],
        got: got(results, aggregates),
        tables,
        differences: differences(results, share),
        setup: vec![
            format!(
                "Preset {}{}; {} frames a run, {} seed(s); {} episodes played on each kind of levels with the newest weights, \
                 epsilon 0.001. The time above is the sum over all runs; several may have run at once.",
                settings.preset,
                match &settings.sets[..] {
                    [] => String::new(),
                    sets => format!(" with {}", sets.join(", ")),
                },
                settings.frames,
                settings.seeds,
                settings.episodes
            ),
            "Interquartile mean, probability of improvement and their intervals: Agarwal et al. 2021; 2,000 resamples of seeds \
             within each game. Normalisation: (return - min) / (max - min) with Cobbe et al. 2020, appendix C, mode easy. It \
             is made for single levels, so only returns of an episode a level are normalised."
                .into(),
        ],
        figures,
        data,
        smoke: results.smoke,
    }
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    let decimals = (1.0 - percent.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{percent:.decimals$}")
}

fn got(results: &Results, aggregates: &[Aggregate]) -> Vec<String> {
    let mut lines = Vec::new();
    for agent in results.agents() {
        let played = || {
            results
                .worlds()
                .into_iter()
                .filter(|world| results.of(world, agent).next().is_some())
        };
        let above: Vec<&str> = played()
            .filter(|world| is_above_random(results, world, agent))
            .map(short)
            .collect();
        let which = if above.is_empty() {
            String::new()
        } else {
            format!(": {}", above.join(", "))
        };
        lines.push(format!(
            "`{agent}` plays better than at random (by {ERRORS} standard errors, as trained) on {} of {} games{which}.",
            above.len(),
            played().count()
        ));
    }
    for it in aggregates {
        let what = match it.measure {
            "interquartile mean" => format!(
                "Interquartile mean of normalised returns, {}, `{}`",
                name(it.kind),
                it.agent
            ),
            _ => format!(
                "Probability that `{}` is better than `{}`, {}",
                it.agent,
                baseline(results).unwrap_or_default(),
                name(it.kind)
            ),
        };
        lines.push(format!("{what}: {} ({} games).", it.estimate, it.games));
    }
    if !results.missing.is_empty() {
        lines.push(format!(
            "Missing, and in no number here: {}.",
            results.missing.join(", ")
        ));
    }
    lines
}

/// Whether the agent's episodes, of all seeds together, are better than the random policy's.
fn is_above_random(results: &Results, world: &str, agent: &str) -> bool {
    let all = results
        .of(world, agent)
        .flat_map(|cell| cell.played.trained.iter().copied());
    let random = results.random[world].trained.iter().copied();
    match (Spread::of(all), Spread::of(random)) {
        (Some(agent), Some(random)) => {
            let error = |it: &Spread| it.sd.powi(2) / it.count as f64;
            agent.mean - random.mean > ERRORS * (error(&agent) + error(&random)).sqrt()
        }
        _ => false,
    }
}

fn differences(results: &Results, share: f64) -> Vec<String> {
    let mut lines = vec![
        format!("The length: {}% of the paper's, and {} seeds instead of 3.", percent(share), results.settings.seeds),
        "The published code bootstraps its 7-step returns from s_{t+1}, lets positives cross episode ends and leaves the 500 \
         levels; ours does not, so its numbers are a reference and not what ours should become."
            .into(),
    ];
    if results.settings.preset != "split" {
        lines.push(
            "Levels are sequential, as in the paper: an episode goes on through the levels that are completed, so a return \
             can exceed a single level's, and returns as trained do not compare with those of an episode a level."
                .into(),
        );
    }
    if results.worlds().len() < 16 {
        lines.push(format!(
            "{} of the sixteen games. `--screen` orders them by how soon C51 learns them; such a choice favours C51, as the \
             return alone teaches quickly there.",
            results.worlds().iter().filter(|world| world.starts_with("procgen:")).count()
        ));
    }
    lines
}

/// Ours beside the paper's.
fn table_1(results: &Results) -> Table {
    let agents = results.agents();
    let rows = results.worlds().into_iter().map(|world| {
        let cells = agents.iter().map(|agent| {
            let ours = Spread::of(results.means(world, agent, Kind::Training));
            let ours = ours.map_or("-".into(), |it| plus_minus(it.mean, it.sd, it.count));
            match published::table_1(world, agent) {
                Some((mean, sd)) => format!("{ours} (paper {mean:.2} ± {sd:.2})"),
                None => ours,
            }
        });
        let random = results.random[world].mean(Kind::Trained);
        let random = random.map_or("-".into(), |mean| format!("{mean:.2}"));
        [short(world).to_owned(), random]
            .into_iter()
            .chain(cells)
            .collect()
    });
    Table {
        caption: "Training return, mean of the last 100 episodes: mean ± standard deviation over seeds; in brackets the \
                  paper's table 1 after 50 million frames."
            .into(),
        header: ["game", "random"].iter().chain(&agents).map(|it| (*it).to_owned()).collect(),
        rows: rows.collect(),
    }
}

fn plus_minus(mean: f64, sd: f64, count: usize) -> String {
    match count {
        1 => format!("{mean:.2}"),
        _ => format!("{mean:.2} ± {sd:.2}"),
    }
}

/// Played with the newest weights.
fn greedy(results: &Results) -> Table {
    let kinds = [Kind::Trained, Kind::Single, Kind::Unseen];
    let mut rows = Vec::new();
    for world in results.worlds() {
        let random = kinds.map(|kind| results.random[world].mean(kind));
        let mut row = vec![short(world).to_owned(), "random".into()];
        row.extend(random.map(|mean| mean.map_or("-".into(), |mean| format!("{mean:.2}"))));
        rows.push(row);
        for agent in results.agents() {
            let mut row = vec![short(world).to_owned(), agent.to_owned()];
            row.extend(kinds.map(|kind| {
                let spread = Spread::of(results.means(world, agent, kind));
                spread.map_or("-".into(), |it| plus_minus(it.mean, it.sd, it.count))
            }));
            rows.push(row);
        }
    }
    let header = [
        "game",
        "agent",
        "as trained",
        "levels trained on, one an episode",
        "unseen levels, one an episode",
    ];
    Table {
        caption: format!(
            "Newest weights, {} episodes each: mean ± standard deviation over seeds.",
            results.settings.episodes
        ),
        header: header.map(String::from).to_vec(),
        rows,
    }
}

/// What DRIML-ada did.
fn actions(results: &Results) -> Table {
    let mut rows = Vec::new();
    for name in results.worlds() {
        let cells: Vec<&Cell> = adaptive(results)
            .filter(|cell| cell.world == name)
            .collect();
        let Ok(world) = name.parse::<WorldName>() else {
            continue;
        };
        if cells.is_empty() {
            continue;
        }
        let mean = |of: &dyn Fn(&Cell) -> f64| {
            let spread = Spread::of(cells.iter().map(|cell| of(cell)));
            spread.map_or("-".into(), |it| plus_minus(it.mean, it.sd, it.count))
        };
        let mut row = vec![short(name).to_owned()];
        row.push(mean(&|cell| cell.ran.summary.mean_k.unwrap_or(0.0)));
        row.extend((0..3).map(|kind| mean(&|cell| k::kinds(world, &cell.ran.summary)[kind])));
        rows.push(row);
    }
    let header = ["game", "mean k", "movement", "no-op", "special"];
    Table {
        caption: "DRIML-ada: mean k over the whole run, and shares of its actions by what they amount to in the game.".into(),
        header: header.map(String::from).to_vec(),
        rows,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_shares_keep_two_digits() {
        assert_eq!(
            [0.002, 0.000012, 0.5, 1.0].map(percent),
            ["0.20", "0.0012", "50", "100"]
        );
    }
}
