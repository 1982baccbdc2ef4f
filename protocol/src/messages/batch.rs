//! Batches on their way from the replay server to the learner.
//! It does not sample: which rows and which k are the replay server's choice.

use std::borrow::Cow;

use super::{
    batch_frames::StackedFrames,
    batch_header::BatchHeader,
    batch_layout::Column,
    batch_rows::{BatchStatesMut, RowScalars},
    priorities::{Origin, PriorityPart, PriorityUpdate},
};
use crate::wire::{buffers::Buffer, error::CodecError};

/// Stands where a row has no next action: its transition ended the episode or the level.
pub const NO_ACTION: u8 = 255;

/// Rows (s_t, a_t, a_{t+1}, R_t, discount, s_{t+k}, s_{t+n}), as the replay server made them.
///
/// Buffer, one after the other: states_t [B, state bytes]; states_k of the positives that rows have, in the order of [P, B];
/// states_n of the rows that bootstrap; then B rows each: n-step return f32, bootstrap discount f32 (little-endian); action, next action,
/// positive valid [P, B], k [P, B] (u8). Where rows are drawn by priority, then: transition u64, probability f32. No state travels
/// that a row does not have.
///
/// Where a state is a stack of frames, these come first, each once however many states have it; and in place of each state the
/// numbers of its frames, oldest first (u32).
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// What it says of itself.
    pub header: BatchHeader,
    payload: Buffer,
    /// Who drew its rows by priority: so many at a time.
    origins: Vec<(Origin, usize)>,
}

impl Batch {
    /// A batch of `rows`, whose states are then to be written with [`Batch::states_mut`]; rows and states of `header` are set to
    /// what `rows` has, its frames are as many as it says. `memory` gives so many bytes, with anything in them.
    ///
    /// # Panics
    /// If the memory is of another size, or a row has more positives than the header.
    pub fn of_rows(
        header: BatchHeader,
        rows: &[RowScalars],
        memory: impl FnOnce(usize) -> Buffer,
    ) -> Self {
        let header = BatchHeader {
            rows: rows.len() as u32,
            states_k: rows.iter().map(|row| row.positives).sum(),
            states_n: rows.iter().filter(|row| row.bootstraps()).count() as u32,
            ..header
        };
        let mut batch = Self::in_memory(header, memory(header.payload_bytes()));
        for (row, scalars) in rows.iter().enumerate() {
            scalars.write(&header, &mut batch.payload, row);
        }
        batch
    }

    /// A batch in memory that may hold anything.
    fn in_memory(header: BatchHeader, payload: Buffer) -> Self {
        assert_eq!(payload.len(), header.payload_bytes(), "memory for a batch");
        Self {
            header,
            payload,
            origins: Vec::from_iter(header.origin.map(|origin| (origin, header.rows as usize))),
        }
    }

    /// The rows of all `parts`, one part after the other, in memory that may hold anything; as many bytes as
    /// [`Batch::merged_header`] says.
    ///
    /// # Panics
    /// If there is no such header, or the memory is of another size.
    pub fn merge(parts: &[Self], memory: Buffer) -> Self {
        let header = Self::merged_header(parts).expect("parts of one batch");
        let mut merged = Self::in_memory(header, memory);
        for column in Column::ALL {
            let mut to = &mut merged.payload[header.range(column)];
            // Of each positive, the rows of the part come together.
            for positive in 0..header.values_a_row(column) {
                let mut frames_before = 0;
                for part in parts {
                    let from = part.of_positive(column, positive);
                    let place = to.split_off_mut(..from.len());
                    let place = place.expect("the parts fill the column");
                    place.copy_from_slice(from);
                    if let Some(stacked) = part.header.stacked {
                        if column.is_of_states() {
                            StackedFrames::shift(place, frames_before);
                        }
                        frames_before += stacked.frames;
                    }
                }
            }
        }
        merged.origins = parts.iter().flat_map(|it| it.origins.clone()).collect();
        merged
    }

