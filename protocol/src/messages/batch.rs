//! Batches on their way from the replay server to the learner.
//! It does not sample: which rows and which k are the replay server's choice.

use serde::{Deserialize, Serialize};

use super::{
    batch_layout::{BatchLayout, Column},
    status::Waiting,
    tally::Tally,
};
use crate::{
    run_spec::RunSpec,
    wire::{
        buffers::Buffer,
        error::CodecError,
        message::{Kind, Message, no_payload},
        shared_memory,
    },
};

/// Stands where a row has no next action: its transition ended the episode or the level.
pub const NO_ACTION: u8 = 255;

/// Batches that a replay server keeps in shared memory: those that are assembled, on their way, and being copied by the learner.
pub const POOL_BATCHES: usize = 6;

/// What a batch says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BatchHeader {
    /// Rows, B.
    pub rows: u32,
    /// Positives a row, P: 0 without DIM.
    pub positives: u32,
    /// Bytes of one state.
    pub state_bytes: u32,
    /// What the replay server that drew this had counted then, this batch included.
    pub tally: Tally,
    /// Transitions that it held.
    pub held: u64,
    /// Mean age of the rows, in transitions stored since.
    pub mean_age: f64,
    /// Version of the newest weights that chose an action of this batch, and of the oldest.
    pub weights_versions: (u64, u64),
}

impl BatchHeader {
    /// A batch of `rows` rows of this run, before any row is written.
    pub fn of(spec: &RunSpec, rows: u32) -> Self {
        Self {
            rows,
            positives: spec.horizon.positives() as u32,
            state_bytes: spec.state_bytes() as u32,
            tally: Tally::default(),
            held: 0,
            mean_age: 0.0,
            weights_versions: (0, u64::MAX),
        }
    }

    /// Bytes of the shared memory in which a replay server keeps [`POOL_BATCHES`] such batches.
    pub fn pool_bytes(&self) -> usize {
        shared_memory::pool_bytes(POOL_BATCHES, self.payload_bytes())
    }

    /// Bytes of the payload of such a batch.
    ///
    /// # Panics
    /// If they are more than the address space, which no batch of a run is.
    pub fn payload_bytes(&self) -> usize {
        self.layout()
            .bytes()
            .expect("a batch is far below the address space")
    }

    const fn layout(&self) -> BatchLayout {
        BatchLayout {
            rows: self.rows as usize,
            positives: self.positives as usize,
            state_bytes: self.state_bytes as usize,
        }
    }

    /// Checks that `payload` is as long as such a batch's.
    fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        if self.layout().bytes() == Some(payload.len()) && self.rows > 0 {
            return Ok(());
        }
        Err(CodecError::Header(format!(
            "{} rows with {} positives of {} bytes do not fill {} bytes of payload",
            self.rows,
            self.positives,
            self.state_bytes,
            payload.len()
        )))
    }
}

/// The answer to a request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum BatchReply {
    /// The payload that follows is a batch.
    Batch(BatchHeader),
    /// Nothing yet: ask again.
    Wait(Waiting),
    /// All transitions are in and all their rows were sampled: stop.
    Finished,
    /// Never: the reason, for a person.
    Refused {
        /// The replay server's reason, a sentence.
        why: String,
    },
}

impl Message for BatchReply {
    const KIND: Kind = Kind::BatchReply;

    fn validate(&self, payload: &[u8]) -> Result<(), CodecError> {
        match self {
            Self::Batch(header) => header.check_payload(payload),
            Self::Wait(_) | Self::Finished | Self::Refused { .. } => no_payload(payload),
        }
    }
}

/// Rows (s_t, a_t, a_{t+1}, R_t, discount, s_{t+k}, s_{t+n}), as the replay server made them.
///
/// Buffer, one after the other, B rows each: states_t, states_k [P, B, ..], states_n [B, state bytes]; n-step return f32,
/// bootstrap discount f32 (little-endian); action, next action, positive valid [P, B], k [P, B] (u8).
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// What it says of itself.
    pub header: BatchHeader,
    payload: Buffer,
}

impl Batch {
    /// A batch of zeros, to be filled in place.
    pub fn zeroed(header: BatchHeader) -> Self {
        let payload = Buffer::zeroed(header.payload_bytes());
        Self { header, payload }
    }

    /// A batch in memory that may hold anything: every row is to be written with [`Batch::rows_mut`].
    ///
    /// # Panics
    /// If the memory is not of [`BatchHeader::payload_bytes`].
    pub fn in_memory(header: BatchHeader, payload: Buffer) -> Self {
        assert_eq!(payload.len(), header.payload_bytes(), "memory for a batch");
        Self { header, payload }
    }

    /// The rows of all `parts`, one part after the other, in memory that may hold anything; as many bytes as
    /// [`Batch::merged_header`] says.
    ///
    /// # Panics
    /// If there is no such header, or the memory is of another size.
    pub fn merge(parts: &[Self], memory: Buffer) -> Self {
        let header = Self::merged_header(parts).expect("parts of one batch");
        let mut merged = Self::in_memory(header, memory);
        let whole = header.layout();
        let mut first_row = 0;
        for part in parts {
            let rows = part.rows();
            for column in Column::ALL {
                let row_bytes = whole.value_bytes(column);
                let to = &mut merged.payload[whole.range(column)];
                let from = part.column(column);
                // Of each positive, the rows of the part come together.
                for positive in 0..whole.values_a_row(column) {
                    let from = &from[positive * rows * row_bytes..][..rows * row_bytes];
                    let row = positive * whole.rows + first_row;
                    to[row * row_bytes..][..from.len()].copy_from_slice(from);
                }
            }
            first_row += rows;
        }
        merged
    }

