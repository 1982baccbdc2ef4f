//! Finished runs and how they play, and the table of them.

use std::collections::BTreeMap;

use anyhow::Context;
use driml_launch::run_folder::RunFolder;

use super::settings::{Point, short};
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
    pub(super) fn is_above_random(&self) -> bool {
        let spreads = [&self.greedy, &self.random].map(|it| Spread::of(it.iter().copied()));
        let [Some(greedy), Some(random)] = spreads else {
            return false;
        };
        let error = |it: Spread| it.sd.powi(2) / it.count as f64;
        greedy.mean - random.mean > ERRORS * (error(greedy) + error(random)).sqrt()
    }
}

/// The games that have a run, and the runs of each.
pub(super) fn by_game(scored: &[Scored]) -> BTreeMap<&str, Vec<&Scored>> {
    let mut games: BTreeMap<&str, Vec<&Scored>> = BTreeMap::new();
    for it in scored {
        games
            .entry(short(&it.made.point.world))
            .or_default()
            .push(it);
    }
    games
}

/// The runs of an agent among those of a game.
pub(super) fn of<'a>(
    game: &'a [&Scored],
    agent: &'a str,
) -> impl Iterator<Item = &'a Scored> + Clone {
    let all = game.iter().copied();
    all.filter(move |it| it.made.point.agent == agent)
}

pub(super) fn training<'a>(runs: impl Iterator<Item = &'a Scored>) -> Vec<f64> {
    runs.filter_map(|it| it.made.run.summary.mean_return)
        .collect()
}

/// A line a run.
pub(super) fn data(scored: &[Scored], published: &Published) -> anyhow::Result<Table> {
    let header = [
        "game",
        "agent",
        "torso",
        "seed",
        "frames",
        "training",
        "greedy",
        "random",
        "paper",
        "wall_seconds",
        "commit",
    ];
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
    Ok(Table::new(&header, rows))
}

/// The torso of a run's network, from its settings; those without a choice have the one of Nature's DQN.
fn torso(folder: &RunFolder) -> anyhow::Result<String> {
    let path = folder.config();
    let text = std::fs::read_to_string(&path);
    let text = text.with_context(|| format!("reading {}", path.display()))?;
    let config: toml::Table = text.parse()?;
    let torso = config.get("model").and_then(|model| model.get("torso"));
    Ok(torso
        .and_then(toml::Value::as_str)
        .unwrap_or("nature")
        .to_owned())
}
