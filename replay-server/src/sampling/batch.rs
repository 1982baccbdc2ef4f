//! Draws and assembles a batch: `rows` draws the anchors, `episodes` computes each row, and stacked states share their frames.
//! Compressed frames leave the replay compressed, and are unpacked without a lock.
//! The rate limiter decides whether a batch may be drawn.

use std::{collections::HashMap, ops::Range, sync::Arc};

use driml_protocol::{Batch, BatchHeader, Buffer, RunSpec, Sampling};
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
        let mut scalars = Vec::with_capacity(rows);
        // The states by their numbers in the batch: s_t, then s_{t+k} of each positive, then s_{t+n}.
        let mut states = Vec::with_capacity(rows);
        let mut states_k = vec![Vec::with_capacity(rows); header.positives as usize];
        let mut states_n = Vec::with_capacity(rows);
        let mut age_total = 0;
        for row in 0..rows {
            if !self.rows.draw(ring, rng, &mut self.window) {
                return None;
            }
            let window = &self.window;
            let (row_scalars, bootstrap) = self.assembler.assemble(affinity, window, rng);
            let state = |i| NeededFrame {
                row,
                index: window.index(i),
            };
            states.push(state(0));
            states_n.extend(bootstrap.map(state));
            for (states, k) in states_k.iter_mut().zip(row_scalars.ks()) {
                states.push(state(k as usize));
            }
            scalars.push(row_scalars);
            age_total += ring.inserted() - 1 - window.index(0);
            let version = window.step(0).weights_version;
            let (newest, oldest) = header.weights_versions;
            header.weights_versions = (newest.max(version), oldest.min(version));
        }
        header.mean_age = age_total as f64 / rows as f64;
        // Computed after all draws: a draw that finds an invalid anchor zeroes its mass, which makes the others more likely.
        let draw = |anchor: &NeededFrame| {
            let probability = self.rows.probability(anchor.index)? as f32;
            Some((anchor.index, probability.clamp(f32::MIN_POSITIVE, 1.0)))
        };
        let draws: Option<Vec<_>> = states.iter().map(draw).collect();
        states.extend(states_k.into_iter().flatten().chain(states_n));
        let (mut frames, mut stacks) = (states, Vec::new());
        if let Some(stacked) = &mut header.stacked {
            (frames, stacks) = self.share_frames(ring, &frames);
            stacked.frames = frames.len() as u32;
        }
        let mut batch = Batch::from_rows(header, &scalars, alloc);
        if let Some(draws) = draws {
            batch.set_draws(&draws);
        }
        if header.stacked.is_some() {
            batch.set_stacks(&stacks);
        }
        let packed_frames = write_or_defer(ring, &frames, &mut batch);
        let ks = scalars.iter().map(|row| row.ks().max().unwrap_or(0));
        Some(PackedBatch {
            batch,
            layout: self.layout,
            packed_frames,
            ks: ks.collect(),
        })
    }

    /// Returns the distinct frames of stacked `states`, and the places of each state's frames among them, oldest first. States of a row share
    /// frames, and sometimes rows do. The ring index identifies a frame: frames at two indices are distinct even if they look the same.
    fn share_frames(&self, ring: &Ring, states: &[NeededFrame]) -> (Vec<NeededFrame>, Vec<u32>) {
        let (mut frames, mut stacks) = (Vec::new(), Vec::new());
        let mut places = HashMap::new();
        for &NeededFrame { row, index } in states {
            let stack = self.rules.stack_indices(ring, index);
            for index in stack.expect("the anchor's check found its stack held") {
                let place = places.entry(index).or_insert_with(|| {
                    frames.push(NeededFrame { row, index });
                    frames.len() as u32 - 1
                });
                stacks.push(*place);
            }
        }
        (frames, stacks)
    }
}

/// A frame that a batch needs, or the newest frame of a state: the first row that needs it, and its ring index.
#[derive(Clone, Copy)]
struct NeededFrame {
    row: usize,
    index: u64,
}

/// A batch that is complete except for frames still to be unpacked.
#[must_use]
pub struct PackedBatch {
    pub(crate) batch: Batch,
    layout: BlockLayout,
    /// The frames to unpack; empty if the batch has all its frames.
    packed_frames: Vec<PackedFrame>,
    /// The k of each row, the largest if there are several; 0 if there is none.
    pub(crate) ks: Vec<u32>,
}

/// A needed frame that is compressed: its place in the batch, its block, and its position there.
struct PackedFrame {
    row: usize,
    place: usize,
    block: Arc<Block>,
    position: usize,
}

/// Writes plain frames to the batch, in the order of `needed`. Of compressed frames returns what is needed to write them later.
fn write_or_defer(ring: &Ring, needed: &[NeededFrame], batch: &mut Batch) -> Vec<PackedFrame> {
    match ring.frames() {
        FrameStore::Plain(frames) => {
            for (place, needed) in needed.iter().enumerate() {
                let frame = frames.frame(ring.slot(needed.index));
                batch.frame_mut(place).copy_from_slice(frame);
            }
            Vec::new()
        }
        FrameStore::Compressed(frames) => {
            let packed = |(place, &NeededFrame { row, index }): (usize, &NeededFrame)| {
                let (block, position) = frames.block(index);
                PackedFrame {
                    row,
                    place,
                    block: block.clone(),
                    position,
                }
            };
            needed.iter().enumerate().map(packed).collect()
        }
    }
}

impl PackedBatch {
    /// Unpacks the frames and returns the batch. With compression, most of the work is here.
    pub fn unpack(self) -> Batch {
        let Self {
            mut batch,
            layout,
            mut packed_frames,
            ..
        } = self;
        let mut cache = UnpackCache {
            layout,
            parts: Vec::new(),
            bytes: Vec::new(),
        };
        // Unpacks a part once per row, as rows seldom share parts.
        packed_frames.sort_unstable_by_key(|frame| frame.row);
        for row in packed_frames.chunk_by(|one, next| one.row == next.row) {
            cache.parts.clear();
            for frame in row {
                let part = layout.part_of(frame.position);
                let first = layout.frames_in_part(part, frame.block.frames).start;
                let at = cache.part_offset(&frame.block, part);
                let at = at + (frame.position - first) * layout.frame_bytes;
                let bytes = &cache.bytes[at..at + layout.frame_bytes];
                batch.frame_mut(frame.place).copy_from_slice(bytes);
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
