//! What a batch says of itself, and the reply that it travels in.
//! It knows how many bytes a batch has and which are absurd; what they mean is `batch`'s.

use serde::{Deserialize, Serialize};

use super::{
    batch_frames::StackedFrames, priorities::Origin, shard_counts::ShardCounts, status::Waiting,
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
        let mut chances = self.probabilities(payload);
        if let Some(chance) = chances.find(|chance| !(*chance > 0.0 && *chance <= 1.0)) {
            return Err(CodecError::Header(format!(
                "a row that was drawn with the probability {chance}"
            )));
        }
        Ok(())
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
