//! The runs of Fig. 3: what each is for, and its command line.

use super::settings::{Continual, Predictability, Settings};
use crate::runs::PlannedRun;

/// Frames of an episode, about; only the estimate of the time left depends on it.
const EPISODE_FRAMES: u64 = 190;
/// Most frames of an episode: the world's step limit. A run of that many frames has all its episodes.
pub(super) const EPISODE_FRAMES_MAX: u64 = 500;

/// What a run is for.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum RunKind {
    /// (a): ghosts that move at random with this probability.
    Epsilon(f64),
    /// (b), of this agent.
    Ghosts(String),
    /// (c), of this agent.
    Noise(String),
}

impl Settings {
    /// The runs, seed by seed.
    pub(super) fn plans(&self) -> Vec<(RunKind, u32, PlannedRun)> {
        let mut plans = Vec::new();
        for seed in 1..=self.seeds {
            for &epsilon in &self.predictability.epsilons {
                let kind = RunKind::Epsilon(epsilon);
                plans.push((kind, seed, self.predictability_plan(epsilon, seed)));
            }
            for agent in &self.agents {
                let plan = self.continual_plan("ghosts", &self.continual, agent, seed);
                plans.push((RunKind::Ghosts(agent.clone()), seed, plan));
            }
            for agent in &self.agents {
                let plan = self.continual_plan("noise", &self.noise, agent, seed);
                plans.push((RunKind::Noise(agent.clone()), seed, plan));
            }
        }
        plans
    }

    fn predictability_plan(&self, epsilon: f64, seed: u32) -> PlannedRun {
        let Predictability { agent, frames, .. } = &self.predictability;
        let sets = [format!("world.epsilon={epsilon}")];
        PlannedRun {
            name: format!("epsilon{epsilon}-seed{seed}"),
            args: self.args(agent, seed, *frames, &sets),
            frames: *frames,
            episodes: None,
            units: *frames,
        }
    }

    fn continual_plan(
        &self,
        name: &str,
        continual: &Continual,
        agent: &str,
        seed: u32,
    ) -> PlannedRun {
        let order: Vec<String> = continual.order.iter().map(u8::to_string).collect();
        let mut sets = continual.sets.clone();
        sets.push(format!(
            "world.lethal_schedule={{episodes_per_task={},order=[{}]}}",
            continual.episodes_per_task / continual.envs,
            order.join(",")
        ));
        sets.push("local.actors=1".into());
        sets.push(format!("actor.envs={}", continual.envs));
        let episodes = continual.episodes();
        let frames = episodes * EPISODE_FRAMES_MAX;
        PlannedRun {
            name: format!("{name}-{agent}-seed{seed}"),
            args: self.args(agent, seed, frames, &sets),
            frames,
            episodes: Some(episodes),
            units: episodes * EPISODE_FRAMES,
        }
    }

    fn args(&self, agent: &str, seed: u32, frames: u64, sets: &[String]) -> Vec<String> {
        let (seed, frames) = (seed.to_string(), frames.to_string());
        let head = [
            ["--env", "mspacman"],
            ["--agent", agent],
            ["--preset", &self.preset],
            ["--seed", &seed],
            ["--frames", &frames],
        ];
        let mut args: Vec<String> = head.concat().into_iter().map(String::from).collect();
        for set in self.sets.iter().chain(sets) {
            args.extend(["--set".into(), set.clone()]);
        }
        args
    }
}
