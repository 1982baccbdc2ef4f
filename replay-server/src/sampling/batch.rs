//! Draws and assembles a batch: `rows` draws the anchors, `episodes` computes each row, and stacked states share their frames.
//! Compressed frames leave the replay compressed, and are unpacked without a lock.
//! The rate limiter decides whether a batch may be drawn.

use std::{collections::HashMap, iter, ops::Range, sync::Arc};

use driml_protocol::{Batch, BatchHeader, BatchStatesMut, Buffer, RunSpec, Sampling};
use rand_chacha::ChaCha8Rng;

use super::{
    episodes::{AnchorRules, RowAssembler, Window},
    horizon::Affinity,
    rows::{RowSampler, prioritised::PrioritisedSampler, uniform::UniformSampler},
};
use crate::storage::{
    frame_store::FrameStore,
    pack::{Block, BlockLayout},
    ring::Ring,
};

/// The state that drawing needs besides the ring and the random generator.
pub(crate) struct BatchSampler {
    pub(crate) rows: Box<dyn RowSampler>,
    rules: AnchorRules,
    assembler: RowAssembler,
    window: Window,
    layout: BlockLayout,
}

impl BatchSampler {
    /// Creates the sampler of a ring of `capacity` transitions. An error holds the bytes that the system does not grant.
    pub(crate) fn new(spec: &RunSpec, sampling: &Sampling, capacity: u64) -> Result<Self, u64> {
        let rules = AnchorRules::new(spec);
        let rows: Box<dyn RowSampler> = match *sampling {
            Sampling::Uniform {} => Box::new(UniformSampler::new(rules)),
            Sampling::Prioritised { alpha, .. } => {
                Box::new(PrioritisedSampler::new(alpha, capacity, rules)?)
            }
        };
        Ok(Self {
            rules,
            rows,
            assembler: RowAssembler::new(spec),
            window: Window::default(),
            layout: BlockLayout::new(spec.frame_bytes()),
        })
    }

    /// Draws a batch of `header.rows` rows. Sets the header's mean age and weights versions. `None` if no anchor exists.
    pub(crate) fn draw(
        &mut self,
        ring: &Ring,
        affinity: &Affinity,
        rng: &mut ChaCha8Rng,
        mut header: BatchHeader,
        alloc: impl FnOnce(usize) -> Buffer,
    ) -> Option<PackedBatch> {
        let rows = header.rows as usize;
        let (mut scalars, mut anchors) = (Vec::with_capacity(rows), Vec::with_capacity(rows));
        // The states of all rows; those of a row are in the order of `BatchStatesMut::of_row`.
        let mut states: Vec<RowState> = Vec::new();
        let mut age_total = 0;
        for row in 0..rows {
            if !self.rows.draw(ring, rng, &mut self.window) {
                return None;
            }
            let window = &self.window;
            let (row_scalars, bootstrap) = self.assembler.assemble(affinity, window, rng);
            let ks = row_scalars.ks().map(|k| k as usize);
            let steps = iter::once(0).chain(bootstrap).chain(ks);
            states.extend(steps.map(|i| RowState {
                row,
                index: window.index(i),
            }));
            scalars.push(row_scalars);
            anchors.push(window.index(0));
            age_total += ring.inserted() - 1 - window.index(0);
            let version = window.step(0).weights_version;
            let (newest, oldest) = header.weights_versions;
            header.weights_versions = (newest.max(version), oldest.min(version));
        }
        header.mean_age = age_total as f64 / rows as f64;
        let shared = header.stacked.as_mut().map(|stacked| {
            let shared = SharedFrames::collect(ring, &self.rules, &states);
            stacked.frames = shared.frames.len() as u32;
            shared
        });
        let mut batch = Batch::from_rows(header, &scalars, alloc);
        // Computed after all draws: a draw that finds an invalid anchor zeroes its mass, which makes the others more likely.
        let probability = |anchor| {
            let probability = self.rows.probability(anchor)? as f32;
            Some((anchor, probability.clamp(f32::MIN_POSITIVE, 1.0)))
        };
        let draws = anchors.into_iter().map(probability);
        if let Some(draws) = draws.collect::<Option<Vec<_>>>() {
            batch.set_draws(&draws);
        }
        let mut target = batch.states_mut();
        let numbers: Vec<usize> = (0..rows).flat_map(|row| target.row_states(row)).collect();
        let frames: Vec<NeededFrame> = match shared {
            None => {
                let frame = |(RowState { row, index }, place)| NeededFrame { row, index, place };
                states.into_iter().zip(numbers).map(frame).collect()
            }
            Some(SharedFrames { frames, stacks }) => {
                let stacks = stacks.chunks_exact(self.rules.frame_stack);
                for (number, stack) in numbers.into_iter().zip(stacks) {
                    target.set_stack(number, stack);
                }
                frames
            }
        };
        let packed_frames = write_or_defer(ring, &frames, &mut target);
        let ks = scalars.iter().map(|row| row.ks().max().unwrap_or(0));
        Some(PackedBatch {
            batch,
            layout: self.layout,
            packed_frames,
            ks: ks.collect(),
        })
    }
}

