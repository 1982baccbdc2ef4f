//! Finished runs and how they play, and the table of them.

use std::collections::BTreeMap;

use anyhow::Context;
use driml_launch::run_folder::RunFolder;
use serde::Serialize;

use super::settings::{Point, Settings, short};
use crate::{
    page::{Table, number},
    stats::Spread,
    sweep::{plan::Made, results::mean},
    sweeps::published::Published,
};

/// Standard errors from which on a mean return counts as different from the random policy's.
pub(super) const ERRORS: f64 = 2.0;

/// A run and how it plays.
pub(super) struct Scored {
    pub(super) made: Made<Point>,
    /// Returns of its agent, played greedily.
    pub(super) greedy: Vec<f64>,
    /// Returns of a random policy in its world.
    pub(super) random: Vec<f64>,
}

impl Scored {
    /// Whether a run's greedy episodes are better than the random policy's.
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
    pub(super) name: &'a str,
    /// Returns of the random policy.
    pub(super) random: &'a [f64],
    /// Of each agent that is asked for, in that order.
    pub(super) agents: Vec<OfAgent<'a>>,
}

/// What the runs of an agent in a game gave; nothing where none is finished.
#[derive(Serialize)]
pub(super) struct OfAgent<'a> {
    #[serde(skip)]
    pub(super) runs: Vec<&'a Scored>,
    pub(super) training: Vec<f64>,
    greedy: Vec<f64>,
    pub(super) paper: Option<f64>,
    /// Whether each of the runs plays better than at random.
    pub(super) is_above_random: bool,
}

impl<'a> Game<'a> {
    /// Those of all runs.
    pub(super) fn all(
        settings: &'a Settings,
        scored: &'a [Scored],
        published: &Published,
    ) -> Vec<Self> {
        let mut games: BTreeMap<&str, Vec<&Scored>> = BTreeMap::new();
        for it in scored {
            let game = games.entry(short(&it.made.point.world));
            game.or_default().push(it);
        }
        let of = |name: &str, runs: &[&'a Scored], agent: &String| {
            let own = runs.iter().filter(|it| it.made.point.agent == *agent);
            let runs: Vec<_> = own.copied().collect();
            let training = runs.iter().filter_map(|it| it.made.run.summary.mean_return);
            OfAgent {
                training: training.collect(),
                greedy: runs.iter().filter_map(|it| mean(&it.greedy)).collect(),
                paper: published.paper(name, agent),
                is_above_random: runs.iter().all(|it| it.is_above_random()),
                runs,
            }
        };
        let game = |(name, runs): (&'a str, Vec<&'a Scored>)| Self {
            name,
            random: &runs[0].random,
            agents: settings
                .agents
                .iter()
                .map(|it| of(name, &runs, it))
                .collect(),
        };
        games.into_iter().map(game).collect()
    }
}

/// A line a run.
pub(super) fn data(scored: &[Scored], published: &Published) -> anyhow::Result<Table> {
    let mut rows = Vec::new();
    for it in scored {
        let Made { point, plan, run } = &it.made;
        rows.push(vec![
            short(&point.world).to_owned(),
            point.agent.clone(),
            torso(&run.folder)?,
            plan.call.seed.to_string(),
            run.summary.frames.to_string(),
            number(run.summary.mean_return, 4),
            number(mean(&it.greedy), 4),
            number(mean(&it.random), 4),
            number(published.paper(short(&point.world), &point.agent), 4),
            format!("{:.0}", run.summary.wall_seconds),
            run.commit.clone(),
        ]);
    }
    let columns = "game,agent,torso,seed,frames,training,greedy,random,paper,wall_seconds,commit";
    Ok(Table::of(columns, rows))
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
