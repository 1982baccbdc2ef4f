//! Batches that the replay server sends to the learner: how they are written, merged from parts, and read.
//! The replay server chooses the rows and each k.

use std::{borrow::Cow, ops::Range};

use super::{
    batch_frames::StackedFrames,
    batch_header::{BatchHeader, Column},
    priorities::{Origin, PriorityPart, PriorityUpdate},
};
use crate::wire::{buffers::Buffer, error::CodecError};

/// The value of a row's next action if its transition ended the episode or the level.
pub const NO_ACTION: u8 = 255;

/// Rows (s_t, a_t, a_{t+1}, R_t, discount, s_{t+k}, s_{t+n}), as the replay server made them.
///
/// The buffer holds, one after the other: states_t [B, state bytes]; states_k of the positives that rows have, in the order of [P, B];
/// states_n of the rows that bootstrap; then B rows each: n-step return f32, bootstrap discount f32 (little-endian); action, next action,
/// positive valid [P, B], k [P, B] (u8). Rows drawn by priority add: transition u64, probability f32. States that a row lacks are not sent.
///
/// If a state is a stack of frames, the frames come first, each once however many states contain it. In place of each state then stand the
/// numbers of its frames, oldest first (u32).
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// The batch's header.
    pub header: BatchHeader,
    payload: Buffer,
    /// Which replay server drew the rows by priority, and how many: one entry per part of the batch.
    origins: Vec<(Origin, usize)>,
}

impl Batch {
    /// Creates a batch of `rows`, whose frames the caller then writes with [`Batch::frame_mut`]. The counts of rows and states come from
    /// `rows`, the count of frames from `header`. `allocate` returns a buffer of the given bytes, with arbitrary content.
    ///
    /// # Panics
    /// If the memory is of another size, or a row has more positives than the header.
    pub fn from_rows(
        header: BatchHeader,
        rows: &[RowScalars],
        allocate: impl FnOnce(usize) -> Buffer,
    ) -> Self {
        let header = BatchHeader {
            rows: rows.len() as u32,
            states_k: rows.iter().map(|row| row.positives).sum(),
            states_n: rows.iter().filter(|row| row.bootstraps()).count() as u32,
            ..header
        };
        let positives = header.positives;
        let fits = rows.iter().all(|row| row.positives <= positives);
        assert!(fits, "a row has at most P positives");
        let mut batch = Self::with_buffer(header, allocate(header.payload_bytes()));
        let returns = rows.iter().map(|row| row.n_step_return.to_le_bytes());
        batch.fill_column(Column::NStepReturn, returns);
        let discounts = rows.iter().map(|row| row.bootstrap_discount.to_le_bytes());
        batch.fill_column(Column::BootstrapDiscount, discounts);
        batch.fill_column(Column::Action, rows.iter().map(|row| [row.action]));
        batch.fill_column(Column::NextAction, rows.iter().map(|row| [row.next_action]));
        // The k of each positive [P, B], if the row has it.
        let k = |p: u32, row: &RowScalars| (p < row.positives).then_some(row.k_first + p);
        let ks = (0..positives).flat_map(|p| rows.iter().map(move |row| k(p, row)));
        let valid = ks.clone().map(|k| [u8::from(k.is_some())]);
        batch.fill_column(Column::PositiveValid, valid);
        let capped = |k: Option<u32>| [k.map_or(0, |k| u8::try_from(k).unwrap_or(u8::MAX))];
        batch.fill_column(Column::K, ks.map(capped));
        batch
    }

    /// Writes the values of a column of neither states nor frames.
    fn fill_column<const BYTES: usize>(
        &mut self,
        column: Column,
        mut values: impl Iterator<Item = [u8; BYTES]>,
    ) {
        let (places, rest) = self.payload[self.header.range(column)].as_chunks_mut();
        for place in places {
            *place = values.next().expect("a value for each place");
        }
        assert!(rest.is_empty() && values.next().is_none(), "{column:?}");
    }

    /// Creates a batch in memory with arbitrary content.
    fn with_buffer(header: BatchHeader, payload: Buffer) -> Self {
        assert_eq!(payload.len(), header.payload_bytes(), "memory for a batch");
        Self {
            header,
            payload,
            origins: Vec::from_iter(header.origin.map(|origin| (origin, header.rows as usize))),
        }
    }

