//! Frames as compressed blocks, one after the other in a log; the oldest go in the order in which they came.
//! It packs and unpacks nothing: that is done without the replay locked.

use std::{collections::VecDeque, ops::Range};

use super::{
    layout::{Layout, PartEnds},
    log::{Log, OVERHEAD_BYTES_MAX},
    pack::PackedRun,
};

/// Consecutive transitions of one stream, and where their frames are.
struct Block {
    first: u64,
    start: u64,
    part_ends: PartEnds,
    frames: u32,
}

impl Block {
    /// The transition after the last.
    const fn end(&self) -> u64 {
        self.first + self.frames as u64
    }
}

/// Frames that are unpacked together, and where they are in the log.
pub(crate) struct BlockPart {
    pub(crate) transitions: Range<u64>,
    place: Range<u64>,
}

/// The frames of the newest transitions.
///
/// Memory: the blocks held, of which the oldest may be overwritten in part, 48 bytes for each, and [`OVERHEAD_BYTES_MAX`].
/// A block that would not become smaller is kept as it came, so noise takes no more than plain frames and that.
pub(crate) struct CompressedFrames {
    layout: Layout,
    /// Most bytes of blocks.
    blocks_bytes_max: u64,
    log: Log,
    blocks: VecDeque<Block>,
}

impl CompressedFrames {
    /// Nothing yet, and never more than `bytes_max` bytes, [`OVERHEAD_BYTES_MAX`] included and the 48 a block not.
    pub(crate) fn new(frame_bytes: usize, bytes_max: Option<u64>) -> Self {
        let blocks_bytes_max =
            bytes_max.map_or(u64::MAX, |max| max.saturating_sub(OVERHEAD_BYTES_MAX));
        Self {
            layout: Layout::new(frame_bytes),
            blocks_bytes_max,
            log: Log::default(),
            blocks: VecDeque::new(),
        }
    }

    /// Stores the next transitions' frames; those before `oldest` go, and as many more as the bytes allowed demand.
    ///
    /// Gives the oldest transition whose frame is held.
    pub(crate) fn push(&mut self, run: &PackedRun, mut oldest: u64) -> u64 {
        let mut bytes = run.bytes.as_slice();
        for packed in &run.blocks {
            let length = packed.part_ends[self.layout.parts(packed.frames) - 1];
            let stored = bytes
                .split_off(..length as usize)
                .expect("a run has its blocks' bytes");
            while let Some(block) = self.blocks.front() {
                let room = self.log.len() + u64::from(length) <= self.blocks_bytes_max;
                if block.end() > oldest && room {
                    break;
                }
                oldest = oldest.max(block.end());
                self.log.release(self.place_end(block));
                self.blocks.pop_front();
            }
            self.blocks.push_back(Block {
                first: self.blocks.back().map_or(oldest, Block::end),
                start: self.log.append(stored),
                part_ends: packed.part_ends,
                frames: packed.frames as u32,
            });
        }
        oldest
    }

    /// Lets go of the blocks that end before `oldest`.
    pub(crate) fn forget_before(&mut self, oldest: u64) {
        while let Some(block) = self.blocks.front().filter(|it| it.end() <= oldest) {
            self.log.release(self.place_end(block));
            self.blocks.pop_front();
        }
    }

    /// The key of the block that holds `index`, and the part with its frame, unless that is the key.
    pub(crate) fn parts(&self, index: u64) -> (BlockPart, Option<BlockPart>) {
        let after = self.blocks.partition_point(|block| block.first <= index);
        let block = &self.blocks[after - 1];
        let part = self.layout.part_of((index - block.first) as usize);
        (
            self.part(block, 0),
            (part > 0).then(|| self.part(block, part)),
        )
    }

    fn part(&self, block: &Block, part: usize) -> BlockPart {
        let frames = self.layout.frames_of(part, block.frames as usize);
        let end = |part: usize| block.start + u64::from(block.part_ends[part]);
        BlockPart {
            transitions: block.first + frames.start as u64..block.first + frames.end as u64,
            place: part.checked_sub(1).map_or(block.start, end)..end(part),
        }
    }

    fn place_end(&self, block: &Block) -> u64 {
        let parts = self.layout.parts(block.frames as usize);
        self.part(block, parts - 1).place.end
    }

    /// Copies a part, still packed, to the end of `out`.
    pub(crate) fn copy(&self, part: &BlockPart, out: &mut Vec<u8>) {
        self.log.copy(part.place.clone(), out);
    }

    pub(crate) fn bytes_held(&self) -> u64 {
        self.log.bytes_held() + (self.blocks.capacity() * size_of::<Block>()) as u64
    }

    pub(crate) fn check_valid(&self, oldest: u64, inserted: u64) {
        assert!(self.log.len() <= self.blocks_bytes_max, "too many bytes");
        let mut place = self.log.start();
        let first = self.blocks.front().map_or(oldest, |block| block.first);
        let mut next = first;
        for block in &self.blocks {
            assert_eq!((block.first, block.start), (next, place), "no gaps");
            for part in 0..self.layout.parts(block.frames as usize) {
                let part = self.part(block, part);
                let begins = (part.transitions.start, part.place.start);
                assert_eq!(begins, (next, place), "no gaps");
                let frames_bytes = (part.transitions.end - next) * self.layout.frame_bytes as u64;
                let bytes = part.place.end - place;
                assert!(bytes <= frames_bytes, "no part is larger than its frames");
                (next, place) = (part.transitions.end, part.place.end);
            }
        }
        assert_eq!(next, inserted, "every transition has a frame");
        let end = self.log.start() + self.log.len();
        assert_eq!(place, end, "no bytes are left over");
        if let Some(block) = self.blocks.front() {
            let holds_oldest = (block.first..block.end()).contains(&oldest);
            assert!(holds_oldest, "what is overwritten is gone");
        }
    }
}
