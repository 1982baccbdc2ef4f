//! The settings of table 1, the flags that override them, and the runs that follow.

use driml_envs::WorldName;
use driml_launch::evaluate::Levels;
use driml_machine::error::{Usage, usage};
use driml_settings::presets;
use serde::{Deserialize, Serialize};

use crate::{
    flags::{self, ProcgenArgs, expand_unique},
    sweep::{PlannedRun, PlaySettings, PointPlan, TrainCall},
};

const SETTINGS: &str = include_str!("../procgen.toml");
/// The number of newest checkpoints of a run that play.
pub(super) const CHECKPOINTS_PLAYED: u32 = 3;
/// Playing counts as 1 / this of the work of a run, used only to estimate the time left.
const PLAY_SHARE: u64 = 10;
/// The paper's agents, in the order of its table 1.
const PAPER_AGENTS: &str = "c51 cpc curl driml-noact driml-randk driml-fix driml-ada";
/// The agents with a fixed k, for which a name such as `driml-fix-k5` chooses another k.
const FIXED_K_AGENTS: [&str; 2] = ["driml-fix", "driml-noact"];

/// A table of `procgen.toml`, overridden by the flags.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// Games as `--env` accepts them, or `all` for the sixteen. A folder allows changes of the first four fields, but not of the others.
    #[serde(skip_serializing)]
    pub(super) games: Vec<String>,
    #[serde(skip_serializing)]
    pub(super) agents: Vec<String>,
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    #[serde(skip_serializing)]
    pub(super) jobs: u32,
    pub(super) preset: String,
    pub(super) frames: u64,
    pub(super) sets: Vec<String>,
    /// The number of episodes played with each of the last checkpoints.
    pub(super) episodes: u32,
}

#[derive(Debug, Serialize)]
pub(super) struct Point {
    pub(super) game: String,
    pub(super) agent: String,
}

impl Settings {
    pub(super) fn from_args(args: &ProcgenArgs) -> Result<Self, Usage> {
        let mut settings: Self = flags::read_settings(SETTINGS, &args.flags);
        settings.games = resolve_worlds(args.games.as_ref().unwrap_or(&settings.games))?;
        settings.agents = resolve_agents(args.agents.as_ref().unwrap_or(&settings.agents))?;
        settings.jobs = args.queue.jobs.unwrap_or(settings.jobs);
        settings.frames = args.frames.unwrap_or(settings.frames);
        settings.episodes = args.episodes.unwrap_or(settings.episodes);
        if let Some(preset) = &args.preset {
            settings.preset = presets::preset(preset)?.name.to_owned();
        }
        settings.sets.extend(args.queue.sets.iter().cloned());
        Ok(settings)
    }

    pub(super) fn plans(&self, seed: u32) -> Vec<PointPlan<Point>> {
        let mut plans = Vec::new();
        let games = self.games.iter();
        for (world, name) in games.flat_map(|it| self.agents.iter().map(move |name| (it, name))) {
            let (agent, k) = split_k(name);
            let k = k.map(|k| format!("run.horizon.k={k}"));
            let call = TrainCall {
                env: Some(world.clone()),
                agent: Some(agent.to_owned()),
                preset: Some(self.preset.clone()),
                seed,
                frames: Some(self.frames),
                sets: self.sets.iter().cloned().chain(k).collect(),
            };
            let point = Point {
                game: world.strip_prefix("procgen:").unwrap_or(world).to_owned(),
                agent: name.clone(),
            };
            let name = format!("{}-{name}-seed{seed}", point.game);
            plans.push((point, PlannedRun::new(&name, call, self.frames)));
        }
        plans
    }

    pub(super) fn play_settings(&self, levels: Levels) -> PlaySettings {
        PlaySettings {
            levels,
            checkpoints: CHECKPOINTS_PLAYED as usize,
            episodes: CHECKPOINTS_PLAYED * self.episodes,
            units: (self.frames / PLAY_SHARE).max(1),
        }
    }
}

/// Resolves names of worlds or games and drops duplicates. `all` means every Procgen game.
fn resolve_worlds(names: &[String]) -> Result<Vec<String>, Usage> {
    expand_unique(names, |name| match name {
        "all" => {
            let games = WorldName::all().filter(|it| it.kind() == "procgen");
            Ok(games.map(|world| world.to_string()).collect())
        }
        name => {
            let world = presets::world(name).map_err(|e| usage!("--games: {e}"))?;
            Ok(vec![world.to_string()])
        }
    })
}

/// Splits a name such as `driml-noact-k5` into the agent and its k. Other names have no k.
fn split_k(name: &str) -> (&str, Option<u32>) {
    let split = name.rsplit_once("-k");
    match split.and_then(|(agent, k)| Some((agent, k.parse().ok()?))) {
        Some((agent, k)) if FIXED_K_AGENTS.contains(&agent) => (agent, Some(k)),
        _ => (name, None),
    }
}

/// Resolves names of agents, with or without a k, and drops duplicates. `all` means every agent of the paper.
fn resolve_agents(names: &[String]) -> Result<Vec<String>, Usage> {
    expand_unique(names, |name| {
        Ok(match (name, split_k(name)) {
            ("all", _) => PAPER_AGENTS.split(' ').map(String::from).collect(),
            (_, (agent, None)) => vec![presets::agent(agent)?.name.to_owned()],
            (_, (agent, Some(k))) => vec![format!("{}-k{k}", presets::agent(agent)?.name)],
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flags::tests::parse;

    fn settings(length: &str) -> Settings {
        flags::read_settings(SETTINGS, &parse(length))
    }

    #[test]
    fn the_full_length_is_sixteen_games_of_two_agents() {
        let full = settings("");
        assert_eq!(resolve_worlds(&full.games).unwrap().len(), 16);
        assert_eq!(resolve_agents(&full.agents).unwrap(), ["c51", "driml-ada"]);
        for settings in [full, settings("--smoke")] {
            assert!(presets::preset(&settings.preset).is_ok());
        }
    }

    #[test]
    fn games_and_agents_go_by_short_names() {
        let found = |names: &str, of: fn(&[String]) -> Result<Vec<String>, Usage>| {
            let names: Vec<_> = names.split(' ').map(String::from).collect();
            of(&names).map(|it| it.join(" "))
        };
        let both = "driml-noact-k1 driml-noact-k5";
        assert_eq!(found(both, resolve_agents).unwrap(), both);
        assert_eq!(found("all", resolve_agents).unwrap().split(' ').count(), 7);
        let worlds = found("chain bigfish chain", resolve_worlds).unwrap();
        assert_eq!(worlds, "chain procgen:bigfish");
        for wrong in ["driml-ada-k5", "driml-noact-kx"] {
            assert!(found(wrong, resolve_agents).is_err(), "{wrong}");
        }
    }

    /// Folders of earlier programs rely on these names and calls.
    #[test]
    fn a_run_is_named_and_called_as_ever() {
        let settings = Settings {
            games: vec!["procgen:heist".into()],
            agents: vec!["driml-noact-k5".into()],
            ..settings("--smoke")
        };
        let plan = &settings.plans(2)[0].1;
        assert_eq!(plan.name, "heist-driml-noact-k5-seed2");
        assert_eq!(
            plan.call.args().join(" "),
            "--env procgen:heist --agent driml-noact --preset smoke --seed 2 --frames 2000 --set learner.checkpoint_period_updates=1000 \
             --set run.horizon.k=5"
        );
    }
}
