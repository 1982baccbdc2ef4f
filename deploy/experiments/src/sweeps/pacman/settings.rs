//! The settings of Fig. 3, the flags that override them, and the runs that follow.

use driml_machine::error::{Usage, usage};
use driml_settings::presets;
use serde::{Deserialize, Serialize};

use crate::{
    flags::{self, PacmanArgs, expand_unique},
    sweep::{PlannedRun, PointPlan, TrainCall},
};

/// The approximate number of frames of an episode, used only to estimate the time left.
const EPISODE_FRAMES: u64 = 190;
/// The most frames of an episode: the step limit of the world. With this many frames per episode a run has all its episodes.
pub(super) const EPISODE_FRAMES_MAX: u64 = 500;

/// A table of `pacman.toml`. All runs of a folder share these settings; agents and seeds can be added later.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// The agents of (b) and (c). The others are compared with the first.
    #[serde(skip_serializing)]
    pub(super) agents: Vec<String>,
    /// The number of seeds, 1 to this.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    #[serde(skip_serializing)]
    pub(super) jobs: u32,
    pub(super) preset: String,
    /// Differences from the preset in every run, in the form of `--set`.
    pub(super) sets: Vec<String>,
    pub(super) predictability: Predictability,
    pub(super) continual: Continual,
    pub(super) noise: Continual,
}

/// Part (a): the ghosts make a share of random moves.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Predictability {
    pub(super) agent: String,
    pub(super) epsilons: Vec<f64>,
    pub(super) frames: u64,
}

/// Parts (b) and (c): one lethal ghost after another.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Continual {
    pub(super) tasks: u64,
    /// The lethal ghost of each task. After the last entry it starts again with the first.
    pub(super) order: Vec<u8>,
    /// The number of episodes of a task, over all environments together.
    pub(super) episodes_per_task: u64,
    /// The number of environments, all in one actor.
    pub(super) envs: u64,
    /// Differences from the other runs, in the form of `--set`.
    pub(super) sets: Vec<String>,
}

impl Continual {
    pub(super) const fn episodes(&self) -> u64 {
        self.tasks * self.episodes_per_task
    }
}

/// The number of parts with tasks: (b) and (c).
pub(super) const PARTS: usize = 2;
pub(super) const PART_NAMES: [&str; PARTS] = ["ghosts", "noise"];

#[derive(Clone, Debug, PartialEq)]
pub(super) enum Point {
    /// Part (a): ghosts move at random with this probability.
    Epsilon(f64),
    /// Part (b) or (c) (0 or 1) with this agent.
    Tasks(usize, String),
}

impl Settings {
    pub(super) const fn continual(&self, part: usize) -> &Continual {
        [&self.continual, &self.noise][part]
    }

    pub(super) fn plans(&self, seed: u32) -> Vec<PointPlan<Point>> {
        let mut plans = Vec::new();
        let predictability = &self.predictability;
        for &epsilon in &predictability.epsilons {
            let name = format!("epsilon{epsilon}-seed{seed}");
            let set = [format!("world.epsilon={epsilon}")];
            let call = self.call(&predictability.agent, seed, predictability.frames, &set);
            let plan = PlannedRun::new(&name, call, predictability.frames);
            plans.push((Point::Epsilon(epsilon), plan));
        }
        for (part, part_name) in PART_NAMES.iter().enumerate() {
            let continual = self.continual(part);
            let order: Vec<String> = continual.order.iter().map(u8::to_string).collect();
            let schedule = format!(
                "world.lethal_schedule={{episodes_per_task={},order=[{}]}}",
                continual.episodes_per_task / continual.envs,
                order.join(",")
            );
            let envs = format!("actor.envs={}", continual.envs);
            let sets = [
                &continual.sets[..],
                &[schedule, "local.actors=1".into(), envs],
            ];
            let episodes = continual.episodes();
            let frames = episodes * EPISODE_FRAMES_MAX;
            for agent in &self.agents {
                let name = format!("{part_name}-{agent}-seed{seed}");
                let call = self.call(agent, seed, frames, &sets.concat());
                let plan = PlannedRun {
                    episodes: Some(episodes),
                    units: episodes * EPISODE_FRAMES,
                    ..PlannedRun::new(&name, call, frames)
                };
                plans.push((Point::Tasks(part, agent.clone()), plan));
            }
        }
        plans
    }

    fn call(&self, agent: &str, seed: u32, frames: u64, sets: &[String]) -> TrainCall {
        TrainCall {
            env: Some("mspacman".into()),
            agent: Some(agent.into()),
            preset: Some(self.preset.clone()),
            seed,
            frames: Some(frames),
            sets: self.sets.iter().chain(sets).cloned().collect(),
        }
    }
}

pub(super) fn with_flags(args: &PacmanArgs) -> Result<Settings, Usage> {
    let text = include_str!("../pacman.toml");
    let mut settings: Settings = flags::read_settings(text, &args.flags);
    let agents = args.agents.as_ref().unwrap_or(&settings.agents);
    settings.agents = expand_unique(agents, |name| {
        Ok(vec![presets::agent(name)?.name.to_owned()])
    })?;
    settings.jobs = args.queue.jobs.unwrap_or(settings.jobs);
    settings.sets.extend(args.queue.sets.iter().cloned());
    let predictability = &mut settings.predictability;
    predictability.frames = args.frames.unwrap_or(predictability.frames);
    for continual in [&mut settings.continual, &mut settings.noise] {
        let (given, envs) = (args.episodes_per_task, continual.envs);
        let episodes = given.unwrap_or(continual.episodes_per_task);
        if !episodes.is_multiple_of(envs) {
            return Err(usage!(
                "--episodes-per-task {episodes} is not a multiple of the {envs} environments, each of which changes its ghost by itself"
            ));
        }
        continual.episodes_per_task = episodes;
    }
    Ok(settings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flags::tests::parse;

    #[test]
    fn an_agent_that_is_named_twice_runs_once() {
        let settings = with_flags(&parse("--agents c51,curl,c51")).unwrap();
        assert_eq!(settings.agents, ["c51", "curl"]);
    }
}
