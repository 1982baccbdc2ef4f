//! The actor's settings, and the other tables of a run's settings that an actor reads.
//! No number has a default here: presets give each one, with its source.

use std::ops::Bound;

use driml_envs::{EnvError, WorldName};
use driml_protocol::{
    BufferPool, RunSpec, TRANSITION_BYTES,
    codec::PAYLOAD_BYTES_MAX,
    config::{ConfigError, Settings, TransportConfig, check, check_range},
    transitions_max,
};
use serde::{Deserialize, Serialize};

use crate::error::ActError;

/// The most actors on a ladder of epsilons; settings with more are rejected.
const ACTORS_MAX: u32 = 65_536;

/// The `[actor]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Environments in one actor process, stepped together.
    pub envs: u32,
    /// Steps of every environment in one chunk. After each chunk, the actor sends it and takes newer weights.
    pub steps_per_chunk: u32,
    /// The most transitions in one chunk of each actor, summed over the run's actors. With many actors, chunks get
    /// shorter than `steps_per_chunk`, so that no actor waits long to send its chunk and to take newer weights. Without
    /// this setting, and in lockstep, chunks always have `steps_per_chunk` steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub round_transitions_max: Option<u64>,
    /// The most unacknowledged chunks; at this many the actor stops stepping until one is acknowledged.
    pub chunks_in_flight_max: u32,
    /// The number format of the network's products. Settings of earlier versions lack this field and mean f32.
    #[serde(default)]
    pub precision: driml_model::Precision,
    /// The actions among which the policy chooses. Settings of earlier versions lack this field and mean all.
    #[serde(default)]
    pub actions: driml_envs::ActionSet,
    /// Threads that step Procgen's environments; other worlds do not use them. 0 steps in the acting thread.
    pub world_threads: u32,
    /// Probability of a random action at the run's first frame.
    pub epsilon_start: f64,
    /// Probability of a random action from `epsilon_decay_frames` on.
    pub epsilon_end: f64,
    /// Frames of the whole run, all actors together, over which epsilon falls linearly.
    pub epsilon_decay_frames: u64,
    /// Fixed epsilons, one per actor, instead of an epsilon that falls. If absent, epsilon falls.
    pub epsilon_ladder: Option<EpsilonLadder>,
    /// Time-out of one attempt to deliver a chunk, in milliseconds; then the actor retries.
    pub ack_timeout_ms: u64,
    /// How long the replay server may be out of reach, in milliseconds, before the actor gives up.
    pub unreachable_max_ms: u64,
}

/// Fixed epsilons that decrease with the actor's number: actor i of N explores with `base^(1 + alpha * i / (N - 1))` for the whole run.
///
/// Source: Horgan et al. 2018 (Ape-X), with base 0.4 and alpha 7.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpsilonLadder {
    /// Epsilon of actor 0, above 0 and below 1.
    pub base: f64,
    /// How fast epsilons decrease, at least 0: the last actor's epsilon is `base^(1 + alpha)`.
    pub alpha: f64,
    /// N, the number of actors on the ladder, at least 2; `local.actors` if the user does not set it.
    pub actors: u32,
}

/// The settings of a run that an actor needs.
#[derive(Clone, Debug)]
pub struct ActorSettings {
    /// The run spec, on which all processes agree.
    pub spec: RunSpec,
    /// The settings of the world that the actor steps.
    pub world: driml_envs::WorldConfig,
    /// The size at which the network sees the world's frames.
    pub input: driml_model::InputSize,
    /// The network that chooses actions.
    pub model: driml_model::ModelConfig,
    /// The `[actor]` table.
    pub actor: Config,
    /// The transport of messages: whether chunks go through shared memory.
    pub transport: TransportConfig,
    /// The number of actors that the launcher starts; 1 without a launcher.
    pub actors_planned: u32,
}

/// The part of the launcher's `[local]` table that an actor reads.
#[derive(Deserialize)]
struct LocalTable {
    actors: u32,
}

impl ActorSettings {
    /// Reads the tables from a run's resolved settings.
    pub fn from_toml(text: &str) -> Result<Self, ActError> {
        let settings = Settings::parse(text)?;
        let this = Self {
            spec: settings.table("run")?,
            world: settings.table("world")?,
            input: settings.table("input")?,
            model: settings.table("model")?,
            actor: settings.table("actor")?,
            transport: settings.table("transport")?,
            actors_planned: settings.table("local").map_or(1, |t: LocalTable| t.actors),
        };
        this.spec.validate()?;
        this.model.validate()?;
        this.actor.validate()?;
        this.check_chunk_bytes()?;
        Ok(this)
    }

    /// Replaces the number of environments in the settings by `envs`.
    ///
    /// # Errors
    /// Too many environments, or chunks longer than this run allows; the message says what to do.
    pub fn set_envs(&mut self, envs: u32) -> Result<(), ConfigError> {
        let (steps, round_max) = (self.actor.steps_per_chunk, self.actor.round_transitions_max);
        let allowed = transitions_max(self.actor.envs, steps, round_max);
        self.actor.envs = envs;
        self.actor.validate()?;
        self.check_chunk_bytes()?;
        let longest = u64::from(envs) * u64::from(self.actor.chunk_steps(1));
        let why = "its chunks are longer than the replay server accepts in this run, whose settings limit actor.envs * \
                   actor.steps_per_chunk: use fewer, or start the run with more (--envs at the replay server)";
        check(longest <= allowed, "actor.envs", envs, why)
    }

