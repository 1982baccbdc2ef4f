//! What a batch says of itself, how its columns lie in its payload, and the reply that it travels in.
//! It knows how many bytes a batch has and which are absurd; what they mean is `batch`'s.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{
    batch_frames::StackedFrames, batch_request::ShardCounts, priorities::Origin, status::Waiting,
};
use crate::{
    run_spec::RunSpec,
    sampling::Sampling,
    wire::{codec::PAYLOAD_BYTES_MAX, error::CodecError, message::no_payload, shared_memory},
};

/// Batches that a replay server keeps in shared memory: those that are assembled, on their way, and being copied by the learner.
pub const POOL_BATCHES: usize = 6;

/// What a batch says of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BatchHeader {
    /// Rows, B.
    pub rows: u32,
    /// Positives a row, P: 0 without DIM.
    pub positives: u32,
    /// Bytes of one state.
    pub state_bytes: u32,
    /// States s_{t+k} that travel: one for each positive that a row has, at most P for each row.
    pub states_k: u32,
    /// States s_{t+n} that travel: one for each row that bootstraps, at most B.
    pub states_n: u32,
    /// What the replay server that drew this had counted then, this batch included.
    pub counts: ShardCounts,
    /// Transitions that it held.
    pub held: u64,
    /// Mean age of the rows, in transitions stored since.
    pub mean_age: f64,
    /// Version of the newest weights that chose an action of this batch, and of the oldest.
    pub weights_versions: (u64, u64),
    /// Who drew the rows, where they are drawn by priority.
    pub origin: Option<Origin>,
    /// The frames that states are stacks of, each of which travels once; none where a state is one frame.
    pub stacked: Option<StackedFrames>,
}

impl BatchHeader {
    /// A batch of `rows` rows of this run, before any row is drawn: as large as one can be.
    pub fn of(spec: &RunSpec, rows: u32) -> Self {
        let positives = spec.horizon.positives() as u32;
        Self {
            rows,
            positives,
            state_bytes: spec.state_bytes() as u32,
            states_k: rows.saturating_mul(positives),
            states_n: rows,
            weights_versions: (0, u64::MAX),
            stacked: StackedFrames::of(spec, rows),
            ..Self::default()
        }
    }

    /// The same where rows are drawn by this rule.
    #[must_use]
    pub fn sampled_by(self, sampling: &Sampling) -> Self {
        Self {
            origin: sampling.is_prioritised().then(Origin::default),
            ..self
        }
    }

    /// Bytes of the shared memory in which a replay server keeps [`POOL_BATCHES`] such batches.
    pub fn pool_bytes(&self) -> usize {
        shared_memory::pool_bytes(POOL_BATCHES, self.payload_bytes())
    }

    /// Bytes of the payload of such a batch.
    pub fn payload_bytes(&self) -> usize {
        self.bytes()
            .expect("a batch is far below the address space")
    }

    /// Checks that `payload` is as long as such a batch's, has as many states as its rows say, and that these are made of its frames.
    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        if self.bytes() != Some(payload.len()) || self.rows == 0 {
            return Err(CodecError::Header(format!(
                "the rows, states and frames of {self:?} do not fill {} bytes of payload",
                payload.len()
            )));
        }
        if let Some(stacked) = self.stacked {
            // What few frames may be made into, if many states have them.
            let whole = Self {
                stacked: None,
                ..*self
            };
            if whole.bytes().is_none_or(|bytes| bytes > PAYLOAD_BYTES_MAX) {
                return Err(CodecError::Header(format!(
                    "{} rows whose states would fill more than {PAYLOAD_BYTES_MAX} bytes",
                    self.rows
                )));
            }
            if let Some(number) = stacked.first_unknown(self.of_states(payload)) {
                return Err(CodecError::Header(format!(
                    "a state of frame {number}, of {} that travel",
                    stacked.frames
                )));
            }
        }
        let rows = (self.positives_there(payload), self.bootstraps(payload));
        let count = |there: &[bool]| there.iter().filter(|there| **there).count();
        let counted = (count(&rows.0), count(&rows.1));
        if counted != (self.states_k as usize, self.states_n as usize) {
            return Err(CodecError::Header(format!(
                "rows with {} positives and {} bootstraps come with {} and {} states",
                counted.0, counted.1, self.states_k, self.states_n
            )));
        }
        let mut chances = self.f32s(Column::Probability, payload);
        if let Some(chance) = chances.find(|chance| !(*chance > 0.0 && *chance <= 1.0)) {
            return Err(CodecError::Header(format!(
                "a row that was drawn with the probability {chance}"
            )));
        }
        Ok(())
    }
}

/// The columns of a batch, in the order in which they lie one after the other. Each has a value for every row; those of the
/// positives have one for every row of the first positive, then of the second, and so on. States that a row does not have are left out.
/// Where states are stacks of frames, each frame is there once, and the columns of states say which of them each is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Column {
    Frames,
    StatesT,
    StatesK,
    StatesN,
    NStepReturn,
    BootstrapDiscount,
    Action,
    NextAction,
    PositiveValid,
    K,
    Transition,
    Probability,
}

