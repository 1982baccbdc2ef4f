//! Draws the rows of a batch and puts it together: anchors by `rows`, each row by `episodes`, and the frames that they need, each once.
//! Frames that are compressed leave the replay so, and are unpacked while nothing is locked.
//! Whether a batch may be drawn is for the rate limiter.

use std::{collections::HashMap, iter, ops::Range, sync::Arc};

use driml_protocol::{Batch, BatchHeader, BatchStatesMut, Buffer, RunSpec, Sampling};
use rand_chacha::ChaCha8Rng;

use super::{
    episodes::{Assembler, Episodes, Window},
    horizon::Affinity,
    rows::{RowSampler, prioritised::Priorities, uniform::Uniform},
};
use crate::storage::{
    frame_store::Frames,
    pack::{Block, Layout},
    ring::Ring,
};

/// Everything that drawing needs beside the ring and the generator.
pub(crate) struct BatchSampler {
    pub(crate) rows: Box<dyn RowSampler>,
    episodes: Episodes,
    assembler: Assembler,
    window: Window,
    layout: Layout,
}

impl BatchSampler {
    /// The sampler of a ring of `capacity` transitions; an error gives the bytes that the system refuses to reserve.
    pub(crate) fn new(spec: &RunSpec, sampling: &Sampling, capacity: u64) -> Result<Self, u64> {
        let episodes = Episodes::new(spec);
        let rows: Box<dyn RowSampler> = match *sampling {
            Sampling::Uniform {} => Box::new(Uniform::new(episodes)),
            Sampling::Prioritised { alpha, .. } => {
                Box::new(Priorities::new(alpha, capacity, episodes)?)
            }
        };
        Ok(Self {
            episodes,
            rows,
            assembler: Assembler::new(spec),
            window: Window::default(),
            layout: Layout::new(spec.frame_bytes()),
        })
    }

    /// A batch of as many rows as `header` says, whose mean age and weights are filled in here; none if there is no anchor.
    pub(crate) fn draw(
        &mut self,
        ring: &Ring,
        affinity: &Affinity,
        rng: &mut ChaCha8Rng,
        mut header: BatchHeader,
        memory: impl FnOnce(usize) -> Buffer,
    ) -> Option<PackedBatch> {
        let rows = header.rows as usize;
        let (mut scalars, mut anchors) = (Vec::with_capacity(rows), Vec::with_capacity(rows));
        // Of all rows, each row's in the order of `BatchStatesMut::of_row`.
        let mut states: Vec<RowState> = Vec::new();
        let mut age_total = 0;
        for row in 0..rows {
            if !self.rows.draw(ring, rng, &mut self.window) {
                return None;
            }
            let window = &self.window;
            let (of_row, bootstrap) = self.assembler.row(affinity, window, rng);
            let ks = of_row.ks().map(|k| k as usize);
            let steps = iter::once(0).chain(bootstrap).chain(ks);
            states.extend(steps.map(|i| RowState {
                row,
                index: window.index(i),
            }));
            scalars.push(of_row);
            anchors.push(window.index(0));
            age_total += ring.inserted() - 1 - window.index(0);
            let version = window.step(0).weights_version;
            let (newest, oldest) = header.weights_versions;
            header.weights_versions = (newest.max(version), oldest.min(version));
        }
        header.mean_age = age_total as f64 / rows as f64;
        let shared = header.stacked.as_mut().map(|stacked| {
            let shared = SharedFrames::of(ring, &self.episodes, &states);
            stacked.frames = shared.frames.len() as u32;
            shared
        });
        let mut batch = Batch::of_rows(header, &scalars, memory);
        // All by the masses that are there now: to find that one was no anchor any more makes the others more likely.
        let probability = |anchor| {
            let probability = self.rows.probability(anchor)? as f32;
            Some((anchor, probability.clamp(f32::MIN_POSITIVE, 1.0)))
        };
        let draws = anchors.into_iter().map(probability);
        if let Some(draws) = draws.collect::<Option<Vec<_>>>() {
            batch.set_draws(&draws);
        }
        let mut places = batch.states_mut();
        let numbers: Vec<usize> = (0..rows).flat_map(|row| places.of_row(row)).collect();
        let frames: Vec<NeededFrame> = match shared {
            None => {
                let frame = |(RowState { row, index }, place)| NeededFrame { row, index, place };
                states.into_iter().zip(numbers).map(frame).collect()
            }
            Some(SharedFrames { frames, stacks }) => {
                let stacks = stacks.chunks_exact(self.episodes.frame_stack);
                for (number, stack) in numbers.into_iter().zip(stacks) {
                    places.set_stack(number, stack);
                }
                frames
            }
        };
        let packed = write_or_take(ring, &frames, &mut places);
        let ks = scalars.iter().map(|row| row.ks().max().unwrap_or(0));
        Some(PackedBatch {
            batch,
            layout: self.layout,
            packed,
            ks: ks.collect(),
        })
    }
}

/// A state that a row has, by where the ring holds its newest frame.
struct RowState {
    row: usize,
    index: u64,
}

/// The distinct frames of stacked states, in the order in which rows need them: states of a row share them, and now and then rows do.
/// A frame is known by where the ring holds it: two that look the same are two.
struct SharedFrames {
    frames: Vec<NeededFrame>,
    /// The frames of each state, oldest first, by their places.
    stacks: Vec<u32>,
}

impl SharedFrames {
    fn of(ring: &Ring, episodes: &Episodes, states: &[RowState]) -> Self {
        let (mut frames, mut stacks) = (Vec::new(), Vec::new());
        let mut places = HashMap::new();
        for &RowState { row, index } in states {
            for index in episodes.stack(ring, index) {
                let place = places.entry(index).or_insert_with(|| {
                    let place = frames.len();
                    frames.push(NeededFrame { row, index, place });
                    place as u32
                });
                stacks.push(*place);
            }
        }
        Self { frames, stacks }
    }
}

/// A batch, complete but for frames that are still to be unpacked.
#[must_use]
pub struct PackedBatch {
    pub(crate) batch: Batch,
    layout: Layout,
    /// Row by row; none if the batch has its frames.
    packed: Vec<PackedFrame>,
    /// k of each row, of several the furthest; 0 where there is none.
    pub(crate) ks: Vec<u32>,
}

/// A frame that a batch needs: the first row that needs it, where the ring holds it, and its place in the batch.
struct NeededFrame {
    row: usize,
    index: u64,
    place: usize,
}

/// A needed frame that is compressed, by its number in its block.
struct PackedFrame {
    row: usize,
    place: usize,
    block: Arc<Block>,
    number: usize,
}

/// Writes frames into their places where the ring holds them plain; takes what is needed to write them later where they are compressed.
fn write_or_take(
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
