//! The grid of runs: games, agents and seeds, what each run is called with, and what the command line replaces.

use driml_envs::WorldName;
use driml_machine::error::{Usage, usage};
use driml_settings::presets;
use serde::Deserialize;

use super::published;
use crate::{flags::ProcgenArgs, runs::PlannedRun};

const FULL: &str = include_str!("config.toml");
const SMOKE: &str = include_str!("smoke.toml");

/// The contents of `config.toml` or `smoke.toml` beside this file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct File {
    pub(super) grid: Settings,
    pub(super) screen: Settings,
}

/// A grid of runs.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// As `--env` takes them, or `all` for Procgen's sixteen.
    pub(super) worlds: Vec<String>,
    /// As `--agent` takes them, or `all`.
    pub(super) agents: Vec<String>,
    /// Seeds 1 to this.
    pub(super) seeds: u32,
    /// Runs at once.
    pub(super) jobs: u32,
    /// As `--preset` takes it.
    pub(super) preset: String,
    /// Frames of a run.
    pub(super) frames: u64,
    /// What differs from the preset, in the form of `--set`.
    pub(super) sets: Vec<String>,
    /// Episodes played on each kind of levels.
    pub(super) episodes: u32,
}

/// Where in the grid a run is.
pub(super) struct GridPoint {
    pub(super) world: String,
    pub(super) agent: String,
    pub(super) seed: u32,
}

impl Settings {
    /// The runs, seed by seed, so that a grid that was stopped has a seed of everything before it has two of anything.
    pub(super) fn plans(&self) -> Vec<(GridPoint, PlannedRun)> {
        let mut plans = Vec::new();
        for seed in 1..=self.seeds {
            for world in &self.worlds {
                for agent in &self.agents {
                    let spot = GridPoint {
                        world: world.clone(),
                        agent: agent.clone(),
                        seed,
                    };
                    let plan = self.plan(&spot);
                    plans.push((spot, plan));
                }
            }
        }
        plans
    }

    pub(super) fn plan(&self, spot: &GridPoint) -> PlannedRun {
        let (seed, frames) = (spot.seed.to_string(), self.frames.to_string());
        let (agent, k) = with_k(&spot.agent);
        let mut args: Vec<String> = [
            ["--env", &spot.world],
            ["--agent", agent],
            ["--preset", &self.preset],
            ["--seed", &seed],
            ["--frames", &frames],
        ]
        .concat()
        .into_iter()
        .map(String::from)
        .collect();
        let k = k.map(|k| format!("run.horizon.k={k}"));
        for set in self.sets.iter().chain(&k) {
            args.extend(["--set".into(), set.clone()]);
        }
        PlannedRun {
            name: format!("{}-{}-seed{}", short(&spot.world), spot.agent, spot.seed),
            args,
            frames: self.frames,
            episodes: None,
            units: self.frames,
        }
    }
}

/// A world's name as files have it.
pub(super) fn short(world: &str) -> &str {
    world.strip_prefix("procgen:").unwrap_or(world)
}

/// The settings of the length asked for, with what the flags replace.
pub(super) fn settings(args: &ProcgenArgs) -> Result<Settings, Usage> {
    let (name, text) = if args.flags.smoke {
        ("smoke", SMOKE)
    } else {
        ("config", FULL)
    };
    let file: File = toml::from_str(text).unwrap_or_else(|e| {
        panic!("experiments/procgen/{name}.toml is built in, and a test reads it: {e}")
    });
    let mut settings = if args.screen { file.screen } else { file.grid };
    if !args.games.is_empty() {
        settings.worlds = args.games.clone();
    }
    if !args.agents.is_empty() {
        settings.agents = args.agents.clone();
    }
    settings.worlds = worlds(&settings.worlds)?;
    settings.agents = agents(&settings.agents)?;
    settings.seeds = args.flags.seeds.unwrap_or(settings.seeds);
    settings.jobs = args.queue.jobs.unwrap_or(settings.jobs);
    settings.frames = args.frames.unwrap_or(settings.frames);
    settings.episodes = args.episodes.unwrap_or(settings.episodes);
    if let Some(preset) = &args.preset {
        settings.preset = presets::preset(preset)?.name.to_owned();
    }
    settings.sets.extend(args.queue.sets.iter().cloned());
    Ok(settings)
}

