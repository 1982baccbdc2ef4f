//! A batch that left the replay with its frames still compressed, and their unpacking, for which nothing is locked.
//! It draws nothing: which frames a row needs was decided before.

use std::ops::Range;

use driml_protocol::{Batch, BatchStatesMut};
use lz4_flex::block::{decompress_into, decompress_into_with_dict};

use crate::storage::{
    frame_store::{
        Frames,
        compressed::{BlockPart, CompressedFrames},
    },
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

/// Copies of the parts of blocks that a batch's frames need, row by row.
pub(crate) struct PackedFrames {
    frame_bytes: usize,
    rows: Vec<PackedRow>,
    /// Indices in the ring, and places in the batch.
    frames: Vec<(u64, usize)>,
    parts: Vec<PackedPart>,
    bytes: Vec<u8>,
}

/// The frames that a row is the first to need, and the parts with all of them.
struct PackedRow {
    frames: Range<usize>,
    parts: Range<usize>,
}

struct PackedPart {
    transitions: Range<u64>,
    place: Range<usize>,
    /// The transition whose frame is its dictionary; none for a key. It is a part of the same row, further ahead.
    key: Option<u64>,
}

impl PackedFrames {
    /// No rows yet, of frames of this size.
    pub(crate) fn new(frame_bytes: usize) -> Self {
        Self {
            frame_bytes,
            rows: Vec::new(),
            frames: Vec::new(),
            parts: Vec::new(),
            bytes: Vec::new(),
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
                    places.frame(place).copy_from_slice(frames.frame(index));
                }
            }
            Frames::Compressed(frames) => self.take_row(frames, row),
        }
    }

    /// Takes what the next row needs; a part that several of its frames share is taken once.
    fn take_row(&mut self, frames: &CompressedFrames, row: impl Iterator<Item = (u64, usize)>) {
        let (first_frame, first_part) = (self.frames.len(), self.parts.len());
        for (index, place) in row {
            self.frames.push((index, place));
            if self.has(first_part, index) {
                continue;
            }
            let (key, part) = frames.parts(index);
            let key_index = key.transitions.start;
            if !self.has(first_part, key_index) {
                self.take(key, None);
            }
            if let Some(part) = part {
                self.take(part, Some(key_index));
            }
        }
        self.rows.push(PackedRow {
            frames: first_frame..self.frames.len(),
            parts: first_part..self.parts.len(),
        });
    }

    /// Whether the frame of `index` is among the parts from `first_part` on.
    fn has(&self, first_part: usize, index: u64) -> bool {
        let mut taken = self.parts[first_part..].iter();
        taken.any(|part| part.transitions.contains(&index))
    }

    fn take(&mut self, part: BlockPart<'_>, key: Option<u64>) {
        let start = self.bytes.len();
        self.bytes.extend_from_slice(part.bytes);
        self.parts.push(PackedPart {
            transitions: part.transitions,
            place: start..self.bytes.len(),
            key,
        });
    }

    /// Unpacks every row's parts and writes its frames.
    fn write(&self, batch: &mut Batch) {
        let mut places = batch.states_mut();
        let mut unpacked = Vec::new();
        for row in &self.rows {
            let parts = &self.parts[row.parts.clone()];
            self.unpack(parts, &mut unpacked);
            for &(index, place) in &self.frames[row.frames.clone()] {
                let frame = self.frame(parts, &unpacked, index);
                places.frame(place).copy_from_slice(frame);
            }
        }
    }

    /// Unpacks parts into `out`, one after the other.
    fn unpack(&self, parts: &[PackedPart], out: &mut Vec<u8>) {
        let length = parts.iter().map(|part| self.length(part)).sum();
        if out.len() < length {
            out.resize(length, 0);
        }
        let mut done = 0;
        for part in parts {
            let stored = &self.bytes[part.place.clone()];
            let (before, rest) = out.split_at_mut(done);
            let to = &mut rest[..self.length(part)];
            done += to.len();
            if stored.len() == to.len() {
                to.copy_from_slice(stored);
                continue;
            }
            let length = match part.key {
                None => decompress_into(stored, to),
                Some(key) => decompress_into_with_dict(stored, to, self.frame(parts, before, key)),
            };
            let length = length.expect("we packed this part");
            assert_eq!(length, to.len(), "a part has all its frames");
        }
    }

    /// The frame of `index` among unpacked parts.
    fn frame<'a>(&self, parts: &[PackedPart], unpacked: &'a [u8], index: u64) -> &'a [u8] {
        let mut start = 0;
        for part in parts {
            if part.transitions.contains(&index) {
                start += (index - part.transitions.start) as usize * self.frame_bytes;
                return &unpacked[start..start + self.frame_bytes];
            }
            start += self.length(part);
        }
        unreachable!("the part with frame {index} was taken with its row")
    }

    /// Bytes of a part's frames.
    fn length(&self, part: &PackedPart) -> usize {
        (part.transitions.end - part.transitions.start) as usize * self.frame_bytes
    }
}