    /// Takes the world's code from `world`, the name given on this machine, and not from the run's settings.
    ///
    /// # Errors
    /// The world needs code outside this program and `world` is `None`, or `world` names another world.
    pub fn set_world_code(&mut self, world: Option<WorldName>) -> Result<(), EnvError> {
        let name = self.world.name();
        match world {
            Some(world) => self.world = self.world.with_code_of(world)?,
            None if name.foreign_code().is_some() => {
                return Err(EnvError::Config(format!(
                    "the run's world is a program on this actor's machine, {name}, and an actor starts no program that only the replay \
                     server names: if you trust it, start the actor with --env {:?}, or with its path on this machine",
                    name.to_string()
                )));
            }
            None => {}
        }
        Ok(())
    }

    /// Checks that the longest chunk fits a message.
    pub fn check_chunk_bytes(&self) -> Result<(), ConfigError> {
        let transitions = u64::from(self.actor.envs) * u64::from(self.actor.chunk_steps(1));
        let bytes = transitions * self.transition_bytes() as u64;
        let (key, steps) = ("actor.steps_per_chunk", self.actor.steps_per_chunk);
        let why = "a chunk of so many steps of so many environments (actor.envs) is larger than a message may be, 512 MiB: use fewer";
        check(bytes <= PAYLOAD_BYTES_MAX as u64, key, steps, why)
    }

    const fn transition_bytes(&self) -> usize {
        self.spec.frame_bytes() + TRANSITION_BYTES
    }

    /// Returns the buffers for an actor's chunks: one being filled, and those not yet acknowledged. Buffers in shared
    /// memory have the chunk size for `actors_planned` actors; longer chunks use the process's own memory.
    pub fn chunk_buffers(&self) -> BufferPool {
        let count = self.actor.chunks_in_flight_max as usize + 1;
        let steps = self.actor.chunk_steps(self.actors_planned);
        let transitions = self.actor.envs as usize * steps as usize;
        if self.transport.shared_memory {
            BufferPool::shared(count, count, transitions * self.transition_bytes())
        } else {
            BufferPool::new(count)
        }
    }
}

impl Config {
    /// Returns the number of steps of the next chunk when `actors` actors are connected to the run.
    pub fn chunk_steps(&self, actors: u32) -> u32 {
        let Some(round_max) = self.round_transitions_max else {
            return self.steps_per_chunk;
        };
        let transitions_a_step = u64::from(self.envs) * u64::from(actors.max(1));
        let steps = (round_max / transitions_a_step).clamp(1, self.steps_per_chunk.into());
        u32::try_from(steps).unwrap_or(self.steps_per_chunk)
    }

    /// Checks every field's range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let why = "an actor steps 1 to 4096 environments";
        check_range("actor.envs", self.envs, 1..=4096, why)?;
        let why = "a chunk has 1 to 4096 steps";
        check_range("actor.steps_per_chunk", self.steps_per_chunk, 1..=4096, why)?;
        let (key, why) = ("actor.chunks_in_flight_max", "1 to 64 chunks may wait");
        check_range(key, self.chunks_in_flight_max, 1..=64, why)?;
        let why = "a probability lies between 0 and 1";
        check_range("actor.epsilon_start", self.epsilon_start, 0.0..=1.0, why)?;
        check_range("actor.epsilon_end", self.epsilon_end, 0.0..=1.0, why)?;
        if let Some(ladder) = &self.epsilon_ladder {
            let why = "the first actor's probability lies between 0 and 1, without the two";
            let open = (Bound::Excluded(0.0), Bound::Excluded(1.0));
            check_range("actor.epsilon_ladder.base", ladder.base, open, why)?;
            let why = "epsilons fall from actor to actor, so it is a number of at least 0";
            let finite = 0.0..=f64::MAX;
            check_range("actor.epsilon_ladder.alpha", ladder.alpha, finite, why)?;
            let why = "a ladder is for 2 to 65536 actors: give --actors, or set it where actors are started by hand";
            let range = 2..=ACTORS_MAX;
            check_range("actor.epsilon_ladder.actors", ladder.actors, range, why)?;
        }
        let why = "a wait lasts 100 ms to one day";
        for (key, wait) in [
            ("actor.ack_timeout_ms", self.ack_timeout_ms),
            ("actor.unreachable_max_ms", self.unreachable_max_ms),
        ] {
            check_range(key, wait, 100..=86_400_000, why)?;
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) const CONFIG: Config = Config {
        actions: driml_envs::ActionSet::All,
        precision: driml_model::Precision::F32,
        envs: 1,
        steps_per_chunk: 1,
        round_transitions_max: None,
        chunks_in_flight_max: 1,
        world_threads: 0,
        epsilon_start: 0.1,
        epsilon_end: 0.01,
        epsilon_decay_frames: 100_000,
        epsilon_ladder: None,
        ack_timeout_ms: 1000,
        unreachable_max_ms: 1000,
    };

    #[test]
    fn chunks_get_shorter_as_actors_get_many() {
        let config = |envs, steps_per_chunk, round_transitions_max| Config {
            envs,
            steps_per_chunk,
            round_transitions_max,
            ..CONFIG
        };
        let steps = |actors| config(16, 16, Some(1024)).chunk_steps(actors);
        let found = [0, 1, 4, 8, 16, 64, 4096].map(steps);
        assert_eq!(found, [16, 16, 16, 8, 4, 1, 1]);
        let most = config(4096, 4096, Some(u64::MAX));
        assert_eq!(most.chunk_steps(u32::MAX), 4096);
        assert_eq!(config(16, 16, None).chunk_steps(4096), 16);
    }
}
