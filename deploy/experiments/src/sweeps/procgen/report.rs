//! What the runs of table 1 gave: data, figure and page.

use std::collections::BTreeMap;

use anyhow::Context;
use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_launch::{evaluate::Levels, metrics::rounded, run_folder::RunFolder};
use driml_protocol::RETURNS_OF;
use minijinja::{Value, context};
use serde::Serialize;

use super::settings::{CHECKPOINTS, Point, Settings};
use crate::{
    cache::Session,
    plot::{Band, Run, over_seeds},
    stats::{
        Spread, mean,
        over_games::{Scores, improvement, iqm},
    },
    sweep::plan::Made,
    sweeps::published::{normalised, paper},
};

/// Standard errors from which on a mean return counts as different from the random policy's.
const ERRORS: f64 = 2.0;
const PAPER_FRAMES: f64 = 50e6;
/// Seeds of each game and agent from which on scores over all games are made.
const SEEDS_MIN: usize = 3;

pub(super) struct Scored {
    pub(super) made: Made<Point>,
    /// Returns of its agent, played greedily.
    pub(super) greedy: Vec<f64>,
    /// Returns of a random policy in its world.
    pub(super) random: Vec<f64>,
}

impl Scored {
    fn is_above_random(&self) -> bool {
        let spreads = [&self.greedy, &self.random].map(|it| Spread::of(it.iter().copied()));
        let [Some(greedy), Some(random)] = spreads else {
            return false;
        };
        let error = |it: Spread| it.sd.powi(2) / it.count as f64;
        greedy.mean - random.mean > ERRORS * (error(greedy) + error(random)).sqrt()
    }
}

/// A game that has a run.
#[derive(Serialize)]
pub(super) struct Game<'a> {
    name: &'a str,
    /// Returns of the random policy.
    random: &'a [f64],
    /// Of each agent that is asked for, in that order.
    agents: Vec<OfAgent<'a>>,
}

/// What the runs of an agent in a game gave; nothing where none is finished.
#[derive(Serialize)]
struct OfAgent<'a> {
    #[serde(skip)]
    runs: Vec<&'a Made<Point>>,
    training: Vec<f64>,
    greedy: Vec<f64>,
    paper: Option<f64>,
    /// Whether each of the runs plays better than at random.
    is_above_random: bool,
}

pub(super) fn games<'a>(settings: &'a Settings, scored: &'a [Scored]) -> Vec<Game<'a>> {
    let mut games: BTreeMap<&str, Vec<&Scored>> = BTreeMap::new();
    for it in scored {
        games.entry(&it.made.point.game).or_default().push(it);
    }
    let of = |name: &str, runs: &[&'a Scored], agent: &String| {
        let own = || runs.iter().filter(|it| it.made.point.agent == *agent);
        let training = own().filter_map(|it| it.made.run.summary.mean_return);
        OfAgent {
            runs: own().map(|it| &it.made).collect(),
            training: training.collect(),
            greedy: own().filter_map(|it| mean(&it.greedy)).collect(),
            paper: paper(name, agent),
            is_above_random: own().all(|it| it.is_above_random()),
        }
    };
    let agents = settings.agents.iter();
    let game = |(name, runs): (&'a str, Vec<&'a Scored>)| Game {
        name,
        random: &runs[0].random,
        agents: agents.clone().map(|it| of(name, &runs, it)).collect(),
    };
    games.into_iter().map(game).collect()
}

pub(super) fn write_data(session: &Session, scored: &[Scored]) -> anyhow::Result<()> {
    let columns = "game,agent,torso,seed,frames,training,greedy,random,paper,wall_seconds,commit";
    let mut rows = Vec::new();
    for it in scored {
        let Made { point, plan, run } = &it.made;
        let summary = &run.summary;
        let paper = paper(&point.game, &point.agent);
        let [greedy, random] = [&it.greedy, &it.random].map(|of| mean(of));
        let returns = [summary.mean_return, greedy, random, paper];
        rows.push((
            (&point.game, &point.agent, torso(&run.folder)?),
            (plan.call.seed, summary.frames),
            returns.map(|it| it.map(rounded)),
            (summary.wall_seconds.round() as u64, &run.commit),
        ));
    }
    session.csv("table", columns, rows)
}

/// The torso of a run's network, from its settings; those without a choice have the one of Nature's DQN.
fn torso(folder: &RunFolder) -> anyhow::Result<String> {
    let path = folder.config();
    let text = std::fs::read_to_string(&path);
    let text = text.with_context(|| format!("reading {}", path.display()))?;
    let config: toml::Table = text.parse()?;
    let torso = config.get("model").and_then(|model| model.get("torso"));
    let torso = torso.and_then(toml::Value::as_str);
    Ok(torso.unwrap_or("nature").to_owned())
}

