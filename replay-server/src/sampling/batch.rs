//! Draws the rows of a batch and puts it together: anchors by `rows`, each row by `assemble`, and the frames that they need, each once.
//! Whether a batch may be drawn is for the rate limiter.

use std::collections::{HashMap, hash_map::Entry};

use driml_protocol::{Batch, BatchHeader, Buffer, RunSpec, Sampling};
use rand_chacha::ChaCha8Rng;

use super::{
    assemble::{Assembler, RowStates},
    episodes::{Episodes, Window},
    horizon::Affinity,
    packed_batch::{PackedBatch, PackedFrames},
    rows::{RowSampler, prioritised::Priorities, uniform::Uniform},
};
use crate::storage::ring::Ring;

/// Everything that drawing needs beside the ring and the generator.
pub(crate) struct BatchSampler {
    pub(crate) rows: Box<dyn RowSampler>,
    episodes: Episodes,
    assembler: Assembler,
    window: Window,
    frame_bytes: usize,
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
            frame_bytes: spec.frame_bytes(),
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
        let mut scalars = Vec::with_capacity(rows);
        let mut states: Vec<RowStates> = Vec::with_capacity(rows);
        let mut age_total = 0;
        for _ in 0..rows {
            if !self.rows.draw(ring, rng, &mut self.window) {
                return None;
            }
            let row = self.assembler.row(affinity, &self.window, rng);
            scalars.push(row.0);
            states.push(row.1);
            age_total += ring.inserted() - 1 - self.window.index(0);
            let version = self.window.step(0).weights_version;
            let (newest, oldest) = header.weights_versions;
            header.weights_versions = (newest.max(version), oldest.min(version));
        }
        header.mean_age = age_total as f64 / rows as f64;
        let mut needed = NeededFrames::default();
        if let Some(stacked) = &mut header.stacked {
            needed = NeededFrames::of(ring, &self.episodes, states.iter());
            stacked.frames = needed.indices.len() as u32;
        }
        let mut batch = Batch::of_rows(header, &scalars, memory);
        // All by the masses that are there now: to find that one was no anchor any more makes the others more likely.
        let probability = |states: &RowStates| {
            let probability = self.rows.probability(states.anchor())? as f32;
            Some((states.anchor(), probability.clamp(f32::MIN_POSITIVE, 1.0)))
        };
        if let Some(draws) = states.iter().map(probability).collect::<Option<Vec<_>>>() {
            batch.set_draws(draws.into_iter());
        }
        let packed = self.take_frames(ring, &states, &needed, &mut batch);
        let ks = states.iter().map(RowStates::k).collect();
        Some(PackedBatch { batch, packed, ks })
    }

    /// Writes the frames of all rows, or takes what is needed to write them later. Stacked states share the frames of `needed`.
    fn take_frames(
        &self,
        ring: &Ring,
        states: &[RowStates],
        needed: &NeededFrames,
        batch: &mut Batch,
    ) -> PackedFrames {
        let mut packed = PackedFrames::new(self.frame_bytes);
        let is_stacked = batch.header.stacked.is_some();
        let mut places = batch.states_mut();
        let mut stacks = needed.stacks();
        for (row, states) in states.iter().enumerate() {
            let numbers: Vec<usize> = places.of_row(row).collect();
            if !is_stacked {
                let frames = states.indices().zip(numbers);
                packed.write_or_take_row(ring, frames, &mut places);
                continue;
            }
            for (number, stack) in numbers.into_iter().zip(&mut stacks) {
                places.set_stack(number, stack);
            }
            packed.write_or_take_row(ring, needed.first_in(row), &mut places);
        }
        packed
    }
}

/// The distinct frames of stacked states, in the order in which rows need them: states of a row share them, and now and then rows do.
/// A frame is known by where the ring holds it: two that look the same are two.
#[derive(Default)]
struct NeededFrames {
    indices: Vec<u64>,
    /// How many are needed by the rows up to each.
    row_ends: Vec<usize>,
    /// The frames of each state, oldest first, by their place among `indices`: row by row, in the order of [`RowStates::indices`].
    stacks: Vec<u32>,
    frame_stack: usize,
}

impl NeededFrames {
    fn of<'a>(ring: &Ring, episodes: &Episodes, rows: impl Iterator<Item = &'a RowStates>) -> Self {
        let mut this = Self {
            frame_stack: episodes.frame_stack(),
            ..Self::default()
        };
        let mut places = HashMap::new();
        for states in rows {
            for state in states.indices() {
                for index in episodes.stack(ring, state) {
                    let place = match places.entry(index) {
                        Entry::Occupied(known) => *known.get(),
                        Entry::Vacant(new) => {
                            this.indices.push(index);
                            *new.insert(this.indices.len() as u32 - 1)
                        }
                    };
                    this.stacks.push(place);
                }
            }
            this.row_ends.push(this.indices.len());
        }
        this
    }

    /// Those that `row` is the first to need, and their places.
    fn first_in(&self, row: usize) -> impl Iterator<Item = (u64, usize)> {
        let start = row.checked_sub(1).map_or(0, |before| self.row_ends[before]);
        let places = start..self.row_ends[row];
        self.indices[places.clone()].iter().copied().zip(places)
    }

    /// The places of each state's frames, oldest first.
    fn stacks(&self) -> impl Iterator<Item = &[u32]> {
        self.stacks.chunks_exact(self.frame_stack.max(1))
    }
}
