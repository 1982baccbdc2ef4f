//! Packs steps into numbered chunks, writing each frame once, straight into the memory from which it is sent.
//! It does not send the chunks.

use driml_envs::StepEnd;
use driml_protocol::{BufferPool, Chunk, ChunkHeader, End};
use serde::{Deserialize, Serialize};

/// Converts the end of a step to its wire format.
const fn end_on_the_wire(end: StepEnd) -> End {
    match end {
        StepEnd::Running => End::Running,
        StepEnd::LevelChange => End::LevelChange,
        StepEnd::TimedOut => End::TimedOut,
        StepEnd::Terminal => End::Terminal,
    }
}

/// The number of a chunk in its incarnation, and the number of transitions before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChunkNumbers {
    sequence: u64,
    first_transition: u64,
}

/// Records steps into one chunk after another.
#[derive(Debug)]
pub struct ChunkRecorder {
    pool: BufferPool,
    /// The header of the chunk being filled, or of the next one.
    header: ChunkHeader,
    /// The chunk being filled; `None` between two chunks.
    chunk: Option<Chunk>,
    filled_steps: u32,
}

impl ChunkRecorder {
    /// Creates a recorder for `streams` environments. [`ChunkRecorder::begin`] sets the length of each chunk.
    pub fn new(
        pool: BufferPool,
        actor: u32,
        incarnation: u64,
        streams: u32,
        frame_bytes: u32,
    ) -> Self {
        let header = ChunkHeader {
            actor,
            incarnation,
            streams,
            steps: 1,
            frame_bytes,
            ..ChunkHeader::default()
        };
        Self {
            header,
            chunk: None,
            pool,
            filled_steps: 0,
        }
    }

    /// Sets the weights' version and the number of steps of the next chunk, before its first step.
    ///
    /// # Panics
    /// If a chunk is being filled.
    pub fn begin(&mut self, weights_version: u64, steps: u32) {
        assert!(
            self.chunk.is_none(),
            "one chunk, one version of the weights"
        );
        self.header.weights_version = weights_version;
        self.header.steps = steps;
    }

    /// The number of transitions in all completed chunks.
    pub const fn produced(&self) -> u64 {
        self.header.first_transition
    }

    /// Returns the numbers of the next chunk, between two chunks.
    ///
    /// # Panics
    /// If a chunk is being filled.
    pub fn next_chunk(&self) -> ChunkNumbers {
        assert!(self.chunk.is_none(), "a chunk is kept whole or not at all");
        ChunkNumbers {
            sequence: self.header.sequence,
            first_transition: self.header.first_transition,
        }
    }

    /// Continues with the numbers of another recorder of the same incarnation.
    pub fn go_on_at(&mut self, next: ChunkNumbers) {
        self.header.sequence = next.sequence;
        self.header.first_transition = next.first_transition;
    }

    /// Records one step of every environment: the `frames` [N, frame bytes] in which `actions` [N] were taken, `rewards` and `ends` [N].
    ///
    /// Returns the chunk that this step completed, if any.
    pub fn record(
        &mut self,
        frames: &[u8],
        actions: &[u8],
        rewards: &[f32],
        ends: &[StepEnd],
    ) -> Option<Chunk> {
        let (pool, header) = (&self.pool, self.header);
        let chunk = self.chunk.get_or_insert_with(|| {
            let bytes = header.payload_bytes();
            let bytes = bytes.expect("an actor's chunk is far below the address space");
            Chunk::in_memory(header, pool.take(bytes))
        });
        let frame_bytes = header.frame_bytes as usize;
        for (stream, frame) in frames.chunks_exact(frame_bytes).enumerate() {
            let row = stream * header.steps as usize + self.filled_steps as usize;
            chunk.frame_mut(row).copy_from_slice(frame);
            let end = end_on_the_wire(ends[stream]);
            chunk.set(row, actions[stream], rewards[stream], end);
        }
        self.filled_steps += 1;
        if self.filled_steps < self.header.steps {
            return None;
        }
        self.header.first_transition += header.transitions() as u64;
        self.header.sequence += 1;
        self.filled_steps = 0;
        self.chunk.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_are_numbered_and_stream_major() {
        let mut recorder = ChunkRecorder::new(BufferPool::new(1), 7, 9, 2, 1);
        let ends = [StepEnd::Running, StepEnd::Terminal];
        let mut chunks = Vec::new();
        for step in 0..7_u8 {
            if step % 3 == 0 {
                recorder.begin(u64::from(step), 3);
            }
            chunks.extend(recorder.record(&[step, 100 + step], &[step, step], &[0.5, -1.0], &ends));
        }
        assert_eq!(recorder.produced(), 12);

        assert_eq!(chunks[0].frames(), [0, 1, 2, 100, 101, 102]);
        assert_eq!(chunks[1].frames(), [3, 4, 5, 103, 104, 105]);
        assert_eq!(chunks[1].actions(), [3, 4, 5, 3, 4, 5]);
        assert_eq!((chunks[1].reward(0), chunks[1].reward(3)), (0.5, -1.0));
        let ends = [0, 3].map(|row| chunks[1].end(row));
        assert_eq!(ends, [End::Running, End::Terminal]);
        let headers = chunks.iter().map(|chunk| chunk.header);
        let numbers = headers.map(|it| (it.sequence, it.first_transition, it.weights_version));
        assert_eq!(numbers.collect::<Vec<_>>(), [(0, 0, 0), (1, 6, 3)]);
    }
}