    /// Merges the rows of all `parts`, one part after the other; `None` if `parts` is empty or the parts differ in shape. `allocate` returns a
    /// buffer of the given bytes, with arbitrary content. Counts and ages in the header are those of the first part.
    pub fn merge(parts: &[Self], allocate: impl FnOnce(usize) -> Buffer) -> Option<Self> {
        let header = Self::merged_header(parts)?;
        let mut merged = Self::with_buffer(header, allocate(header.payload_bytes()));
        for (column, _) in header.columns() {
            let mut to = &mut merged.payload[header.range(column)];
            let pieces: Vec<_> = parts.iter().map(|part| part.split_column(column)).collect();
            // For each positive, the rows of all parts are adjacent.
            for piece in 0..pieces[0].len() {
                let mut frames_before = 0;
                for (part, pieces) in parts.iter().zip(&pieces) {
                    let from = pieces[piece];
                    let place = to.split_off_mut(..from.len());
                    let place = place.expect("the parts fill the column");
                    place.copy_from_slice(from);
                    if let Some(stacked) = part.header.stacked {
                        if matches!(column, Column::StatesT | Column::StatesK | Column::StatesN) {
                            StackedFrames::shift_numbers(place, frames_before);
                        }
                        frames_before += stacked.frames;
                    }
                }
            }
        }
        merged.origins = parts.iter().flat_map(|it| it.origins.clone()).collect();
        Some(merged)
    }

    /// The values of a column, split by positive; a column without positives is one piece.
    fn split_column(&self, column: Column) -> Vec<&[u8]> {
        let values = self.column(column);
        match column {
            Column::StatesK => {
                let valid = self.positive_valid().chunks_exact(self.rows());
                let mut rest = values;
                let own = |valid: &[u8]| {
                    let present = valid.iter().filter(|valid| **valid != 0).count();
                    let (own, others) = rest.split_at(present * self.header.value_bytes());
                    rest = others;
                    own
                };
                valid.map(own).collect()
            }
            Column::PositiveValid | Column::K => values.chunks_exact(self.rows()).collect(),
            _ => vec![values],
        }
    }

