//! An actor without its network connections: acts with the weights that it was given and returns chunk after chunk.
//! Actor processes and the lockstep mode both run this code; it neither sends nor waits.

use driml_envs::RestrictedWorld;
use driml_protocol::{BufferPool, Chunk, RunSpec};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    acting::{ActingLoop, ActingState},
    config::ActorSettings,
    error::ActError,
    policy::NetworkPolicy,
    recorder::ChunkRecorder,
    schedule::Schedule,
};

/// One incarnation of an actor, from its start to its end. A restarted actor is a new incarnation.
#[derive(Clone, Copy, Debug)]
pub struct Incarnation {
    /// The actor's number, unique in the run.
    pub actor: u32,
    /// Distinguishes the incarnations of one actor. It does not influence any computation.
    pub id: u64,
    /// Updates from which the run resumes. It is part of the seeds: a resumed run does not repeat its first episodes.
    pub after_updates: u64,
    /// Earlier incarnations of this actor. It is part of the seeds: a restarted actor does not repeat its episodes.
    pub earlier_incarnations: u32,
}

impl Incarnation {
    /// The first incarnation of an actor, in a run that starts from its first update.
    pub const fn first(actor: u32, id: u64) -> Self {
        Self {
            actor,
            id,
            after_updates: 0,
            earlier_incarnations: 0,
        }
    }

    /// Returns the seed of the generator for `purpose`. Incarnations that differ in `actor`, `after_updates` or
    /// `earlier_incarnations` get different seeds, whatever the values of these fields.
    pub fn seed(&self, spec: &RunSpec, purpose: &str) -> [u8; 32] {
        let index = u64::from(self.actor) | self.after_updates << u32::BITS;
        let mut purpose = purpose.to_owned();
        if self.earlier_incarnations > 0 {
            purpose += &format!(" after {} lives", self.earlier_incarnations);
        }
        // The high bits of `after_updates`, which do not fit into the index.
        let high_bits = self.after_updates >> u32::BITS;
        if high_bits > 0 {
            purpose += &format!(" after {high_bits} times 2^32 updates");
        }
        spec.seed_for(&purpose, index)
    }
}

/// Steps a world with a policy and returns the transitions in chunks.
pub struct Collector {
    schedule: Schedule,
    acting: ActingLoop,
    recorder: ChunkRecorder,
    policy: NetworkPolicy,
    weights_version: u64,
}

/// The state of a collector between two chunks, without its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CollectorState {
    acting: ActingState,
    next_chunk_numbers: (u64, u64),
}

impl Collector {
    /// Builds the world, and the policy with its first weights. Chunks take their memory from `pool`.
    ///
    /// # Errors
    /// An actor beyond the ladder of epsilons, a world that cannot be made or does not fit the run spec, weights that do not fit
    /// the model.
    pub fn new(
        settings: &ActorSettings,
        pool: BufferPool,
        incarnation: Incarnation,
        weights_version: u64,
        safetensors: &[u8],
    ) -> Result<Self, ActError> {
        let spec = &settings.spec;
        let config = &settings.actor;
        let Incarnation { actor, id, .. } = incarnation;
        let schedule = Schedule::new(config, actor)?;
        let world_seed = incarnation.seed(spec, "world");
        let world_seed = u64::from_le_bytes(world_seed[..8].try_into().expect("eight bytes"));
        let (envs, threads) = (config.envs as usize, config.world_threads as usize);
        let build_error = |source| ActError::BuildWorld {
            world: spec.world.clone(),
            source,
        };
        let actions = settings.world.actions(config.actions);
        let world = settings.world.build(envs, world_seed, threads);
        let world = world.map_err(build_error)?;
        let shape = world.frame_shape();
        let sent_size = spec.frame_size();
        let (height, width) = settings.input.whole_frame(sent_size);
        let (channels, num_actions) = (spec.frame_channels as usize, spec.num_actions as usize);
        let expected = (height, width, channels, num_actions);
        let found = (shape.height, shape.width, shape.channels, actions.len());
        if expected != found {
            return Err(ActError::Other(format!(
                "the world {} gives (height, width, channels, actions) {found:?}, the run spec promises {expected:?}: \
                 write the run's settings anew with `driml train`",
                spec.world
            )));
        }
        let rng = ChaCha8Rng::from_seed(incarnation.seed(spec, "exploration"));
        let world = RestrictedWorld::wrap(world, actions, sent_size).map_err(build_error)?;
        let enlarge = settings.input.resizer(sent_size, &settings.model)?;
        let policy = NetworkPolicy::new(&settings.model, enlarge, safetensors, config.precision)?;
        Ok(Self {
            acting: ActingLoop::new(world, spec.frame_stack as usize, rng),
            recorder: ChunkRecorder::new(pool, actor, id, config.envs, spec.frame_bytes() as u32),
            policy: policy.with_noise(),
            weights_version,
            schedule,
        })
    }

    /// Replaces the weights from the next chunk on. On an error, the old weights stay.
    pub fn set_weights(&mut self, version: u64, safetensors: &[u8]) -> Result<(), ActError> {
        self.policy.set_weights(safetensors)?;
        self.weights_version = version;
        Ok(())
    }

    /// The number of transitions in all chunks so far.
    pub const fn transitions_recorded(&self) -> u64 {
        self.recorder.transitions_recorded()
    }

    /// Acts until one chunk of `steps` steps is full. `frames`, the run's frame count so far, sets epsilon for the whole chunk.
    pub fn collect(&mut self, frames: u64, steps: u32) -> Result<Chunk, ActError> {
        let chunk = self.collect_unless(|| false, frames, steps)?;
        Ok(chunk.expect("it is never over"))
    }

