//! A batch that left the replay with its frames still compressed, and their unpacking, for which nothing is locked.
//! It draws nothing: which frames a row needs was decided before.

use std::{ops::Range, sync::Arc};

use driml_protocol::{Batch, BatchStatesMut};
use lz4_flex::block::{decompress_into, decompress_into_with_dict};

use crate::storage::{
    frame_store::{Block, Frames, Layout},
    ring::Ring,
};

/// A batch, complete but for frames that are still to be unpacked.
#[must_use]
pub struct PackedBatch {
    pub(crate) batch: Batch,
    /// No rows if the batch has its frames.
    pub(crate) packed: PackedFrames,
    /// k of each row, of several the furthest; 0 where there is none.
    pub(crate) ks: Vec<u32>,
}

impl PackedBatch {
    /// The batch; with compression this is where most of the work is.
    pub fn unpack(self) -> Batch {
        let Self {
            mut batch, packed, ..
        } = self;
        packed.write(&mut batch);
        batch
    }
}

/// The compressed frames that a batch needs, row by row.
pub(crate) struct PackedFrames {
    layout: Layout,
    frames: Vec<PackedFrame>,
    /// How many of them the rows up to each are the first to need.
    row_ends: Vec<usize>,
}

/// A frame, by its number in its block, and its place in the batch.
struct PackedFrame {
    place: usize,
    block: Arc<Block>,
    number: usize,
}

impl PackedFrames {
    /// No rows yet, of frames of this size.
    pub(crate) fn new(frame_bytes: usize) -> Self {
        Self {
            layout: Layout::new(frame_bytes),
            frames: Vec::new(),
            row_ends: Vec::new(),
        }
    }

    /// Writes the frames of the next row, indices in the ring and places in the batch, where frames are plain; takes what is needed
    /// to write them later where they are compressed.
    pub(crate) fn write_or_take_row(
        &mut self,
        ring: &Ring,
        row: impl Iterator<Item = (u64, usize)>,
        places: &mut BatchStatesMut<'_>,
    ) {
        match ring.frames() {
            Frames::Plain(frames) => {
                for (index, place) in row {
                    let frame = frames.frame(ring.slot(index));
                    places.frame(place).copy_from_slice(frame);
                }
            }
            Frames::Compressed(frames) => {
                self.frames.extend(row.map(|(index, place)| {
                    let (block, number) = frames.block(index);
                    PackedFrame {
                        place,
                        block: block.clone(),
                        number,
                    }
                }));
                self.row_ends.push(self.frames.len());
            }
        }
    }

    fn write(&self, batch: &mut Batch) {
        let mut places = batch.states_mut();
        let (layout, mut start) = (self.layout, 0);
        let mut unpacked = Unpacked {
            layout,
            parts: Vec::new(),
            bytes: Vec::new(),
        };
        for &end in &self.row_ends {
            unpacked.parts.clear();
            for frame in &self.frames[start..end] {
                let part = layout.part_of(frame.number);
                let first = layout.frames_of(part, frame.block.frames).start;
                let at = unpacked.part(&frame.block, part);
                let at = at + (frame.number - first) * layout.frame_bytes;
                let bytes = &unpacked.bytes[at..at + layout.frame_bytes];
                places.frame(frame.place).copy_from_slice(bytes);
            }
            start = end;
        }
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
        let (stored, to) = (block.part(number), &mut rest[..length]);
        if stored.len() == length {
            to.copy_from_slice(stored);
        } else {
            let unpacked = match key {
                None => decompress_into(stored, to),
                Some(key) => decompress_into_with_dict(stored, to, &before[key..][..frame_bytes]),
            };
            let unpacked = unpacked.expect("we packed this part");
            assert_eq!(unpacked, length, "a part has all its frames");
        }
        self.parts.push(Part {
            block,
            number,
            place,
        });
        start
    }
}
