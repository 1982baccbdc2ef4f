//! How long a message of each kind can be in this run, from its own settings: longer ones are no part's.
//! It refuses nothing.

use anyhow::Context;
use driml_protocol::{RunSpec, TRANSITION_BYTES, config::Settings, transitions_max};

/// What stands before a payload: the prefix and the header.
const HEAD_BYTES_MAX: usize = 1 << 12;

/// Bytes of a row's number and priority.
const PRIORITY_BYTES_MAX: usize = 9 + 4;

/// Bytes of the longest message of each kind.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// A chunk.
    pub(super) chunk: usize,
    /// An upload of weights.
    pub(super) weights: usize,
    /// An affinity matrix, which is its header.
    pub(super) affinity: usize,
    /// Priorities of a batch's rows, which are their header.
    pub(super) priorities: usize,
    /// Whatever has no payload.
    pub(super) small: usize,
    /// Rows of a batch.
    pub(super) batch_rows: u32,
}

impl Limits {
    /// The limits of a run with these settings and weights of so many bytes.
    ///
    /// # Errors
    /// A number of another part's settings that is missing.
    pub(super) fn of(
        settings: &Settings,
        spec: &RunSpec,
        weights_bytes: usize,
    ) -> anyhow::Result<Self> {
        let actor = |key| number(settings, "actor", key);
        // Not there: it bounds nothing.
        let round = actor("round_transitions_max").ok().map(u64::from);
        let transitions = transitions_max(actor("envs")?, actor("steps_per_chunk")?, round);
        let transition_bytes = (spec.frame_bytes() + TRANSITION_BYTES) as u64;
        let chunk = usize::try_from(transitions.saturating_mul(transition_bytes))?;
        let actions = spec.num_actions as usize;
        let batch_rows = number(settings, "learner", "batch_size")?;
        Ok(Self {
            chunk: chunk.saturating_add(HEAD_BYTES_MAX),
            // Room for a learner that writes the same numbers at greater length.
            weights: weights_bytes
                .saturating_mul(2)
                .saturating_add(HEAD_BYTES_MAX),
            affinity: 4 * actions * actions + HEAD_BYTES_MAX,
            priorities: PRIORITY_BYTES_MAX * batch_rows as usize + 2 * HEAD_BYTES_MAX,
            small: HEAD_BYTES_MAX,
            batch_rows,
        })
    }

    /// The longest of all.
    pub(super) fn largest(&self) -> usize {
        let learned = self.weights.max(self.affinity).max(self.priorities);
        self.chunk.max(learned)
    }
}

/// One whole number of another part's settings.
pub(super) fn number(settings: &Settings, table: &'static str, key: &str) -> anyhow::Result<u32> {
    let values: toml::Table = settings.table(table)?;
    let value = values.get(key).and_then(toml::Value::as_integer);
    let value = value.with_context(|| format!("{table}.{key} is missing or not a whole number"))?;
    u32::try_from(value).with_context(|| format!("{table}.{key} = {value} cannot work"))
}
