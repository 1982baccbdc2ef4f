//! The header of a batch, the layout of the columns in its payload, and the reply that contains a batch.
//! This file knows the possible sizes of a batch; `batch` knows the meaning of its columns.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{
    batch_frames::StackedFrames, batch_request::ShardCounts, priorities::Origin, status::Waiting,
};
use crate::{
    run_spec::RunSpec,
    sampling::Sampling,
    wire::{codec::PAYLOAD_BYTES_MAX, error::CodecError, message::check_no_payload, shared_memory},
};

/// Batches for which a replay server has shared memory: those being assembled, sent, and copied by the learner.
pub const POOL_BATCHES: usize = 6;

/// The header of a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BatchHeader {
    /// Rows, B.
    pub rows: u32,
    /// Positives per row, P: 0 without DIM.
    pub positives: u32,
    /// Bytes of one state.
    pub state_bytes: u32,
    /// States s_{t+k} in the payload: one for each positive that a row has, at most P per row.
    pub states_k: u32,
    /// States s_{t+n} in the payload: one for each row that bootstraps, at most B.
    pub states_n: u32,
    /// Counts of the replay server that drew the batch, this batch included.
    pub counts: ShardCounts,
    /// Transitions that the replay server held.
    pub held: u64,
    /// Mean age of the rows, in transitions stored since.
    pub mean_age: f64,
    /// Versions of the newest and of the oldest weights that chose an action of this batch.
    pub weights_versions: (u64, u64),
    /// The replay server that drew the rows, if they are drawn by priority.
    pub origin: Option<Origin>,
    /// How states are stacks of frames, each of which is sent once; `None` if a state is one frame.
    pub stacked: Option<StackedFrames>,
}

impl BatchHeader {
    /// Returns the header of the largest possible batch of `rows` rows in this run.
    pub fn largest(spec: &RunSpec, rows: u32) -> Self {
        let positives = spec.horizon.positives() as u32;
        Self {
            rows,
            positives,
            state_bytes: spec.state_bytes() as u32,
            states_k: rows.saturating_mul(positives),
            states_n: rows,
            weights_versions: (0, u64::MAX),
            stacked: StackedFrames::largest(spec, rows),
            ..Self::default()
        }
    }

    /// Returns the same header for rows drawn by the rule `sampling`.
    #[must_use]
    pub fn with_sampling(self, sampling: &Sampling) -> Self {
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

    /// Checks that `payload` has the right length, as many states as its rows need, and valid frame numbers and probabilities.
    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        if self.bytes() != Some(payload.len()) || self.rows == 0 {
            return Err(CodecError::Header(format!(
                "the rows, states and frames of {self:?} do not fill {} bytes of payload",
                payload.len()
            )));
        }
        if let Some(stacked) = self.stacked {
            // Limits the memory of the assembled states: many states may share few frames.
            let whole = Self {
                stacked: None,
                ..*self
            };
            let fits = whole.bytes().is_some_and(|it| it <= PAYLOAD_BYTES_MAX);
            let why = format_args!(
                "{} rows whose states would fill more than {PAYLOAD_BYTES_MAX} bytes",
                self.rows
            );
            CodecError::check(fits, why)?;
            if let Some(number) = stacked.first_unknown(&payload[self.state_range()]) {
                return Err(CodecError::Header(format!(
                    "a state has frame {number}, but the batch has {} frames",
                    stacked.frames
                )));
            }
        }
        let valid = payload[self.range(Column::PositiveValid)].iter();
        let discounts = self.f32s(Column::BootstrapDiscount, payload);
        let positives = valid.filter(|valid| **valid != 0).count();
        let bootstraps = discounts.filter(|discount| *discount != 0.0).count();
        let states = (self.states_k as usize, self.states_n as usize);
        let why = format_args!(
            "rows with {positives} positives and {bootstraps} bootstraps come with {} and {} states",
            states.0, states.1
        );
        CodecError::check((positives, bootstraps) == states, why)?;
        let mut chances = self.f32s(Column::Probability, payload);
        if let Some(chance) = chances.find(|chance| !(*chance > 0.0 && *chance <= 1.0)) {
            return Err(CodecError::Header(format!(
                "a row has the probability {chance}, which is not above 0 and at most 1"
            )));
        }
        Ok(())
    }
}

/// The columns of a batch, in the order of their layout. Each has a value for every row; a column of positives has a value for every row of
/// the first positive, then of the second, and so on. States that a row lacks are left out. If states are stacks of frames, each frame is
/// stored once, and the columns of states contain the numbers of their frames.
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

/// The layout of the payload.
impl BatchHeader {
    /// Returns all columns in order, with the bytes of each. A return, a discount and a probability are f32, a transition is u64, and other
    /// columns without states or frames are u8. Products of three numbers of 32 bits do not overflow a u128.
    pub(super) fn columns(&self) -> [(Column, u128); 12] {
        let rows = u128::from(self.rows);
        let positives = rows * u128::from(self.positives);
        let by_priority = self.origin.map_or(0, |_| rows);
        let frames = |it: StackedFrames| u128::from(it.frames) * self.frame_bytes() as u128;
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
            (Column::PositiveValid, positives),
            (Column::K, positives),
            (Column::Transition, 8 * by_priority),
            (Column::Probability, 4 * by_priority),
        ]
    }

    /// The range of a column in the payload.
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

    /// Bytes of all columns; `None` if they exceed the address space, if there are more states than rows can have, or if states cannot be
    /// stacks of the frames.
    fn bytes(&self) -> Option<usize> {
        let positives = u64::from(self.rows) * u64::from(self.positives);
        let states = self.states().try_into().ok()?;
        let fits = u64::from(self.states_k) <= positives
            && self.states_n <= self.rows
            && self
                .stacked
                .is_none_or(|it| it.can_form(states, self.state_bytes as usize));
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

    /// The range of all columns of states.
    pub(super) fn state_range(&self) -> Range<usize> {
        self.range(Column::StatesT).start..self.range(Column::StatesN).end
    }

    /// Bytes of a value in a column of states: a whole state, or the numbers of its frames.
    pub(super) fn value_bytes(&self) -> usize {
        let stacked = self.stacked.as_ref();
        stacked.map_or(self.state_bytes as usize, StackedFrames::stack_bytes)
    }

    /// Bytes of one frame. Without stacks, each state is a frame.
    pub(super) fn frame_bytes(&self) -> usize {
        let state_bytes = self.state_bytes as usize;
        self.stacked
            .map_or(state_bytes, |it| it.frame_bytes(state_bytes))
    }
}

/// Why there is no batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum NotReady {
    /// No batch is ready yet: which side waits for what.
    Wait(Waiting),
    /// No batch follows: all transitions are stored and sampled.
    Finished,
    /// The request is rejected, and a retry is useless.
    Refused {
        /// The reason and the remedy, for the user.
        why: String,
    },
}

/// The reply to a request for a batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum BatchReply {
    /// The payload that follows is a batch.
    Batch(BatchHeader),
    /// There is no batch.
    NotReady(NotReady),
}

impl BatchReply {
    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        match self {
            Self::Batch(header) => header.check_payload(payload),
            Self::NotReady(_) => check_no_payload(payload),
        }
    }
}
