//! How the frames of the transitions held are kept: plain, or compressed without loss.
//! It knows neither links, episodes nor stacks, and it never stores a frame twice.

use std::{collections::VecDeque, sync::Arc};

use super::{
    pack::{Block, Run},
    reserve,
};
use crate::config::Compression;

pub(crate) enum Frames {
    Plain(PlainFrames),
    Compressed(CompressedFrames),
}

impl Frames {
    /// Room for the frames of `capacity` transitions; compressed ones take `bytes_max` bytes at most, if there is a limit. An error
    /// gives the bytes that the system refuses to reserve.
    pub(crate) fn new(
        compression: Compression,
        capacity: u64,
        frame_bytes: usize,
        bytes_max: Option<u64>,
    ) -> Result<Self, u64> {
        match compression {
            Compression::None => PlainFrames::new(capacity, frame_bytes).map(Self::Plain),
            Compression::Lz4 => Ok(Self::Compressed(CompressedFrames::new(bytes_max))),
        }
    }

    /// Stores the frames of the next transitions, the first of which has this slot, and may drop those before `oldest`. Gives
    /// the oldest that is held.
    pub(crate) fn push(&mut self, run: Run<'_>, slot: usize, oldest: u64) -> u64 {
        match (self, run) {
            (Self::Plain(frames), Run::Plain(run)) => {
                frames.push(run, slot);
                oldest
            }
            (Self::Compressed(frames), Run::Packed(run)) => frames.push(run, oldest),
            _ => panic!("a chunk was packed for a replay with another compression"),
        }
    }

    pub(crate) fn bytes_held(&self) -> u64 {
        match self {
            Self::Plain(frames) => frames.bytes.len() as u64,
            Self::Compressed(frames) => frames.bytes_held(),
        }
    }

    /// Lets go of all frames; the next one has the first slot.
    pub(crate) fn clear(&mut self) {
        match self {
            Self::Plain(frames) => frames.bytes.clear(),
            // A block begins where the last ended, the first one at what `push` is told.
            Self::Compressed(frames) => frames.forget_before(u64::MAX),
        }
    }

    /// The frames before that of `oldest` are no longer wanted.
    pub(crate) fn forget_before(&mut self, oldest: u64) {
        match self {
            // Their places are taken again in turn.
            Self::Plain(_) => {}
            Self::Compressed(frames) => frames.forget_before(oldest),
        }
    }

    /// Checks that the transitions `oldest..inserted`, of those from `first` on, have their frames; panics if not. Slow: for tests.
    pub(crate) fn check_valid(&self, first: u64, oldest: u64, inserted: u64) {
        match self {
            Self::Plain(frames) => {
                // One frame a transition, until they are overwritten.
                let held = (inserted - first).min(frames.capacity);
                assert_eq!(self.bytes_held(), held * frames.frame_bytes as u64);
            }
            Self::Compressed(frames) => frames.check_valid(oldest, inserted),
        }
    }
}

/// The newest `capacity` frames as they came, in one buffer, each in the slot of its transition.
pub(crate) struct PlainFrames {
    capacity: u64,
    frame_bytes: usize,
    bytes: Vec<u8>,
}

impl PlainFrames {
    /// An empty buffer for `capacity` frames. An error gives the bytes that the system refuses to reserve.
    pub(crate) fn new(capacity: u64, frame_bytes: usize) -> Result<Self, u64> {
        Ok(Self {
            capacity,
            frame_bytes,
            bytes: reserve(capacity.saturating_mul(frame_bytes as u64))?,
        })
    }

    /// Stores frames from `slot` on, over the oldest ones once the buffer is full.
    pub(crate) fn push(&mut self, mut frames: &[u8], slot: usize) {
        let capacity_bytes = self.capacity as usize * self.frame_bytes;
        let mut at = slot * self.frame_bytes;
        while !frames.is_empty() {
            let (now, rest) = frames.split_at(frames.len().min(capacity_bytes - at));
            if at == self.bytes.len() {
                self.bytes.extend_from_slice(now);
            } else {
                self.bytes[at..][..now.len()].copy_from_slice(now);
            }
            (frames, at) = (rest, 0);
        }
    }

