//! The settings of Ms. PacMan, and which ghosts are lethal when.
//! It holds no defaults: every number that affects learning is written, with its source, in a preset.

use serde::{Deserialize, Serialize};

use super::maze::GHOSTS;
use crate::error::{EnvError, require};
use crate::worlds::ising::check_temperature;

/// The settings of Ms. PacMan. Ghosts 0 to 3 are red, cyan, orange and green.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PacmanConfig {
    /// Probability, 0 to 1, that a ghost takes a random move instead of its behaviour's, at each step and for each
    /// ghost. The paper's epsilon: higher makes the ghosts harder to predict.
    pub epsilon: f64,
    /// Probability, 0 to 1, that a ghost whose behaviour is not the one its situation asks for changes over to it, at
    /// each step and for each ghost. 1: at once; lower: a ghost notices the agent later and chases it longer out of
    /// sight. The paper does not give it.
    pub switch_probability: f64,
    /// Which ghosts are lethal. The others behave the same, but touching them does nothing and earns nothing.
    /// Ignored where `lethal_schedule` is set.
    pub lethal: [bool; GHOSTS],
    /// One lethal ghost at a time, changed as episodes pass; absent: `lethal` throughout.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lethal_schedule: Option<LethalSchedule>,
    /// Env steps that the agent is invincible after the one in which it took a boost. The paper: 10.
    pub boost_steps: u32,
    /// Env steps after which an episode is cut off (`TimedOut`), at least 1.
    pub step_limit: u32,
    /// Reward of a food pellet. The paper gives no reward sizes, here and below.
    pub reward_pellet: f32,
    /// Reward of a boost.
    pub reward_boost: f32,
    /// Reward of destroying a lethal ghost while boosted.
    pub reward_ghost: f32,
    /// Reward of being caught, usually negative or 0; the episode ends.
    pub reward_death: f32,
    /// Reward of the last pellet, beside its own; the episode ends.
    pub reward_cleared: f32,
    /// An Ising model in the walls, as a distractor; absent: plain walls.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ising: Option<IsingOverlay>,
}

/// A change of the lethal ghost after every so many episodes, for continual learning.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LethalSchedule {
    /// Episodes of one environment until the next ghost, at least 1. N environments pass N times as many episodes in a task: for the
    /// paper's 5000 in all, set 5000 / N.
    pub episodes_per_task: u64,
    /// The lethal ghost (0 to 3) of each task; after the last task, the first again.
    pub order: Vec<u8>,
}

/// The Ising model in the walls: fuchsia where a spin is +1. Drawn at random at the start of each episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IsingOverlay {
    /// Temperature, in units of J / k_B, above 0 and at most 5. The paper: 0.4, nearly deterministic.
    pub temperature: f64,
    /// Metropolis sweeps over the walls in one env step, at least 1.
    pub sweeps_per_step: u32,
}

impl PacmanConfig {
    pub(super) fn check_ranges(&self) -> Result<(), EnvError> {
        for (name, value) in [
            ("epsilon", self.epsilon),
            ("switch_probability", self.switch_probability),
        ] {
            let why = format!(
                "mspacman: {name} is a probability and must be within 0 and 1, got {value}"
            );
            require((0.0..=1.0).contains(&value), why)?;
        }
        for (name, value) in [
            ("reward_pellet", self.reward_pellet),
            ("reward_boost", self.reward_boost),
            ("reward_ghost", self.reward_ghost),
            ("reward_death", self.reward_death),
            ("reward_cleared", self.reward_cleared),
        ] {
            let why = format!("mspacman: {name} must be finite, got {value}");
            require(value.is_finite(), why)?;
        }
        let at_least_1 = |name: &str, value: u64| {
            let why = format!("mspacman: {name} must be at least 1, got 0");
            require(value > 0, why)
        };
        at_least_1("step_limit", self.step_limit.into())?;
        if let Some(ising) = &self.ising {
            check_temperature(ising.temperature)?;
            at_least_1("ising.sweeps_per_step", ising.sweeps_per_step.into())?;
        }
        let Some(schedule) = &self.lethal_schedule else {
            return Ok(());
        };
        let period = schedule.episodes_per_task;
        at_least_1("lethal_schedule.episodes_per_task", period)?;
        for ghost in &schedule.order {
            let why =
                format!("mspacman: lethal_schedule.order names ghost {ghost}, but they are 0 to 3");
            require(usize::from(*ghost) < GHOSTS, why)?;
        }
        let why = "mspacman: lethal_schedule.order must name at least one ghost";
        require(!schedule.order.is_empty(), why)
    }

    /// Which ghosts are lethal in an environment's episode number `episode`, counted from 0; the schedule must be a valid one.
    pub(super) fn lethal_ghosts(&self, episode: u64) -> [bool; GHOSTS] {
        let Some(schedule) = &self.lethal_schedule else {
            return self.lethal;
        };
        let task = episode / schedule.episodes_per_task % schedule.order.len() as u64;
        let lethal = usize::from(schedule.order[task as usize]);
        std::array::from_fn(|ghost| ghost == lethal)
    }
}