    /// The header of [`Batch::merge`]; none if `parts` are none or differ in shape.
    pub fn merged_header(parts: &[Self]) -> Option<BatchHeader> {
        let mut merged = parts.first()?.header;
        let mut age_total = 0.0;
        (merged.rows, merged.tally, merged.held) = (0, Tally::default(), 0);
        for BatchHeader {
            rows,
            positives,
            state_bytes,
            tally,
            held,
            mean_age,
            weights_versions: (newest, oldest),
        } in parts.iter().map(|part| part.header)
        {
            if (positives, state_bytes) != (merged.positives, merged.state_bytes) {
                return None;
            }
            merged.rows += rows;
            merged.tally = merged.tally + tally;
            merged.held += held;
            age_total += mean_age * f64::from(rows);
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
        &self.payload[self.header.layout().range(column)]
    }

    fn column_f32(&self, column: Column) -> Vec<f32> {
        let (values, _) = self.column(column).as_chunks();
        values.iter().copied().map(f32::from_le_bytes).collect()
    }

    /// s_t [B, state bytes].
    pub fn states_t(&self) -> &[u8] {
        self.column(Column::StatesT)
    }

    /// s_{t+k} [P, B, state bytes]; rows without a positive hold zeros.
    pub fn states_k(&self) -> &[u8] {
        self.column(Column::StatesK)
    }

    /// s_{t+n} [B, state bytes]; rows that do not bootstrap hold zeros.
    pub fn states_n(&self) -> &[u8] {
        self.column(Column::StatesN)
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

    /// Everything of one row, to be written in place.
    pub fn rows_mut(&mut self) -> BatchRowsMut<'_> {
        let layout = self.header.layout();
        let mut rest = &mut self.payload[..];
        // They lie in the order of their names here.
        let mut take = |column| -> &mut [u8] {
            let bytes = layout.column_bytes(column);
            rest.split_off_mut(..bytes)
                .expect("the columns fill the payload")
        };
        BatchRowsMut {
            rows: layout.rows,
            state_bytes: layout.state_bytes,
            states_t: take(Column::StatesT),
            states_k: take(Column::StatesK),
            states_n: take(Column::StatesN),
            n_step_return: take(Column::NStepReturn),
            bootstrap_discount: take(Column::BootstrapDiscount),
            action: take(Column::Action),
            next_action: take(Column::NextAction),
            positive_valid: take(Column::PositiveValid),
            k: take(Column::K),
        }
    }

    /// Header and payload, to travel as a [`BatchReply::Batch`].
    pub fn into_payload(self) -> (BatchHeader, Buffer) {
        (self.header, self.payload)
    }

    /// Takes the payload of a decoded reply, checking that it is as long as its header says.
    ///
    /// # Errors
    /// Buffer of another length.
    pub fn from_payload(header: BatchHeader, payload: Buffer) -> Result<Self, CodecError> {
        header.check_payload(&payload)?;
        Ok(Self { header, payload })
    }
}

/// The columns of a batch, borrowed for writing, row by row.
#[derive(Debug)]
pub struct BatchRowsMut<'a> {
    rows: usize,
    state_bytes: usize,
    states_t: &'a mut [u8],
    states_k: &'a mut [u8],
    states_n: &'a mut [u8],
    n_step_return: &'a mut [u8],
    bootstrap_discount: &'a mut [u8],
    action: &'a mut [u8],
    next_action: &'a mut [u8],
    positive_valid: &'a mut [u8],
    k: &'a mut [u8],
}

impl BatchRowsMut<'_> {
    /// Where s_t of `row` is written.
    pub fn state_t(&mut self, row: usize) -> &mut [u8] {
        &mut self.states_t[row * self.state_bytes..(row + 1) * self.state_bytes]
    }

    /// Where s_{t+n} of `row` is written; zeros if the row does not bootstrap.
    pub fn state_n(&mut self, row: usize) -> &mut [u8] {
        &mut self.states_n[row * self.state_bytes..(row + 1) * self.state_bytes]
    }

    /// Positives a row, P.
    pub const fn positives(&self) -> usize {
        self.positive_valid.len() / self.rows
    }

    /// Marks `row` as having no positive `p`.
    pub fn no_positive(&mut self, p: usize, row: usize) {
        self.positive(p, row, 0).fill(0);
        self.positive_valid[p * self.rows + row] = 0;
    }

    /// Marks positive `p` of `row` as `k` steps ahead and gives where s_{t+k} is written.
    pub fn positive(&mut self, p: usize, row: usize, k: u32) -> &mut [u8] {
        let at = p * self.rows + row;
        self.positive_valid[at] = 1;
        self.k[at] = u8::try_from(k).unwrap_or(u8::MAX);
        &mut self.states_k[at * self.state_bytes..(at + 1) * self.state_bytes]
    }

    /// Writes the scalars of `row`.
    pub fn set(
        &mut self,
        row: usize,
        action: u8,
        next_action: u8,
        n_step_return: f32,
        discount: f32,
    ) {
        self.action[row] = action;
        self.next_action[row] = next_action;
        self.n_step_return[4 * row..4 * row + 4].copy_from_slice(&n_step_return.to_le_bytes());
        self.bootstrap_discount[4 * row..4 * row + 4].copy_from_slice(&discount.to_le_bytes());
    }
}