    /// Like `collect`, but returns `None` once `is_stopped` is true. The chunk stays unfinished: do not collect again.
    pub(crate) fn collect_unless(
        &mut self,
        is_stopped: impl Fn() -> bool,
        frames: u64,
        steps: u32,
    ) -> Result<Option<Chunk>, ActError> {
        let recorder = &mut self.recorder;
        recorder.begin_chunk(self.weights_version, steps);
        let epsilon = self.schedule.epsilon(frames);
        while !is_stopped() {
            let step = self.acting.step(&mut self.policy, epsilon)?;
            let chunk = recorder.record(step.frames, step.actions, step.rewards, step.ends);
            if chunk.is_some() {
                return Ok(chunk);
            }
        }
        Ok(None)
    }

    /// Returns the state between two chunks.
    pub fn state(&mut self) -> Result<CollectorState, ActError> {
        Ok(CollectorState {
            acting: self.acting.state()?,
            next_chunk_numbers: self.recorder.next_chunk_numbers(),
        })
    }

    /// Restores a state saved with the same settings. With the same weights, the next chunks are the same.
    pub fn restore(&mut self, state: CollectorState) -> Result<(), ActError> {
        self.acting.restore(state.acting)?;
        self.recorder.resume_at(state.next_chunk_numbers);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use driml_model::{Compute, Parameters};

    use super::*;
    use crate::config::EpsilonLadder;

    const ENVS: u32 = 32;
    const STEPS: u32 = 32;
    const FIRST: Incarnation = Incarnation::first(3, 1);

    /// The preset `smoke` on the chain, with more environments and a constant epsilon.
    fn settings(epsilon: f64) -> ActorSettings {
        let smoke = include_str!("../../tests/decoders/fuzz/corpus/config/chain");
        let mut settings = ActorSettings::from_toml(smoke).unwrap();
        let actor = &mut settings.actor;
        (actor.envs, actor.steps_per_chunk) = (ENVS, STEPS);
        (actor.epsilon_start, actor.epsilon_end) = (epsilon, epsilon);
        settings
    }

    fn collector(settings: ActorSettings, incarnation: Incarnation) -> Result<Collector, ActError> {
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let weights = Parameters::init(&settings.model, rng, &Compute::CPU.device).unwrap();
        let weights = weights.to_safetensors(|_| true).unwrap();
        Collector::new(&settings, BufferPool::new(1), incarnation, 1, &weights)
    }

    #[test]
    fn a_chunk_that_is_broken_off_is_dropped_and_not_counted() {
        let mut collector = collector(settings(0.0), FIRST).unwrap();
        let checks = std::cell::Cell::new(0);
        let is_stopped = || checks.replace(checks.get() + 1) == 3;
        let chunk = collector.collect_unless(is_stopped, 0, STEPS).unwrap();
        assert!(chunk.is_none() && checks.get() == 4);
        assert_eq!(collector.transitions_recorded(), 0);
    }

    /// The actions of an incarnation's first chunk.
    fn actions(settings: ActorSettings, incarnation: Incarnation) -> Vec<u8> {
        let mut collector = collector(settings, incarnation).unwrap();
        let chunk = collector.collect(0, STEPS).unwrap();
        assert_eq!(chunk.actions().len(), (ENVS * STEPS) as usize);
        chunk.actions().to_vec()
    }

    #[test]
    fn a_restarted_actor_does_not_repeat_its_own_random_numbers() {
        let random = |incarnation| actions(settings(1.0), incarnation);
        let first = random(FIRST);
        assert_eq!(random(Incarnation { id: 2, ..FIRST }), first);
        let at = |after_updates, earlier_incarnations| Incarnation {
            after_updates,
            earlier_incarnations,
            ..FIRST
        };
        let incarnations = [
            FIRST,
            at(0, 1),
            at(0, 2),
            Incarnation { actor: 2, ..FIRST },
            at(7, 0),
            at(7, 1),
            at((1 << 32) + 7, 0),
            at(1 << 32, 1),
            at(1 << 52, 0),
            at(u64::MAX, 0),
        ];
        let spec = settings(1.0).spec;
        let mut seen = Vec::new();
        for incarnation in incarnations {
            let seeded = (
                random(incarnation),
                incarnation.seed(&spec, "world"),
                incarnation.seed(&spec, "exploration"),
            );
            assert_ne!(seeded.1, seeded.2);
            let repeats = |earlier: &(Vec<u8>, [u8; 32], [u8; 32])| {
                earlier.0 == seeded.0 || earlier.1 == seeded.1 || earlier.2 == seeded.2
            };
            assert!(!seen.iter().any(repeats), "{incarnation:?}");
            seen.push(seeded);
        }
        // The first incarnation seeds its world by the actor's number as the index, as in earlier versions.
        assert_eq!(FIRST.seed(&spec, "world"), spec.seed_for("world", 3));
    }

    #[test]
    fn an_actor_explores_by_its_own_rung_of_the_ladder() {
        let greedy = actions(settings(0.0), FIRST);
        let ladder = |base, actors| {
            let mut settings = settings(0.0);
            settings.actor.epsilon_ladder = Some(EpsilonLadder {
                base,
                alpha: 1.0,
                actors,
            });
            settings
        };
        assert_ne!(actions(ladder(0.999, 8), FIRST), greedy);
        assert_eq!(actions(ladder(1e-12, 8), FIRST), greedy);
        assert!(collector(ladder(0.5, 3), FIRST).is_err());
    }
}