/// Worlds by their names or their games', each once; `all` is every game.
pub(super) fn worlds(names: &[String]) -> Result<Vec<String>, Usage> {
    let mut found = Vec::new();
    for name in names {
        if name == "all" {
            let games = WorldName::all().filter(|it| it.kind() == "procgen");
            found.extend(games.map(|world| world.to_string()));
        } else {
            let world = presets::world(name).map_err(|e| usage!("--games: {e}"))?;
            found.push(world.to_string());
        }
    }
    Ok(once(found))
}

/// Agents that look a fixed k ahead, so that another k can be asked for.
pub(super) const OF_FIXED_K: [&str; 2] = ["driml-fix", "driml-noact"];

/// The agent and the k of a name such as `driml-noact-k5`; other names are the agent's alone.
pub(super) fn with_k(name: &str) -> (&str, Option<u32>) {
    let split = name.rsplit_once("-k");
    match split.and_then(|(agent, k)| Some((agent, k.parse().ok()?))) {
        Some((agent, k)) if OF_FIXED_K.contains(&agent) => (agent, Some(k)),
        _ => (name, None),
    }
}

/// Agents by name, each once; `all` is every one, and a name with a k one that looks so far ahead.
pub(super) fn agents(names: &[String]) -> Result<Vec<String>, Usage> {
    let mut found = Vec::new();
    for name in names {
        if name == "all" {
            found.extend(published::AGENTS.map(String::from));
        } else {
            let (agent, k) = with_k(name);
            let agent = presets::agent(agent)?.name;
            found.push(k.map_or_else(|| agent.to_owned(), |k| format!("{agent}-k{k}")));
        }
    }
    Ok(once(found))
}

pub(super) fn once(names: Vec<String>) -> Vec<String> {
    let mut kept: Vec<String> = Vec::new();
    for name in names {
        if !kept.contains(&name) {
            kept.push(name);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_settings_can_be_read() {
        for text in [FULL, SMOKE] {
            let file: File = toml::from_str(text).unwrap();
            for settings in [&file.grid, &file.screen] {
                assert!(!worlds(&settings.worlds).unwrap().is_empty());
                assert!(!agents(&settings.agents).unwrap().is_empty());
                assert!(presets::preset(&settings.preset).is_ok());
            }
        }
    }

    #[test]
    fn games_go_by_short_names_and_all_is_sixteen() {
        let names = |list: &[&str]| worlds(&list.iter().map(|&it| it.into()).collect::<Vec<_>>());
        assert_eq!(names(&["all", "bigfish"]).unwrap().len(), 16);
        assert_eq!(
            names(&["chain", "bigfish"]).unwrap(),
            ["chain", "procgen:bigfish"]
        );
        let said = names(&["bigfihs"]).unwrap_err().to_string();
        assert!(said.contains("did you mean"), "{said}");
        assert_eq!(agents(&["all".into()]).unwrap().len(), 7);
    }

    #[test]
    fn an_agent_of_fixed_k_can_be_given_another() {
        let names = |list: &[&str]| agents(&list.iter().map(|&it| it.into()).collect::<Vec<_>>());
        let both = ["driml-noact-k1", "driml-noact-k5"];
        assert_eq!(names(&both).unwrap(), both);
        assert!(names(&["driml-ada-k5"]).is_err() && names(&["driml-noact-kx"]).is_err());
        let file: File = toml::from_str(SMOKE).unwrap();
        let spot = GridPoint {
            world: "procgen:heist".into(),
            agent: "driml-noact-k5".into(),
            seed: 2,
        };
        let plan = file.grid.plan(&spot);
        assert_eq!(plan.name, "heist-driml-noact-k5-seed2");
        let has = |pair: [&str; 2]| plan.args.windows(2).any(|words| *words == pair);
        assert!(has(["--agent", "driml-noact"]) && has(["--set", "run.horizon.k=5"]));
    }

    #[test]
    fn the_first_seed_of_everything_comes_first() {
        let file: File = toml::from_str(SMOKE).unwrap();
        let plans = file.grid.plans();
        let names: Vec<_> = plans.iter().map(|(_, plan)| plan.name.as_str()).collect();
        assert_eq!(
            names[..5],
            [
                "chain-c51-seed1",
                "chain-driml-ada-seed1",
                "mspacman-c51-seed1",
                "mspacman-driml-ada-seed1",
                "chain-c51-seed2"
            ]
        );
    }
}
