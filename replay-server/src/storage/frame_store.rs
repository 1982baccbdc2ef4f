//! Stores the frames of the transitions held: plain, or compressed without loss.
//! It knows no links, episodes or frame stacks, and it never stores a frame twice.

use std::{collections::VecDeque, sync::Arc};

use super::{
    pack::{Block, StreamFrames},
    reserve,
};
use crate::config::Compression;

pub(crate) enum FrameStore {
    Plain(PlainFrames),
    Compressed(CompressedFrames),
}

impl FrameStore {
    /// Creates a store for the frames of `capacity` transitions. Compressed frames take at most `bytes_max` bytes, if given. An error holds
    /// the bytes that the system does not grant.
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

    /// Stores the frames of the next transitions, the first in `slot`. May drop the frames before transition `oldest`. Returns the oldest
    /// transition whose frame is held.
    pub(crate) fn push(&mut self, new: StreamFrames<'_>, slot: usize, oldest: u64) -> u64 {
        match (self, new) {
            (Self::Plain(frames), StreamFrames::Plain(new)) => {
                frames.push(new, slot);
                oldest
            }
            (Self::Compressed(frames), StreamFrames::Packed(new)) => frames.push(new, oldest),
            _ => panic!("a chunk was packed for a replay with another compression"),
        }
    }

    pub(crate) fn bytes_held(&self) -> u64 {
        match self {
            Self::Plain(frames) => frames.bytes.len() as u64,
            Self::Compressed(frames) => frames.bytes_held(),
        }
    }

    /// Drops all frames. The next frame must go into slot 0.
    pub(crate) fn clear(&mut self) {
        match self {
            Self::Plain(frames) => frames.bytes.clear(),
            // Each block begins where the last one ends, the first one at the `oldest` that `push` is given.
            Self::Compressed(frames) => frames.forget_before(u64::MAX),
        }
    }

    /// Drops the frames of transitions before `oldest`, if that frees memory.
    pub(crate) fn forget_before(&mut self, oldest: u64) {
        match self {
            // New frames overwrite them in turn.
            Self::Plain(_) => {}
            Self::Compressed(frames) => frames.forget_before(oldest),
        }
    }

    /// Panics unless the transitions `oldest..inserted` have their frames; `first` is the first that was ever stored. Slow: for tests.
    pub(crate) fn check_valid(&self, first: u64, oldest: u64, inserted: u64) {
        match self {
            Self::Plain(frames) => {
                // One frame per transition, until frames are overwritten.
                let held = (inserted - first).min(frames.capacity);
                assert_eq!(self.bytes_held(), held * frames.frame_bytes as u64);
            }
            Self::Compressed(frames) => frames.check_valid(oldest, inserted),
        }
    }
}

/// The newest `capacity` frames, uncompressed in one buffer, each in the slot of its transition.
pub(crate) struct PlainFrames {
    capacity: u64,
    frame_bytes: usize,
    bytes: Vec<u8>,
}

impl PlainFrames {
    /// Creates an empty buffer for `capacity` frames. An error holds the bytes that the system does not grant.
    pub(crate) fn new(capacity: u64, frame_bytes: usize) -> Result<Self, u64> {
        Ok(Self {
            capacity,
            frame_bytes,
            bytes: reserve(capacity.saturating_mul(frame_bytes as u64))?,
        })
    }

    /// Stores frames from `slot` on. Once the buffer is full, they overwrite the oldest ones.
    pub(crate) fn push(&mut self, mut frames: &[u8], slot: usize) {
        let capacity_bytes = self.capacity as usize * self.frame_bytes;
        let mut at = slot * self.frame_bytes;
        while !frames.is_empty() {
            let (part, rest) = frames.split_at(frames.len().min(capacity_bytes - at));
            if at == self.bytes.len() {
                self.bytes.extend_from_slice(part);
            } else {
                self.bytes[at..][..part.len()].copy_from_slice(part);
            }
            (frames, at) = (rest, 0);
        }
    }

    /// The frame in a slot, which must be held.
    pub(crate) fn frame(&self, slot: usize) -> &[u8] {
        &self.bytes[slot * self.frame_bytes..][..self.frame_bytes]
    }
}

/// A block that is held, with the index of its first transition.
struct HeldBlock {
    first: u64,
    block: Arc<Block>,
}

impl HeldBlock {
    fn end(&self) -> u64 {
        self.first + self.block.frames as u64
    }
}

/// The frames of the newest transitions as compressed blocks, oldest first. The oldest block is dropped first.
///
/// Memory: the blocks held, and at most 96 bytes of overhead for each. Some frames of the oldest block may belong to dropped transitions.
/// A part that would not shrink is stored uncompressed, so noise takes no more than plain frames and the overhead.
pub(crate) struct CompressedFrames {
    bytes_max: u64,
    /// The bytes of all blocks.
    bytes: u64,
    blocks: VecDeque<HeldBlock>,
}

impl CompressedFrames {
    /// Creates an empty store for at most `bytes_max` bytes, plus 96 bytes per block.
    pub(crate) fn new(bytes_max: Option<u64>) -> Self {
        Self {
            bytes_max: bytes_max.unwrap_or(u64::MAX),
            bytes: 0,
            blocks: VecDeque::new(),
        }
    }

    /// Stores the next transitions' frames. Drops those before `oldest`, and more of the oldest if `bytes_max` requires it.
    ///
    /// Returns the oldest transition whose frame is held.
    pub(crate) fn push(&mut self, new: &[Arc<Block>], mut oldest: u64) -> u64 {
        for block in new {
            let bytes = block.bytes.len() as u64;
            self.forget_before(oldest);
            while self.bytes + bytes > self.bytes_max
                && let Some(held) = self.blocks.front()
            {
                oldest = held.end();
                self.forget_before(oldest);
            }
            self.bytes += bytes;
            self.blocks.push_back(HeldBlock {
                first: self.blocks.back().map_or(oldest, HeldBlock::end),
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

    /// Returns the block that holds the frame of transition `index`, and the frame's position in the block.
    pub(crate) fn block(&self, index: u64) -> (&Arc<Block>, usize) {
        let after = self.blocks.partition_point(|it| it.first <= index);
        let held = &self.blocks[after - 1];
        (&held.block, (index - held.first) as usize)
    }

    pub(crate) fn bytes_held(&self) -> u64 {
        // An `Arc` adds two reference counts to a block.
        let block = size_of::<Block>() + 2 * size_of::<usize>();
        let queue = self.blocks.capacity() * size_of::<HeldBlock>();
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
