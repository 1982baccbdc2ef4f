//! Frames as compressed blocks, the oldest first, which go in the order in which they came.
//! It packs and unpacks nothing: that is done without the replay locked.

use std::{collections::VecDeque, sync::Arc};

use super::pack::Block;

struct Held {
    first: u64,
    block: Arc<Block>,
}

impl Held {
    fn end(&self) -> u64 {
        self.first + self.block.frames as u64
    }
}

/// The frames of the newest transitions.
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
