//! Packs steps into numbered chunks, writing each frame once, straight into the memory from which it is sent.
//! It does not send the chunks.

use driml_envs::StepEnd;
use driml_protocol::{BufferPool, Chunk, ChunkHeader, End};

const fn wire_end(end: StepEnd) -> End {
    match end {
        StepEnd::Running => End::Running,
        StepEnd::LevelChange => End::LevelChange,
        StepEnd::TimedOut => End::TimedOut,
        StepEnd::Terminal => End::Terminal,
    }
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
    /// Creates a recorder for `num_envs` environments. [`ChunkRecorder::begin_chunk`] sets the length of each chunk.
    pub fn new(
        pool: BufferPool,
        actor: u32,
        incarnation: u64,
        num_envs: u32,
        frame_bytes: u32,
    ) -> Self {
        let header = ChunkHeader {
            actor,
            incarnation,
            streams: num_envs,
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
    pub fn begin_chunk(&mut self, weights_version: u64, steps: u32) {
        assert!(
            self.chunk.is_none(),
            "one chunk, one version of the weights"
        );
        self.header.weights_version = weights_version;
        self.header.steps = steps;
    }

    /// The number of transitions in all completed chunks.
    pub const fn transitions_recorded(&self) -> u64 {
        self.header.first_transition
    }

    /// Returns the number of the next chunk in its incarnation, and the number of transitions before it.
    ///
    /// # Panics
    /// If a chunk is being filled.
    pub fn next_chunk_numbers(&self) -> (u64, u64) {
        assert!(self.chunk.is_none(), "a chunk is kept whole or not at all");
        (self.header.sequence, self.header.first_transition)
    }

    /// Continues with the numbers of another recorder of the same incarnation.
    pub fn resume_at(&mut self, next_chunk_numbers: (u64, u64)) {
        (self.header.sequence, self.header.first_transition) = next_chunk_numbers;
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
            Chunk::with_buffer(header, pool.take(bytes))
        });
        let frame_bytes = header.frame_bytes as usize;
        for (env, frame) in frames.chunks_exact(frame_bytes).enumerate() {
            let row = env * header.steps as usize + self.filled_steps as usize;
            chunk.frame_mut(row).copy_from_slice(frame);
            let end = wire_end(ends[env]);
            chunk.set(row, actions[env], rewards[env], end);
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
                recorder.begin_chunk(u64::from(step), 3);
            }
            chunks.extend(recorder.record(&[step, 100 + step], &[step, step], &[0.5, -1.0], &ends));
        }
        assert_eq!(recorder.transitions_recorded(), 12);

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