    fn merged_header(parts: &[Self]) -> Option<BatchHeader> {
        // The fields that all parts must share.
        let shape = |it: &BatchHeader| {
            let frames = it.stacked.map(|it| StackedFrames { frames: 0, ..it });
            (it.positives, it.state_bytes, it.origin.is_some(), frames)
        };
        let (first, others) = parts.split_first()?;
        let mut merged = first.header;
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
            let (newest, oldest) = part.weights_versions;
            let (a, b) = merged.weights_versions;
            merged.weights_versions = (a.max(newest), b.min(oldest));
        }
        Some(merged)
    }

    /// Rows, B.
    pub const fn rows(&self) -> usize {
        self.header.rows as usize
    }

    /// Positives per row, P.
    pub const fn positives(&self) -> usize {
        self.header.positives as usize
    }

    fn column(&self, column: Column) -> &[u8] {
        &self.payload[self.header.range(column)]
    }

    fn column_f32(&self, column: Column) -> Vec<f32> {
        self.header.f32s(column, &self.payload).collect()
    }

    /// The states of a column, assembled from their frames if they are stacks.
    fn states(&self, column: Column) -> Cow<'_, [u8]> {
        let values = self.column(column);
        match self.header.stacked {
            None => Cow::Borrowed(values),
            Some(stacked) => {
                let (frames, state_bytes) = (self.column(Column::Frames), self.header.state_bytes);
                Cow::Owned(stacked.assemble(frames, values, state_bytes as usize))
            }
        }
    }

    /// s_t [B, state bytes]. In a state [H, W, C * stack], the channels of a pixel stand oldest first.
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

    /// The probability with which each row was drawn [B]; `None` if rows are drawn uniformly.
    pub fn probabilities(&self) -> Option<Vec<f32>> {
        self.header.origin?;
        Some(self.column_f32(Column::Probability))
    }

    /// The number of each row's transition [B], since the start of the replay that drew it; empty if rows are drawn uniformly.
    fn transitions(&self) -> Vec<u64> {
        let (values, _) = self.column(Column::Transition).as_chunks();
        values.iter().copied().map(u64::from_le_bytes).collect()
    }

    /// Writes the number of each row's transition, and the probability with which the row was drawn.
    pub fn set_draws(&mut self, draws: &[(u64, f32)]) {
        assert!(self.header.origin.is_some(), "rows drawn by priority");
        assert_eq!(draws.len(), self.rows(), "a draw a row");
        let transitions = draws.iter().map(|draw| draw.0.to_le_bytes());
        self.fill_column(Column::Transition, transitions);
        let chances = draws.iter().map(|draw| draw.1.to_le_bytes());
        self.fill_column(Column::Probability, chances);
    }

    /// Multiplies the probability of each row by `share`, the probability that its replay server was chosen.
    pub fn scale_probabilities(&mut self, share: f32) {
        let chances = self.probabilities().expect("rows drawn by priority");
        let scaled = chances.into_iter().map(|it| (it * share).to_le_bytes());
        self.fill_column(Column::Probability, scaled);
    }

    /// Returns update `number` of `learner`, with the `priorities` [B] for the replay servers that drew the rows; `None` if rows are drawn
    /// uniformly.
    pub fn priority_update(
        &self,
        learner: u64,
        number: u64,
        priorities: &[f32],
    ) -> Option<PriorityUpdate> {
        self.header.origin?;
        assert_eq!(priorities.len(), self.rows(), "a priority a row");
        let transitions = self.transitions().into_iter();
        let mut found = transitions.zip(priorities.iter().copied());
        let part = |&(origin, rows): &(Origin, usize)| {
            let (transitions, priorities) = found.by_ref().take(rows).unzip();
            PriorityPart {
                origin,
                transitions,
                priorities,
            }
        };
        Some(PriorityUpdate {
            learner,
            number,
            parts: self.origins.iter().map(part).collect(),
        })
    }

    /// The place of frame `number`, for writing. If a state is one frame, the frame has the state's number: first all s_t, then s_{t+k} in
    /// the order of [P, B], then s_{t+n}, without those that rows lack.
    pub fn frame_mut(&mut self, number: usize) -> &mut [u8] {
        let bytes = self.header.frame_bytes();
        &mut self.payload[number * bytes..][..bytes]
    }

    /// Writes the numbers of the frames of all states, one state after the other, each oldest first.
    ///
    /// # Panics
    /// If a state is one frame, or the numbers are not those of all states.
    pub fn set_stacks(&mut self, frames: &[u32]) {
        assert!(self.header.stacked.is_some(), "states that are stacks");
        let stacks = self.header.state_range();
        StackedFrames::write_numbers(&mut self.payload[stacks], frames);
    }

    /// Header and payload, to be sent as a [`BatchReply`](super::batch_header::BatchReply).
    pub fn into_payload(self) -> (BatchHeader, Buffer) {
        (self.header, self.payload)
    }

    /// Makes a batch of a decoded reply. Checks that the payload has the length that `header` gives and the states that its rows need.
    pub fn from_payload(header: BatchHeader, payload: Buffer) -> Result<Self, CodecError> {
        header.check_payload(&payload)?;
        Ok(Self::with_buffer(header, payload))
    }
}

/// A row without its states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowScalars {
    /// a_t.
    pub action: u8,
    /// a_{t+1}, or [`NO_ACTION`].
    pub next_action: u8,
    /// Sum of gamma^i r_{t+i} over i < n, stopped at the episode's end.
    pub n_step_return: f32,
    /// gamma^n, or 0 where the row does not bootstrap.
    pub bootstrap_discount: f32,
    /// Number of positives that the row has, the first of P.
    pub positives: u32,
    /// k of the first positive; each further one has the next k. On the wire, k is capped at 255.
    pub k_first: u32,
}

impl RowScalars {
    /// Whether the row has an s_{t+n}.
    pub fn bootstraps(&self) -> bool {
        self.bootstrap_discount != 0.0
    }

    /// k of each positive that the row has.
    pub const fn ks(&self) -> Range<u32> {
        self.k_first..self.k_first + self.positives
    }
}