/// Training return over frames, a chart a game.
pub(super) fn figure(settings: &Settings, games: &[Game<'_>]) -> anyhow::Result<Figure> {
    let mut panels = Vec::new();
    for game in games {
        let level = |value: f64| vec![(0.0, value), (settings.frames as f64, value)];
        let mut series = Vec::new();
        if let Some(random) = mean(game.random) {
            series.push(Series::line("random", 0, level(random)).coloured(GREY));
        }
        for (index, (agent, of)) in settings.agents.iter().zip(&game.agents).enumerate() {
            let read =
                |it: &&Made<Point>| Ok(Run::read(&it.run.folder)?.values("frames", "mean_return")?);
            let each = of.runs.iter().map(read);
            let each = each.collect::<anyhow::Result<Vec<_>>>()?;
            let curve = over_seeds(&each, Band::Range);
            if curve.points.is_empty() {
                continue;
            }
            series.push(curve.series(agent, index));
            if let Some(paper) = of.paper {
                series.push(Series::line("", index, level(paper)).marked(Mark::Dashed));
            }
        }
        let (x, y) = (Axis::linear("frames"), Axis::linear("mean return"));
        panels.push(Panel::Chart(Chart::new(game.name, x, y, series)));
    }
    Ok(Figure {
        title: "Training return by game".into(),
        notes: vec![format!(
            "Mean of the last {RETURNS_OF} training episodes, with exploration; over several seeds mean and range. Dashed: the paper's \
             after 50 million frames. Grey: a random policy."
        )],
        columns: panels.len().min(4),
        panel_size: (300.0, 230.0),
        panels,
    })
}

/// Scores over all games, where each game and agent has enough seeds for an interval.
pub(super) fn over_games(
    session: &mut Session,
    settings: &Settings,
    games: &[Game<'_>],
) -> anyhow::Result<Vec<String>> {
    let mut all = games.iter().flat_map(|it| &it.agents);
    if !all.all(|of| of.runs.len() >= SEEDS_MIN) {
        return Ok(Vec::new());
    }
    let mut lines = Vec::new();
    let play = settings.play(Levels::TrainSingle);
    for (at, agent) in settings.agents.iter().enumerate() {
        let mut scores = Scores::new();
        for game in games {
            let mut of_game = Vec::new();
            for it in &game.agents[at].runs {
                session.progress().again(play.units);
                let key = format!("{}-single", it.plan.name);
                let returns = play.greedy(session, &key, &it.run)?;
                let returns = returns.and_then(|it| mean(&it));
                of_game.extend(returns.and_then(|it| normalised(game.name, it)));
            }
            if of_game.len() >= SEEDS_MIN {
                scores.push(of_game);
            }
        }
        lines.extend(iqm(&scores).map(|it| {
            format!(
                "Interquartile mean of `{agent}` over {} games: {it:.3} (greedy, an episode a level, normalised as by Cobbe et al. 2020).",
                scores.len()
            )
        }));
    }
    let scores = |at: usize| -> Scores {
        let trained = games.iter().map(|game| game.agents[at].training.clone());
        trained.collect()
    };
    for (at, agent) in settings.agents.iter().enumerate().skip(1) {
        let first = &settings.agents[0];
        lines.extend(improvement(&scores(at), &scores(0)).map(|it| {
            format!("Probability that `{agent}` trains better than `{first}`: {it:.3}.")
        }));
    }
    Ok(lines)
}

/// What the page says. `count` runs are finished.
pub(super) fn values(
    settings: &Settings,
    games: &[Game<'_>],
    over_games: &[String],
    count: usize,
    missing: &[String],
) -> Value {
    let agents = games.iter().flat_map(|it| &it.agents);
    let mut runs = agents.flat_map(|it| &it.runs);
    context! {
        settings,
        agents => settings.agents,
        seeds => settings.seeds,
        games,
        percent => percent(settings.frames as f64 / PAPER_FRAMES),
        above_random => above_random(settings, games),
        over_games,
        count,
        planned => count + missing.len(),
        missing,
        returns_of => RETURNS_OF,
        episodes => CHECKPOINTS * settings.episodes,
        some_seeds => runs.any(|it| it.plan.call.seed > 1),
    }
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    let decimals = (1.0 - percent.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{percent:.decimals$}")
}

/// On how many of its games each agent plays better than at random.
fn above_random(settings: &Settings, games: &[Game<'_>]) -> Vec<String> {
    let agents = settings.agents.iter().enumerate();
    let lines = agents.filter_map(|(at, agent)| {
        let of_game = games.iter().map(|game| &game.agents[at]);
        let played: Vec<_> = of_game.filter(|of| !of.runs.is_empty()).collect();
        let above = played.iter().filter(|of| of.is_above_random);
        let text = format!(
            "`{agent}` is better than random, in every seed by {ERRORS} standard errors, on {} of {} games.",
            above.count(),
            played.len()
        );
        (!played.is_empty()).then_some(text)
    });
    lines.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_shares_keep_two_digits() {
        let texts = [0.002, 0.000012, 0.5, 1.0].map(percent);
        assert_eq!(texts, ["0.20", "0.0012", "50", "100"]);
    }
}