    /// The frame in a slot, which must be held.
    pub(crate) fn frame(&self, slot: usize) -> &[u8] {
        &self.bytes[slot * self.frame_bytes..][..self.frame_bytes]
    }
}

/// A block among those held.
struct Held {
    first: u64,
    block: Arc<Block>,
}

impl Held {
    fn end(&self) -> u64 {
        self.first + self.block.frames as u64
    }
}

/// The frames of the newest transitions as compressed blocks, the oldest first, which go in the order in which they came.
///
/// Memory: the blocks held, of which the oldest may be overwritten in part, and at most 96 bytes for each.
/// A block that would not become smaller is kept as it came, so noise takes no more than plain frames and that.
pub(crate) struct CompressedFrames {
    bytes_max: u64,
    /// Of all blocks.
    bytes: u64,
    blocks: VecDeque<Held>,
}

impl CompressedFrames {
    /// Nothing yet, and never more than `bytes_max` bytes, beside the 96 a block.
    pub(crate) fn new(bytes_max: Option<u64>) -> Self {
        Self {
            bytes_max: bytes_max.unwrap_or(u64::MAX),
            bytes: 0,
            blocks: VecDeque::new(),
        }
    }

    /// Stores the next transitions' frames; those before `oldest` go, and as many more as the bytes allowed demand.
    ///
    /// Gives the oldest transition whose frame is held.
    pub(crate) fn push(&mut self, run: &[Arc<Block>], mut oldest: u64) -> u64 {
        for block in run {
            let bytes = block.bytes.len() as u64;
            self.forget_before(oldest);
            while self.bytes + bytes > self.bytes_max
                && let Some(held) = self.blocks.front()
            {
                oldest = held.end();
                self.forget_before(oldest);
            }
            self.bytes += bytes;
            self.blocks.push_back(Held {
                first: self.blocks.back().map_or(oldest, Held::end),
                block: Arc::clone(block),
            });
        }
        oldest
    }

    pub(crate) fn forget_before(&mut self, oldest: u64) {
        while let Some(held) = self.blocks.front().filter(|it| it.end() <= oldest) {
            self.bytes -= held.block.bytes.len() as u64;
            self.blocks.pop_front();
        }
    }

    /// The block that holds the frame of `index`, and which of its frames that is.
    pub(crate) fn block(&self, index: u64) -> (&Arc<Block>, usize) {
        let after = self.blocks.partition_point(|it| it.first <= index);
        let held = &self.blocks[after - 1];
        (&held.block, (index - held.first) as usize)
    }

    pub(crate) fn bytes_held(&self) -> u64 {
        // Behind an `Arc` a block has two counts.
        let block = size_of::<Block>() + 2 * size_of::<usize>();
        let queue = self.blocks.capacity() * size_of::<Held>();
        self.bytes + (self.blocks.len() * block + queue) as u64
    }

    pub(crate) fn check_valid(&self, oldest: u64, inserted: u64) {
        assert!(self.bytes <= self.bytes_max, "too many bytes");
        let mut next = self.blocks.front().map_or(oldest, |it| it.first);
        let mut bytes = 0;
        for held in &self.blocks {
            assert_eq!(held.first, next, "no gaps");
            next = held.end();
            bytes += held.block.bytes.len() as u64;
        }
        assert_eq!(next, inserted, "every transition has a frame");
        assert_eq!(bytes, self.bytes, "the bytes of all blocks");
        if let Some(held) = self.blocks.front() {
            let holds_oldest = (held.first..held.end()).contains(&oldest);
            assert!(holds_oldest, "what is overwritten is gone");
        }
    }
}