    /// The values of a column that are of this positive; all of a column that is not of positives.
    fn of_positive(&self, column: Column, positive: usize) -> &[u8] {
        let values = self.column(column);
        match column {
            Column::StatesK => {
                let valid = self.positive_valid().chunks_exact(self.rows());
                let there = |valid: &[u8]| valid.iter().filter(|valid| **valid != 0).count();
                let before: usize = valid.clone().take(positive).map(there).sum();
                let own = valid.clone().nth(positive).map_or(0, there);
                let bytes = self.header.value_bytes();
                &values[before * bytes..(before + own) * bytes]
            }
            Column::PositiveValid | Column::K => &values[positive * self.rows()..][..self.rows()],
            _ => values,
        }
    }

    /// The header of [`Batch::merge`]; none if `parts` are none or differ in shape.
    pub fn merged_header(parts: &[Self]) -> Option<BatchHeader> {
        // What is the same in all parts.
        let shape = |it: &BatchHeader| {
            let frames = it.stacked.map(|it| StackedFrames { frames: 0, ..it });
            (it.positives, it.state_bytes, it.origin.is_some(), frames)
        };
        let (first, others) = parts.split_first()?;
        let mut merged = first.header;
        let mut age_total = merged.mean_age * f64::from(merged.rows);
        for part in others.iter().map(|part| part.header) {
            if shape(&part) != shape(&merged) {
                return None;
            }
            if let (Some(merged), Some(part)) = (&mut merged.stacked, part.stacked) {
                merged.frames += part.frames;
            }
            merged.rows += part.rows;
            merged.states_k += part.states_k;
            merged.states_n += part.states_n;
            merged.counts = merged.counts + part.counts;
            merged.held += part.held;
            age_total += part.mean_age * f64::from(part.rows);
            let (newest, oldest) = part.weights_versions;
            let (a, b) = merged.weights_versions;
            merged.weights_versions = (a.max(newest), b.min(oldest));
        }
        merged.mean_age = age_total / f64::from(merged.rows);
        Some(merged)
    }

    /// Rows, B.
    pub const fn rows(&self) -> usize {
        self.header.rows as usize
    }

    /// Positives a row, P.
    pub const fn positives(&self) -> usize {
        self.header.positives as usize
    }

    fn column(&self, column: Column) -> &[u8] {
        &self.payload[self.header.range(column)]
    }

    fn column_f32(&self, column: Column) -> Vec<f32> {
        let (values, _) = self.column(column).as_chunks();
        values.iter().copied().map(f32::from_le_bytes).collect()
    }

