//! Procgen frames that are recorded once, or black frames, from which benches make transitions.
//! The loop and the recorder are those of an actor. Recording is not timed.

use std::path::Path;

use anyhow::Context;
use driml_actor::{ActingLoop, ChunkRecorder, RandomPolicy};
use driml_envs::{ActionSet, RestrictedWorld, StepEnd};
use driml_launch::console;
use driml_protocol::{BufferPool, Chunk};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::settings;

/// The incarnation of the actor whose chunks are made from a recording.
pub(super) const INCARNATION: u64 = 1;
/// The number of environments, each a stream of transitions.
const STREAMS: usize = 8;
/// The number of steps of each environment; then the recording begins again.
const STEPS: usize = 256;

/// The shapes of the measured chunks. An actor of 16 environments sends the last.
pub(super) const CHUNKS: [ChunkShape; 4] = [
    ChunkShape::new(4, 1),
    ChunkShape::new(8, 4),
    ChunkShape::new(8, 16),
    ChunkShape::new(8, 32),
];

#[derive(Clone, Copy, Debug)]
pub(super) struct ChunkShape {
    streams: u32,
    steps: u32,
}

impl ChunkShape {
    /// Returns the shape of chunks from the first `streams` of the [`STREAMS`] environments.
    pub(super) const fn new(streams: u32, steps: u32) -> Self {
        assert!(streams as usize <= STREAMS);
        Self { streams, steps }
    }

    pub(super) const fn transitions(self) -> u32 {
        self.streams * self.steps
    }
}

/// Transitions of [`STREAMS`] environments of bigfish under a random policy, for [`STEPS`] steps.
pub(super) struct Recording {
    pub(super) frame_bytes: usize,
    steps: Vec<Step>,
}

/// One step of all environments: frames [`STREAMS`, frame bytes], and an action, a reward and an end for each.
struct Step {
    frames: Vec<u8>,
    actions: Vec<u8>,
    rewards: Vec<f32>,
    ends: Vec<StepEnd>,
}

impl Recording {
    pub(super) fn record() -> anyhow::Result<Self> {
        procgen_sys::Engine::install(&mut console::eprintln)?;
        let config = settings::run_config(settings::WORLD, "c51", "paper", &[])?;
        let sent = config.run.frame_size();
        let whole = config.world.build(STREAMS, 1, 0)?;
        let world = RestrictedWorld::wrap(whole, config.world.actions(ActionSet::All), sent)?;
        let frame_bytes = world.frame_shape().bytes();
        let mut policy = RandomPolicy::new(world.num_actions() as u8);
        let mut acting = ActingLoop::new(world, 1, ChaCha8Rng::seed_from_u64(1));
        let mut steps = Vec::with_capacity(STEPS);
        for _ in 0..STEPS {
            let step = acting.step(&mut policy, 0.0)?;
            steps.push(Step {
                frames: step.frames.to_vec(),
                actions: step.actions.to_vec(),
                rewards: step.rewards.to_vec(),
                ends: step.ends.to_vec(),
            });
        }
        Ok(Self { frame_bytes, steps })
    }

    /// Returns a recording of black frames of `frame_bytes` bytes; an episode is as long as the recording.
    pub(super) fn blank(frame_bytes: usize) -> Self {
        let step = |number: usize| Step {
            frames: vec![0; STREAMS * frame_bytes],
            actions: vec![0; STREAMS],
            rewards: vec![0.0; STREAMS],
            ends: match number + 1 == STEPS {
                true => vec![StepEnd::Terminal; STREAMS],
                false => vec![StepEnd::Running; STREAMS],
            },
        };
        let steps = (0..STEPS).map(step).collect();
        Self { frame_bytes, steps }
    }

    /// Writes the raw frames [`STEPS`, `STREAMS`, frame bytes] to a file, for the process of a peer.
    pub(super) fn write_frames(&self, path: &Path) -> anyhow::Result<()> {
        let frames: Vec<&[u8]> = self.steps.iter().map(|it| &it.frames[..]).collect();
        std::fs::write(path, frames.concat()).with_context(|| format!("writing {}", path.display()))
    }

    /// Returns a function that fills the next chunk of an actor anew, as real actors do: of `shape`, in memory of `pool`. The recording
    /// repeats endlessly.
    pub(super) fn chunks(
        &self,
        actor: u32,
        shape: ChunkShape,
        pool: BufferPool,
    ) -> impl FnMut() -> Chunk {
        let (streams, bytes) = (shape.streams, self.frame_bytes);
        let mut recorder = ChunkRecorder::new(pool, actor, INCARNATION, streams, bytes as u32);
        recorder.begin_chunk(1, shape.steps);
        let mut steps = self.steps.iter().cycle();
        move || {
            let chunk = steps.find_map(|it| {
                let frames = &it.frames[..streams as usize * bytes];
                recorder.record(frames, &it.actions, &it.rewards, &it.ends)
            });
            chunk.expect("a recording that plays round and round has no end")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_are_consecutive_steps_of_each_stream() {
        let mut recording = Recording::blank(2);
        for (number, step) in (0..=u8::MAX).zip(&mut recording.steps) {
            let frames = (0..STREAMS as u8).flat_map(|stream| [number, stream]);
            step.frames = frames.collect();
        }
        let mut next_chunk = recording.chunks(3, ChunkShape::new(2, 3), BufferPool::new(1));
        let (first, second) = (next_chunk(), next_chunk());
        assert_eq!(first.frames(), [0, 0, 1, 0, 2, 0, 0, 1, 1, 1, 2, 1]);
        assert_eq!(second.frames(), [3, 0, 4, 0, 5, 0, 3, 1, 4, 1, 5, 1]);
        let numbers = [first, second].map(|it| (it.header.sequence, it.header.first_transition));
        assert_eq!(numbers, [(0, 0), (1, 6)]);
    }
}