impl Column {
    pub(super) const fn is_of_states(self) -> bool {
        matches!(self, Self::StatesT | Self::StatesK | Self::StatesN)
    }
}

/// Where everything lies in the payload.
impl BatchHeader {
    /// All columns in their order, and the bytes of each. A return, a discount and a probability are an f32, a transition is a u64, all
    /// else that is neither a state nor a frame is a u8. Of numbers of 32 bits, no three make an overflow.
    pub(super) fn columns(&self) -> [(Column, u128); 12] {
        let rows = u128::from(self.rows);
        let of_positives = rows * u128::from(self.positives);
        let by_priority = self.origin.map_or(0, |_| rows);
        let frames = |it: StackedFrames| {
            u128::from(it.frames) * it.frame_bytes(self.state_bytes as usize) as u128
        };
        let states = |count: u32| u128::from(count) * self.value_bytes() as u128;
        [
            (Column::Frames, self.stacked.map_or(0, frames)),
            (Column::StatesT, states(self.rows)),
            (Column::StatesK, states(self.states_k)),
            (Column::StatesN, states(self.states_n)),
            (Column::NStepReturn, 4 * rows),
            (Column::BootstrapDiscount, 4 * rows),
            (Column::Action, rows),
            (Column::NextAction, rows),
            (Column::PositiveValid, of_positives),
            (Column::K, of_positives),
            (Column::Transition, 8 * by_priority),
            (Column::Probability, 4 * by_priority),
        ]
    }

    /// Where a column lies, in a payload of so many bytes.
    pub(super) fn range(&self, column: Column) -> Range<usize> {
        let mut end = 0;
        for (each, bytes) in self.columns() {
            let start = end;
            end += bytes as usize;
            if each == column {
                return start..end;
            }
        }
        unreachable!("{column:?} is listed")
    }

    /// Bytes of all columns; none if they are more than the address space, if there are more states than rows can have, or if
    /// states are not stacks of the frames.
    fn bytes(&self) -> Option<usize> {
        let positives = u64::from(self.rows) * u64::from(self.positives);
        let states = self.states().try_into().ok()?;
        let fits = u64::from(self.states_k) <= positives
            && self.states_n <= self.rows
            && self
                .stacked
                .is_none_or(|it| it.fit(states, self.state_bytes as usize));
        let bytes = || self.columns().iter().map(|(_, bytes)| bytes).sum::<u128>();
        fits.then(bytes).and_then(|it| it.try_into().ok())
    }

    fn states(&self) -> u64 {
        u64::from(self.rows) + u64::from(self.states_k) + u64::from(self.states_n)
    }

    /// The values of a column of f32 [B].
    pub(super) fn f32s(&self, column: Column, payload: &[u8]) -> impl Iterator<Item = f32> {
        let (values, _) = payload[self.range(column)].as_chunks();
        values.iter().copied().map(f32::from_le_bytes)
    }

    /// Whether each row [B] bootstraps, in a payload whose scalars are written.
    pub(super) fn bootstraps(&self, payload: &[u8]) -> Vec<bool> {
        let discounts = self.f32s(Column::BootstrapDiscount, payload);
        discounts.map(|discount| discount != 0.0).collect()
    }

    /// Whether each positive [P, B] is there, in a payload whose scalars are written.
    pub(super) fn positives_there(&self, payload: &[u8]) -> Vec<bool> {
        let valid = payload[self.range(Column::PositiveValid)].iter();
        valid.map(|&valid| valid != 0).collect()
    }

    fn of_states<'a>(&self, payload: &'a [u8]) -> &'a [u8] {
        &payload[self.range(Column::StatesT).start..self.range(Column::StatesN).end]
    }

    /// Bytes of a value in a column of states: all of a state, or what says of which frames it is made.
    pub(super) fn value_bytes(&self) -> usize {
        let stacked = self.stacked.as_ref();
        stacked.map_or(self.state_bytes as usize, StackedFrames::stack_bytes)
    }

    /// Frames that travel, and bytes of each: states where they are one frame.
    pub(super) fn frames(&self) -> (usize, usize) {
        let state_bytes = self.state_bytes as usize;
        match self.stacked {
            None => (self.states() as usize, state_bytes),
            Some(stacked) => (stacked.frames as usize, stacked.frame_bytes(state_bytes)),
        }
    }
}

/// Why there is no batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum NotReady {
    /// Not yet: who waits for what.
    Wait(Waiting),
    /// Never again: all transitions are in and sampled.
    Finished,
    /// Never: the reason, for a person.
    Refused {
        /// Why, and what to do about it.
        why: String,
    },
}

/// The answer to a request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum BatchReply {
    /// The payload that follows is a batch.
    Batch(BatchHeader),
    /// There is none.
    NotReady(NotReady),
}

impl BatchReply {
    pub(super) fn checked(&self, payload: &[u8]) -> Result<(), CodecError> {
        match self {
            Self::Batch(header) => header.check_payload(payload),
            Self::NotReady(_) => no_payload(payload),
        }
    }
}
