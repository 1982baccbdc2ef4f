//! What Fig. 3 can be told, and what the command line replaces of it.

use driml_machine::error::{Usage, usage};
use driml_settings::presets;
use serde::{Deserialize, Serialize};

use crate::flags::{self, PacmanArgs};

pub(super) const NAME: &str = "pacman";

/// `deploy/experiments/src/pacman/*.toml`. A folder holds the runs of one such choice; agents and seeds can be added.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// Agents of (b) and (c), the first for comparison.
    #[serde(skip_serializing)]
    pub(super) agents: Vec<String>,
    /// Seeds 1 to this.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    /// Runs at once.
    #[serde(skip_serializing)]
    pub(super) jobs: u32,
    /// As `--preset` takes it.
    pub(super) preset: String,
    /// What differs from the preset in every run, in the form of `--set`.
    pub(super) sets: Vec<String>,
    pub(super) predictability: Predictability,
    pub(super) continual: Continual,
    pub(super) noise: Continual,
}

/// (a) The share of random moves of the ghosts.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Predictability {
    pub(super) agent: String,
    pub(super) epsilons: Vec<f64>,
    /// Frames of a run.
    pub(super) frames: u64,
}

/// (b, c) One lethal ghost after another.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Continual {
    /// Tasks of a run.
    pub(super) tasks: u64,
    /// The lethal ghost of each task; after the last the first again.
    pub(super) order: Vec<u8>,
    /// Episodes of a task, of all copies together.
    pub(super) episodes_per_task: u64,
    /// Copies of the world, in one actor.
    pub(super) envs: u64,
    /// What differs from the other runs, in the form of `--set`.
    pub(super) sets: Vec<String>,
}

impl Continual {
    /// Episodes of a whole run.
    pub(super) const fn episodes(&self) -> u64 {
        self.tasks * self.episodes_per_task
    }
}

/// The settings of the length asked for, with what the flags replace.
pub(super) fn with_flags(args: &PacmanArgs) -> Result<Settings, Usage> {
    let mut settings: Settings = flags::settings(
        NAME,
        include_str!("config.toml"),
        include_str!("smoke.toml"),
        &args.flags,
    );
    if !args.agents.is_empty() {
        let known = args.agents.iter().map(|name| presets::agent(name));
        let names = known.map(|agent| agent.map(|agent| agent.name.to_owned()));
        settings.agents = names.collect::<Result<_, _>>()?;
    }
    settings.seeds = args.flags.seeds.unwrap_or(settings.seeds);
    settings.jobs = args.queue.jobs.unwrap_or(settings.jobs);
    settings.sets.extend(args.queue.sets.iter().cloned());
    let predictability = &mut settings.predictability;
    predictability.frames = args.frames.unwrap_or(predictability.frames);
    for continual in [&mut settings.continual, &mut settings.noise] {
        let episodes = args
            .episodes_per_task
            .unwrap_or(continual.episodes_per_task);
        if !episodes.is_multiple_of(continual.envs) {
            return Err(usage!(
                "--episodes-per-task {episodes} is no multiple of the {} copies of the world, each of which changes its ghost \
                 by itself",
                continual.envs
            ));
        }
        continual.episodes_per_task = episodes;
    }
    Ok(settings)
}