/// A state of a row, with the ring index of its newest frame.
struct RowState {
    row: usize,
    index: u64,
}

/// The distinct frames of stacked states, in the order in which rows need them. States of a row share frames, and sometimes rows do.
/// The ring index identifies a frame: frames at two indices are distinct even if they look the same.
struct SharedFrames {
    frames: Vec<NeededFrame>,
    /// The places of each state's frames in the batch, oldest first.
    stacks: Vec<u32>,
}

impl SharedFrames {
    fn collect(ring: &Ring, rules: &AnchorRules, states: &[RowState]) -> Self {
        let (mut frames, mut stacks) = (Vec::new(), Vec::new());
        let mut places = HashMap::new();
        for &RowState { row, index } in states {
            for index in rules.stack_indices(ring, index) {
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

/// A batch that is complete except for frames still to be unpacked.
#[must_use]
pub struct PackedBatch {
    pub(crate) batch: Batch,
    layout: BlockLayout,
    /// The frames to unpack, row by row; empty if the batch has all its frames.
    packed_frames: Vec<PackedFrame>,
    /// The k of each row, the largest if there are several; 0 if there is none.
    pub(crate) ks: Vec<u32>,
}

/// A frame that a batch needs: the first row that needs it, its ring index, and its place in the batch.
struct NeededFrame {
    row: usize,
    index: u64,
    place: usize,
}

/// A needed frame that is compressed: its block, and its position there.
struct PackedFrame {
    row: usize,
    place: usize,
    block: Arc<Block>,
    position: usize,
}

/// Writes plain frames to their places in the batch. Of compressed frames returns what is needed to write them later.
fn write_or_defer(
    ring: &Ring,
    needed: &[NeededFrame],
    target: &mut BatchStatesMut<'_>,
) -> Vec<PackedFrame> {
    match ring.frames() {
        FrameStore::Plain(frames) => {
            for &NeededFrame { index, place, .. } in needed {
                let frame = frames.frame(ring.slot(index));
                target.frame(place).copy_from_slice(frame);
            }
            Vec::new()
        }
        FrameStore::Compressed(frames) => {
            let packed = |&NeededFrame { row, index, place }: &NeededFrame| {
                let (block, position) = frames.block(index);
                PackedFrame {
                    row,
                    place,
                    block: block.clone(),
                    position,
                }
            };
            needed.iter().map(packed).collect()
        }
    }
}

impl PackedBatch {
    /// Unpacks the frames and returns the batch. With compression, most of the work is here.
    pub fn unpack(self) -> Batch {
        let Self {
            mut batch,
            layout,
            packed_frames,
            ..
        } = self;
        let mut target = batch.states_mut();
        let mut cache = UnpackCache {
            layout,
            parts: Vec::new(),
            bytes: Vec::new(),
        };
        // Unpacks a part once per row, as rows seldom share parts.
        for row in packed_frames.chunk_by(|one, next| one.row == next.row) {
            cache.parts.clear();
            for frame in row {
                let part = layout.part_of(frame.position);
                let first = layout.frames_in_part(part, frame.block.frames).start;
                let at = cache.part_offset(&frame.block, part);
                let at = at + (frame.position - first) * layout.frame_bytes;
                let bytes = &cache.bytes[at..at + layout.frame_bytes];
                target.frame(frame.place).copy_from_slice(bytes);
            }
        }
        batch
    }
}

/// A cache of unpacked parts of blocks.
struct UnpackCache<'a> {
    layout: BlockLayout,
    parts: Vec<UnpackedPart<'a>>,
    /// The unpacked parts, one after the other. May be longer, as rows reuse the buffer.
    bytes: Vec<u8>,
}

struct UnpackedPart<'a> {
    block: &'a Block,
    number: usize,
    range: Range<usize>,
}

impl<'a> UnpackCache<'a> {
    /// Returns where a part of a block begins in `bytes`, and unpacks the part if it is not there yet.
    fn part_offset(&mut self, block: &'a Block, number: usize) -> usize {
        let is_same = |it: &&UnpackedPart<'_>| std::ptr::eq(it.block, block) && it.number == number;
        if let Some(known) = self.parts.iter().find(is_same) {
            return known.range.start;
        }
        let frame_bytes = self.layout.frame_bytes;
        let key = (number > 0).then(|| self.part_offset(block, 0));
        let start = self.parts.last().map_or(0, |it| it.range.end);
        let length = self.layout.frames_in_part(number, block.frames).len() * frame_bytes;
        let range = start..start + length;
        if self.bytes.len() < range.end {
            self.bytes.resize(range.end, 0);
        }
        let (before, rest) = self.bytes.split_at_mut(start);
        let key = key.map_or(0..0, |at| at..at + frame_bytes);
        block.unpack(number, &before[key], &mut rest[..length]);
        self.parts.push(UnpackedPart {
            block,
            number,
            range,
        });
        start
    }
}
