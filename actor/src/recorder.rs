//! Turns steps into numbered chunks, writing each frame once, straight to where it travels from.
//! It does not send them.

use driml_envs::StepEnd;
use driml_protocol::{Chunk, ChunkHeader, End, PlanesPool};

/// What a world ended, in the words of the wire.
pub const fn end_on_the_wire(end: StepEnd) -> End {
    match end {
        StepEnd::Running => End::Running,
        StepEnd::LevelChange => End::LevelChange,
        StepEnd::TimedOut => End::TimedOut,
        StepEnd::Terminal => End::Terminal,
    }
}

/// Fills chunk after chunk.
#[derive(Debug)]
pub struct Recorder {
    pool: PlanesPool,
    header: ChunkHeader,
    chunk: Chunk,
    filled_steps: u32,
}

impl Recorder {
    /// A recorder for `streams` copies whose chunks have `steps` steps each.
    ///
    /// # Panics
    /// If a chunk would be larger than the address space.
    pub fn new(
        pool: PlanesPool,
        actor: u32,
        epoch: u64,
        streams: u32,
        steps: u32,
        frame_bytes: u32,
    ) -> Self {
        let header = ChunkHeader {
            actor,
            epoch,
            sequence: 0,
            first_transition: 0,
            weights_version: 0,
            leaving: false,
            streams,
            steps,
            frame_bytes,
        };
        Self {
            header,
            chunk: fresh(&pool, header),
            pool,
            filled_steps: 0,
        }
    }

    /// Stamps the chunk being filled with the weights that act in it; only before its first step.
    pub fn set_weights_version(&mut self, version: u64) {
        assert_eq!(
            self.filled_steps, 0,
            "one chunk, one version of the weights"
        );
        self.header.weights_version = version;
        self.chunk.header.weights_version = version;
    }

    /// Transitions recorded so far, including those of the chunk being filled.
    pub const fn produced(&self) -> u64 {
        self.header.first_transition + self.filled_steps as u64 * self.header.streams as u64
    }

    /// Records one step of every copy: frames [N, frame bytes] in which `actions` [N] were taken, and what came of it.
    ///
    /// Gives the chunk that this step completed, if it did.
    pub fn record(
        &mut self,
        frames: &[u8],
        actions: &[u8],
        rewards: &[f32],
        ends: &[StepEnd],
    ) -> Option<Chunk> {
        let frame_bytes = self.header.frame_bytes as usize;
        for (stream, frame) in frames.chunks_exact(frame_bytes).enumerate() {
            let row = stream * self.header.steps as usize + self.filled_steps as usize;
            self.chunk.frame_mut(row).copy_from_slice(frame);
            self.chunk.set(
                row,
                actions[stream],
                rewards[stream],
                end_on_the_wire(ends[stream]),
            );
        }
        self.filled_steps += 1;
        (self.filled_steps == self.header.steps).then(|| self.next_chunk())
    }

    fn next_chunk(&mut self) -> Chunk {
        self.header.first_transition = self.produced();
        self.header.sequence += 1;
        self.filled_steps = 0;
        std::mem::replace(&mut self.chunk, fresh(&self.pool, self.header))
    }
}

fn fresh(pool: &PlanesPool, header: ChunkHeader) -> Chunk {
    let bytes = header
        .planes_bytes()
        .expect("an actor's chunk is far below the address space");
    Chunk::in_memory(header, pool.take(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_are_numbered_and_stream_major() {
        let mut recorder = Recorder::new(PlanesPool::new(1), 7, 9, 2, 3, 1);
        let ends = [StepEnd::Running, StepEnd::Terminal];
        let mut chunks = Vec::new();
        for step in 0..7_u8 {
            if step % 3 == 0 {
                recorder.set_weights_version(u64::from(step));
            }
            chunks.extend(recorder.record(&[step, 100 + step], &[step, step], &[0.5, -1.0], &ends));
        }
        assert_eq!(recorder.produced(), 14);

        assert_eq!(chunks[0].frames(), [0, 1, 2, 100, 101, 102]);
        assert_eq!(chunks[1].frames(), [3, 4, 5, 103, 104, 105]);
        assert_eq!(chunks[1].actions(), [3, 4, 5, 3, 4, 5]);
        assert_eq!((chunks[1].reward(0), chunks[1].reward(3)), (0.5, -1.0));
        assert_eq!(
            (chunks[1].end(0), chunks[1].end(3)),
            (End::Running, End::Terminal)
        );
        let numbers = chunks.iter().map(|c| {
            (
                c.header.sequence,
                c.header.first_transition,
                c.header.weights_version,
            )
        });
        assert_eq!(numbers.collect::<Vec<_>>(), [(0, 0, 0), (1, 6, 3)]);
    }
}
