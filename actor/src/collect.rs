//! One actor's work without its network connections: act with the newest weights, give chunk after chunk.
//! The processes and the lockstep mode run this same code; it neither sends nor waits.

use anyhow::Context;
use driml_protocol::{Chunk, PlanesPool};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    acting::Acting, config::ActorSettings, policy::NetworkPolicy, recorder::Recorder, schedule,
};

/// Which actor this is, and which life of it.
#[derive(Clone, Copy, Debug)]
pub struct Life {
    /// Its number, unique in the run.
    pub actor: u32,
    /// Tells this life of it from others; it does not influence what is computed.
    pub epoch: u64,
    /// Updates after which the run goes on: a resumed run does not play the episodes of its start again.
    pub after_updates: u64,
}

/// An actor that collects.
pub struct Collector {
    settings: ActorSettings,
    acting: Acting,
    recorder: Recorder,
    policy: NetworkPolicy,
    weights_version: u64,
}

impl Collector {
    /// Makes the world and the policy with its first weights; chunks lie in memory of `pool`.
    ///
    /// # Errors
    /// A world that cannot be made or does not fit the run spec, or weights that do not fit the model.
    pub fn new(
        settings: ActorSettings,
        pool: PlanesPool,
        life: Life,
        weights_version: u64,
        safetensors: &[u8],
    ) -> anyhow::Result<Self> {
        let spec = &settings.spec;
        let config = &settings.actor;
        let stream = u64::from(life.actor) | life.after_updates << u32::BITS;
        let world_seed = spec.seed_for("world", stream);
        let world = driml_envs::make_world(
            &settings.world,
            config.envs as usize,
            u64::from_le_bytes(world_seed[..8].try_into().expect("eight bytes")),
            config.world_threads as usize,
        )
        .with_context(|| format!("making the world {}", spec.world))?;
        let shape = world.frame_shape();
        let promised = (
            spec.frame_height,
            spec.frame_width,
            spec.frame_channels,
            spec.num_actions,
        );
        let given = (
            shape.height as u32,
            shape.width as u32,
            shape.channels as u32,
            world.num_actions() as u32,
        );
        anyhow::ensure!(
            promised == given,
            "the world {} gives (height, width, channels, actions) {given:?}, the run spec promises {promised:?}: \
             write the run's settings anew with `driml local`",
            spec.world
        );
        let rng = ChaCha8Rng::from_seed(spec.seed_for("exploration", stream));
        let policy = NetworkPolicy::new(&settings.model, (shape.height, shape.width), safetensors)?;
        Ok(Self {
            acting: Acting::new(world, spec.frame_stack as usize, rng)?,
            recorder: Recorder::new(
                pool,
                life.actor,
                life.epoch,
                config.envs,
                spec.frame_bytes() as u32,
            ),
            policy,
            weights_version,
            settings,
        })
    }

    /// Acts with other weights from the next chunk on; on an error the old ones stay.
    ///
    /// # Errors
    /// Weights that do not fit the model.
    pub fn set_weights(&mut self, version: u64, safetensors: &[u8]) -> anyhow::Result<()> {
        self.policy.load(safetensors)?;
        self.weights_version = version;
        Ok(())
    }

    /// Transitions collected so far.
    pub const fn produced(&self) -> u64 {
        self.recorder.produced()
    }

    /// Acts until one chunk of `steps` steps is full. `frames` is the run's count so far, which fixes epsilon for the chunk.
    ///
    /// # Errors
    /// The policy or the world failed.
    pub fn collect(&mut self, frames: u64, steps: u32) -> anyhow::Result<Chunk> {
        self.recorder.begin(self.weights_version, steps);
        let epsilon = schedule::epsilon(&self.settings.actor, frames);
        loop {
            let step = self.acting.step(&mut self.policy, epsilon)?;
            if let Some(chunk) =
                self.recorder
                    .record(step.frames, step.actions, step.rewards, step.ends)
            {
                return Ok(chunk);
            }
        }
    }
}
