//! Frames of Procgen, recorded once, or black ones, from which benches make transitions.
//! It keeps no time: recording is not measured.

use std::path::Path;

use anyhow::Context;
use driml_envs::{ActionSet, RestrictedWorld, StepEnd};
use driml_launch::console;
use driml_protocol::{BufferPool, Chunk, ChunkHeader, End};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::settings;

/// The life of the actor whose chunks are made of it.
pub(super) const INCARNATION: u64 = 1;
/// Environments, each a stream of transitions.
const STREAMS: usize = 8;
/// Steps of each environment; then the recording begins again.
const STEPS: usize = 256;

/// Chunks that are measured. An actor of 16 environments sends the last.
pub(super) const CHUNKS: [ChunkShape; 4] = [
    ChunkShape::new(4, 1),
    ChunkShape::new(8, 4),
    ChunkShape::new(8, 16),
    ChunkShape::new(8, 32),
];

/// Streams and steps of a chunk.
#[derive(Clone, Copy, Debug)]
pub(super) struct ChunkShape {
    streams: u32,
    steps: u32,
}

impl ChunkShape {
    /// The first `streams` of [`STREAMS`].
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
    /// [STEPS, STREAMS, frame bytes].
    frames: Vec<u8>,
    /// Action, reward and end of each step [STEPS, STREAMS].
    steps: Vec<(u8, f32, End)>,
}

impl Recording {
    pub(super) fn play() -> anyhow::Result<Self> {
        procgen_sys::Engine::install(&mut console::line)?;
        let config = settings::of_run(settings::WORLD, "c51", "paper", &[])?;
        let run = &config.run;
        let sent = (run.frame_height as usize, run.frame_width as usize);
        let whole = config.world.build(STREAMS, 1, 0)?;
        let mut world = RestrictedWorld::of(whole, config.world.actions(ActionSet::All), sent)?;
        let frame_bytes = world.frame_shape().bytes();
        let mut frames = vec![0; STEPS * STREAMS * frame_bytes];
        let mut steps = Vec::with_capacity(STEPS * STREAMS);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (mut rewards, mut ends) = ([0.0; STREAMS], [StepEnd::Running; STREAMS]);
        for frames in frames.chunks_exact_mut(STREAMS * frame_bytes) {
            world.observe(frames);
            let actions: [u8; STREAMS] =
                std::array::from_fn(|_| rng.random_range(0..world.num_actions()) as u8);
            world.step(&actions, &mut rewards, &mut ends)?;
            for ((action, reward), end) in actions.into_iter().zip(rewards).zip(ends) {
                let end = End::from_byte(end as u8).expect("both enums have the same ends");
                steps.push((action, reward, end));
            }
        }
        Ok(Self {
            frame_bytes,
            frames,
            steps,
        })
    }

    /// Black frames of so many bytes; an episode is as long as the recording.
    pub(super) fn blank(frame_bytes: usize) -> Self {
        let end = |step| match step + 1 == STEPS {
            true => End::Terminal,
            false => End::Running,
        };
        let steps = (0..STEPS).flat_map(|step| [(0, 0.0, end(step)); STREAMS]);
        Self {
            frame_bytes,
            frames: vec![0; STEPS * STREAMS * frame_bytes],
            steps: steps.collect(),
        }
    }

    /// Writes the frames, raw, for a process that is not ours.
    pub(super) fn write_frames(&self, path: &Path) -> anyhow::Result<()> {
        std::fs::write(path, &self.frames).with_context(|| format!("writing {}", path.display()))
    }

    /// Chunk after chunk of one actor, each of `shape` and in memory of `pool`; the recording plays round and round.
    pub(super) fn chunks(&self, actor: u32, shape: ChunkShape, pool: BufferPool) -> Chunks<'_> {
        let ChunkShape { streams, steps } = shape;
        Chunks {
            recording: self,
            pool,
            next: ChunkHeader {
                actor,
                incarnation: INCARNATION,
                weights_version: 1,
                streams,
                steps,
                frame_bytes: self.frame_bytes as u32,
                ..ChunkHeader::default()
            },
        }
    }
}

/// An actor's chunks without end, each filled anew as a real actor's are.
pub(super) struct Chunks<'a> {
    recording: &'a Recording,
    pool: BufferPool,
    next: ChunkHeader,
}

impl Chunks<'_> {
    /// Transitions in all chunks so far.
    pub(super) const fn transitions(&self) -> u64 {
        self.next.first_transition
    }

    pub(super) fn next_chunk(&mut self) -> Chunk {
        let recording = self.recording;
        let bytes = self.next.payload_bytes();
        let bytes = bytes.expect("a chunk of a bench is far below the address space");
        let mut chunk = Chunk::in_memory(self.next, self.pool.take(bytes));
        let (streams, steps) = (self.next.streams as usize, self.next.steps as usize);
        let first_step = self.next.first_transition as usize / streams;
        for row in 0..streams * steps {
            let step = first_step + row % steps;
            let from = step % STEPS * STREAMS + row / steps;
            let frame = &recording.frames[from * recording.frame_bytes..];
            let frame = &frame[..recording.frame_bytes];
            chunk.frame_mut(row).copy_from_slice(frame);
            let (action, reward, end) = recording.steps[from];
            chunk.set(row, action, reward, end);
        }
        self.next.sequence += 1;
        self.next.first_transition += chunk.header.transitions() as u64;
        chunk
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_are_consecutive_steps_of_each_stream() {
        let place = |i: usize| [(i / STREAMS) as u8, (i % STREAMS) as u8];
        let recording = Recording {
            frame_bytes: 2,
            frames: (0..STEPS * STREAMS).flat_map(place).collect(),
            steps: vec![(1, 0.5, End::Running); STEPS * STREAMS],
        };
        let mut chunks = recording.chunks(3, ChunkShape::new(2, 3), BufferPool::new(1));
        let (first, second) = (chunks.next_chunk(), chunks.next_chunk());
        assert_eq!(first.frames(), [0, 0, 1, 0, 2, 0, 0, 1, 1, 1, 2, 1]);
        assert_eq!(second.frames(), [3, 0, 4, 0, 5, 0, 3, 1, 4, 1, 5, 1]);
        let numbers = [first, second].map(|it| (it.header.sequence, it.header.first_transition));
        assert_eq!((numbers, chunks.transitions()), ([(0, 0), (1, 6)], 12));
    }
}
