//! What a block is made of: consecutive frames of one stream, of which the first is the key of the others.
//! It neither compresses nor stores.
//!
//! A block's parts are LZ4 blocks of their own: the key alone, then a few frames each with the key as LZ4's dictionary. To
//! read a frame, its part and the key are unpacked and no more. There are no differences between frames: LZ4 finds what
//! frames have in common also where the picture scrolls, where differences would destroy it.

use std::ops::Range;

/// Longest part before compression, unless one frame is longer: three frames of Procgen.
///
/// Longer parts compress better, shorter ones are faster to take a single frame from.
const PART_BYTES_MAX: usize = 36 << 10;
/// Parts of a block beside its key: with three frames each, a block has 16 frames, as an actor's chunk has steps.
const PARTS_MAX: usize = 5;

/// Bytes up to the end of each part of a block, from its start; 0 for parts that it does not have.
pub(crate) type PartEnds = [u32; 1 + PARTS_MAX];

#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    pub(crate) frame_bytes: usize,
    /// Frames of each part but the key; the last part may have fewer.
    part_frames: usize,
}

impl Layout {
    pub(crate) fn new(frame_bytes: usize) -> Self {
        Self {
            frame_bytes,
            part_frames: (PART_BYTES_MAX / frame_bytes).max(1),
        }
    }

    /// Most frames of a block.
    pub(crate) const fn block_frames_max(&self) -> usize {
        1 + PARTS_MAX * self.part_frames
    }

    /// Parts of a block of `frames` frames, key included.
    pub(crate) const fn parts(&self, frames: usize) -> usize {
        1 + (frames - 1).div_ceil(self.part_frames)
    }

    /// The part that holds a frame of the block; 0 is the key.
    pub(crate) const fn part_of(&self, frame: usize) -> usize {
        frame.div_ceil(self.part_frames)
    }

    /// The frames of one part of a block of `frames` frames.
    pub(crate) fn frames_of(&self, part: usize, frames: usize) -> Range<usize> {
        match part {
            0 => 0..1,
            _ => {
                let start = 1 + (part - 1) * self.part_frames;
                start..(start + self.part_frames).min(frames)
            }
        }
    }
}
