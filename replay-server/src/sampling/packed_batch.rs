//! A batch that left the replay with its frames still compressed, and their unpacking, for which nothing is locked.
//! It draws nothing: which frames a row needs was decided before.

use std::{ops::Range, sync::Arc};

use driml_protocol::{Batch, BatchStatesMut};

use crate::storage::{
    frame_store::{Block, Frames, Layout},
    ring::Ring,
};

/// A batch, complete but for frames that are still to be unpacked.
#[must_use]
pub struct PackedBatch {
    pub(crate) batch: Batch,
    pub(crate) layout: Layout,
    /// Row by row; none if the batch has its frames.
    pub(crate) packed: Vec<PackedFrame>,
    /// k of each row, of several the furthest; 0 where there is none.
    pub(crate) ks: Vec<u32>,
}

/// A frame that a batch needs: the first row that needs it, where the ring holds it, and its place in the batch.
pub(crate) struct NeededFrame {
    pub(crate) row: usize,
    pub(crate) index: u64,
    pub(crate) place: usize,
}

/// A needed frame that is compressed, by its number in its block.
pub(crate) struct PackedFrame {
    row: usize,
    place: usize,
    block: Arc<Block>,
    number: usize,
}

/// Writes frames into their places where the ring holds them plain; takes what is needed to write them later where they are compressed.
pub(crate) fn write_or_take(
    ring: &Ring,
    needed: &[NeededFrame],
    places: &mut BatchStatesMut<'_>,
) -> Vec<PackedFrame> {
    match ring.frames() {
        Frames::Plain(frames) => {
            for &NeededFrame { index, place, .. } in needed {
                let frame = frames.frame(ring.slot(index));
                places.frame(place).copy_from_slice(frame);
            }
            Vec::new()
        }
        Frames::Compressed(frames) => {
            let packed = |&NeededFrame { row, index, place }: &NeededFrame| {
                let (block, number) = frames.block(index);
                PackedFrame {
                    row,
                    place,
                    block: block.clone(),
                    number,
                }
            };
            needed.iter().map(packed).collect()
        }
    }
}

impl PackedBatch {
    /// The batch; with compression this is where most of the work is.
    pub fn unpack(self) -> Batch {
        let Self {
            mut batch,
            layout,
            packed,
            ..
        } = self;
        let mut places = batch.states_mut();
        let mut unpacked = Unpacked {
            layout,
            parts: Vec::new(),
            bytes: Vec::new(),
        };
        // Each part once a row: rows seldom share them.
        for row in packed.chunk_by(|one, next| one.row == next.row) {
            unpacked.parts.clear();
            for frame in row {
                let part = layout.part_of(frame.number);
                let first = layout.frames_of(part, frame.block.frames).start;
                let at = unpacked.part(&frame.block, part);
                let at = at + (frame.number - first) * layout.frame_bytes;
                let bytes = &unpacked.bytes[at..at + layout.frame_bytes];
                places.frame(frame.place).copy_from_slice(bytes);
            }
        }
        batch
    }
}

/// Parts of blocks, unpacked one after the other.
struct Unpacked<'a> {
    layout: Layout,
    parts: Vec<Part<'a>>,
    /// Longer than the parts are, where there were others before.
    bytes: Vec<u8>,
}

struct Part<'a> {
    block: &'a Block,
    number: usize,
    place: Range<usize>,
}

impl<'a> Unpacked<'a> {
    /// Where a part of a block begins; it is unpacked if it was not before.
    fn part(&mut self, block: &'a Block, number: usize) -> usize {
        let is_it = |it: &&Part<'_>| std::ptr::eq(it.block, block) && it.number == number;
        if let Some(known) = self.parts.iter().find(is_it) {
            return known.place.start;
        }
        let frame_bytes = self.layout.frame_bytes;
        let key = (number > 0).then(|| self.part(block, 0));
        let start = self.parts.last().map_or(0, |it| it.place.end);
        let length = self.layout.frames_of(number, block.frames).len() * frame_bytes;
        let place = start..start + length;
        if self.bytes.len() < place.end {
            self.bytes.resize(place.end, 0);
        }
        let (before, rest) = self.bytes.split_at_mut(start);
        let key = key.map_or(0..0, |at| at..at + frame_bytes);
        block.unpack(number, &before[key], &mut rest[..length]);
        self.parts.push(Part {
            block,
            number,
            place,
        });
        start
    }
}