    /// The states of a column; where they are stacks of frames, put together now.
    fn states(&self, column: Column) -> Cow<'_, [u8]> {
        let values = self.column(column);
        match self.header.stacked {
            None => Cow::Borrowed(values),
            Some(stacked) => {
                let (frames, state_bytes) = (self.column(Column::Frames), self.header.state_bytes);
                Cow::Owned(stacked.stacked(frames, values, state_bytes as usize))
            }
        }
    }

    /// s_t [B, state bytes]; a state [H, W, C * stack] has a pixel's oldest channels first.
    pub fn states_t(&self) -> Cow<'_, [u8]> {
        self.states(Column::StatesT)
    }

    /// s_{t+k} of the positives that rows have, in the order of [P, B].
    pub fn states_k(&self) -> Cow<'_, [u8]> {
        self.states(Column::StatesK)
    }

    /// s_{t+n} of the rows that bootstrap.
    pub fn states_n(&self) -> Cow<'_, [u8]> {
        self.states(Column::StatesN)
    }

    /// Sum of gamma^i r_{t+i} over i < n, stopped at the episode's end [B].
    pub fn n_step_returns(&self) -> Vec<f32> {
        self.column_f32(Column::NStepReturn)
    }

    /// gamma^n, or 0 where the episode ended within the n steps [B].
    pub fn bootstrap_discounts(&self) -> Vec<f32> {
        self.column_f32(Column::BootstrapDiscount)
    }

    /// a_t [B].
    pub fn actions(&self) -> &[u8] {
        self.column(Column::Action)
    }

    /// a_{t+1} [B], or [`NO_ACTION`].
    pub fn next_actions(&self) -> &[u8] {
        self.column(Column::NextAction)
    }

    /// 1 where the row has a positive [P, B].
    pub fn positive_valid(&self) -> &[u8] {
        self.column(Column::PositiveValid)
    }

    /// k [P, B], capped at 255; 0 where the row has no positive.
    pub fn ks(&self) -> &[u8] {
        self.column(Column::K)
    }

    /// The chance with which each row was drawn [B], where rows are drawn by priority.
    pub fn probabilities(&self) -> Option<Vec<f32>> {
        self.header.origin?;
        Some(self.column_f32(Column::Probability))
    }

    /// The transition of each row [B], by its number since the start of the replay that drew it; none where rows are drawn uniformly.
    fn transitions(&self) -> Vec<u64> {
        let (values, _) = self.column(Column::Transition).as_chunks();
        values.iter().copied().map(u64::from_le_bytes).collect()
    }

    /// Writes of each row which transition it is, and the chance with which it was drawn.
    pub fn set_draws(&mut self, draws: impl ExactSizeIterator<Item = (u64, f32)>) {
        assert!(self.header.origin.is_some(), "rows drawn by priority");
        assert_eq!(draws.len(), self.rows(), "a draw a row");
        let header = self.header;
        for (row, (transition, probability)) in draws.enumerate() {
            let mut put = |column, bytes: &[u8]| {
                let column = &mut self.payload[header.range(column)];
                column[row * bytes.len()..][..bytes.len()].copy_from_slice(bytes);
            };
            put(Column::Transition, &transition.to_le_bytes());
            put(Column::Probability, &probability.to_le_bytes());
        }
    }

    /// Makes the chance of each row `share` of what it was: that its replay server was chosen.
    pub fn scale_probabilities(&mut self, share: f32) {
        let chances = self.probabilities().expect("rows drawn by priority");
        let scaled = chances.into_iter().map(|chance| chance * share);
        let draws: Vec<_> = self.transitions().into_iter().zip(scaled).collect();
        self.set_draws(draws.into_iter());
    }

    /// What `learner` says back of rows that were drawn by priority: update `number`, with the `priorities` [B]; none where rows
    /// are drawn uniformly.
    pub fn priority_update(
        &self,
        learner: u64,
        number: u64,
        priorities: &[f32],
    ) -> Option<PriorityUpdate> {
        self.header.origin?;
        assert_eq!(priorities.len(), self.rows(), "a priority a row");
        let (mut transitions, mut priorities) = (&self.transitions()[..], priorities);
        let part = |&(origin, rows): &(Origin, usize)| {
            let (own, rest) = transitions.split_at(rows);
            transitions = rest;
            let (found, rest) = priorities.split_at(rows);
            priorities = rest;
            PriorityPart {
                origin,
                transitions: own.to_vec(),
                priorities: found.to_vec(),
            }
        };
        Some(PriorityUpdate {
            learner,
            number,
            parts: self.origins.iter().map(part).collect(),
        })
    }

    /// The places of all states that the rows have.
    pub fn states_mut(&mut self) -> BatchStatesMut<'_> {
        BatchStatesMut::new(self.header, &mut self.payload)
    }

    /// Header and payload, to travel as a [`BatchReply`](super::batch_header::BatchReply).
    pub fn into_payload(self) -> (BatchHeader, Buffer) {
        (self.header, self.payload)
    }

    /// Takes the payload of a decoded reply, checking that it is as long as its header says, with the states that its rows say.
    pub fn from_payload(header: BatchHeader, payload: Buffer) -> Result<Self, CodecError> {
        header.check_payload(&payload)?;
        Ok(Self::in_memory(header, payload))
    }
}
