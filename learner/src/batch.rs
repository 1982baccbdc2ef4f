//! The batch that one update reads: borrowed columns, checked before anything is computed.
//! It is not the format on the wire (`driml_protocol::Batch` is), and no rows are sampled here.

use driml_model::ModelConfig;
use driml_protocol::NO_ACTION;

use crate::{
    auxiliary::positives::Positives,
    error::{Result, UpdateError},
};

/// B rows (s_t, a_t, a_{t+1}, n-step return, discount, s_{t+k}, s_{t+n}), stored column by column.
///
/// For CURL, whose positive is not a later state, `anchors` and `states_k` are two views of s_t.
#[derive(Clone, Copy, Debug)]
pub struct Batch<'a> {
    /// Rows, B, at least 1.
    pub rows: usize,
    /// s_t [B, H, W, C].
    pub states_t: &'a [u8],
    /// Augmented s_t for the auxiliary loss [B, H, W, C]; `None` if the loss sees `states_t`.
    pub anchors: Option<&'a [u8]>,
    /// The number of positives per row, P; 0 if the agent uses none.
    pub positives: usize,
    /// s_{t+k} as the auxiliary loss sees it [P, B, H, W, C], or only the states of valid positives, in this order.
    pub states_k: &'a [u8],
    /// s_{t+n} [B, H, W, C], or only the states of rows that bootstrap, in this order.
    pub states_n: &'a [u8],
    /// a_t [B].
    pub action: &'a [u8],
    /// a_{t+1} [B], or [`NO_ACTION`].
    pub next_action: &'a [u8],
    /// Sum of gamma^i r_{t+i} over i < n, stopped at the episode's end [B], in units of return.
    pub n_step_return: &'a [f32],
    /// gamma^n, or 0 where the episode ended within the n steps [B], in [0, 1].
    pub bootstrap_discount: &'a [f32],
    /// Whether the row has this positive [P, B]: 0 if not.
    pub positive_valid: &'a [u8],
    /// Factor on each row's C51 loss [B], 0 or above; `None` if rows were drawn equally likely. The auxiliary losses are not weighted:
    /// they compare a batch's rows with one another, so that they are not means of a loss per row.
    pub importance_weight: Option<&'a [f32]>,
}

/// The columns of a [`Batch`] as owned vectors, under the same names.
#[derive(Clone, Debug, Default)]
#[allow(missing_docs, reason = "Batch has them")]
pub struct OwnedBatch {
    pub states_t: Vec<u8>,
    pub anchors: Option<Vec<u8>>,
    pub states_k: Vec<u8>,
    pub states_n: Vec<u8>,
    pub action: Vec<u8>,
    pub next_action: Vec<u8>,
    pub n_step_return: Vec<f32>,
    pub bootstrap_discount: Vec<f32>,
    pub positive_valid: Vec<u8>,
    pub importance_weight: Option<Vec<f32>>,
}

impl OwnedBatch {
    /// Borrows the columns as a batch, with as many rows as `action` has entries.
    pub fn batch(&self) -> Batch<'_> {
        let rows = self.action.len();
        Batch {
            rows,
            states_t: &self.states_t,
            anchors: self.anchors.as_deref(),
            positives: self.positive_valid.len().checked_div(rows).unwrap_or(0),
            states_k: &self.states_k,
            states_n: &self.states_n,
            action: &self.action,
            next_action: &self.next_action,
            n_step_return: &self.n_step_return,
            bootstrap_discount: &self.bootstrap_discount,
            positive_valid: &self.positive_valid,
            importance_weight: self.importance_weight.as_deref(),
        }
    }
}

impl<'a> Batch<'a> {
    /// Checks lengths against `model`, positives against what the auxiliary loss requires, actions, returns and discounts.
    pub fn validate(&self, model: &ModelConfig, required: Positives) -> Result<()> {
        let invalid = |what: String| Err(UpdateError::Batch(what));
        let rows = self.rows;
        if rows == 0 {
            return invalid("it has no rows".to_owned());
        }
        let state_bytes = model.frame_len();
        let positives = self.positives;
        if let Err(needed) = required.check_batch(positives, self.anchors.is_some()) {
            return invalid(format!(
                "it has {positives} positives a row; this agent needs {needed}"
            ));
        }
        let anchors = self.anchors.unwrap_or(self.states_t);
        let weights = self.importance_weight.map_or(rows, <[f32]>::len);
        for (name, length, row_length) in [
            ("states_t", self.states_t.len(), state_bytes),
            ("anchors", anchors.len(), state_bytes),
            ("action", self.action.len(), 1),
            ("next_action", self.next_action.len(), 1),
            ("n_step_return", self.n_step_return.len(), 1),
            ("bootstrap_discount", self.bootstrap_discount.len(), 1),
            ("positive_valid", self.positive_valid.len(), positives),
            ("importance_weight", weights, 1),
        ] {
            if length != rows * row_length {
                return invalid(format!(
                    "{name} has {length} values, not {rows} rows of {row_length}"
                ));
            }
        }
        let bootstraps = self.bootstrapping_rows().count();
        let all = self.positive_valid.len();
        let valid = self.positive_valid.iter().filter(|valid| **valid != 0);
        for (name, length, all, present) in [
            ("states_k", self.states_k.len(), all, valid.count()),
            ("states_n", self.states_n.len(), rows, bootstraps),
        ] {
            if length != all * state_bytes && length != present * state_bytes {
                return invalid(format!(
                    "{name} has {length} values, not {all} states of {state_bytes}, nor the {present} that its rows have"
                ));
            }
        }
        let is_invalid = |weight: &f32| !(weight.is_finite() && *weight >= 0.0);
        let weights = self.importance_weight.unwrap_or_default();
        if let Some(row) = weights.iter().position(is_invalid) {
            return invalid(format!("row {row} has the weight {}", weights[row]));
        }
        let is_known = |action: u8| usize::from(action) < model.num_actions;
        for row in 0..rows {
            let (action, next) = (self.action[row], self.next_action[row]);
            if !is_known(action) || !(is_known(next) || next == NO_ACTION) {
                let count = model.num_actions;
                return invalid(format!(
                    "row {row} has actions {action}, {next}; there are {count}"
                ));
            }
            let (reward, discount) = (self.n_step_return[row], self.bootstrap_discount[row]);
            if !reward.is_finite() || !(0.0..=1.0).contains(&discount) {
                return invalid(format!(
                    "row {row} has return {reward} and discount {discount}"
                ));
            }
        }
        Ok(())
    }

    pub(crate) fn bootstrapping_rows(&self) -> impl Iterator<Item = usize> {
        let discounts = self.bootstrap_discount.iter().enumerate();
        discounts.filter_map(|(row, &discount)| (discount != 0.0).then_some(row))
    }

    /// s_{t+n} of the rows that bootstrap, each `Some`. The batch must be valid for states of `state_bytes` bytes.
    pub(crate) fn next_states(&self, state_bytes: usize) -> Vec<Option<&'a [u8]>> {
        let bootstraps = self.bootstrap_discount.iter().map(|&it| it != 0.0);
        let states = place_states(self.states_n, state_bytes, bootstraps);
        states.filter(Option::is_some).collect()
    }

    /// s_{t+k} [P, B]; `None` if the row lacks this positive. The batch must be valid for states of `state_bytes` bytes.
    pub fn positive_states(&self, state_bytes: usize) -> Vec<Option<&'a [u8]>> {
        let valid = self.positive_valid.iter().map(|&it| it != 0);
        place_states(self.states_k, state_bytes, valid).collect()
    }

    /// The pairs (a_t, a_{t+1}) of `rows`, which may contain a row twice. Rows without a_{t+1} are skipped.
    pub fn action_pairs(&self, rows: impl IntoIterator<Item = usize>) -> Vec<(u8, u8)> {
        let pairs = rows
            .into_iter()
            .map(|row| (self.action[row], self.next_action[row]));
        pairs.filter(|&(_, next)| next != NO_ACTION).collect()
    }
}

/// Yields a state for each true entry of `present` and `None` for the others. `states` holds one state per entry or per true entry.
fn place_states(
    states: &[u8],
    state_bytes: usize,
    present: impl ExactSizeIterator<Item = bool>,
) -> impl Iterator<Item = Option<&[u8]>> {
    let full = states.len() == present.len() * state_bytes;
    let mut states = states.chunks_exact(state_bytes);
    present.map(move |present| {
        let state = if present || full { states.next() } else { None };
        state.filter(|_| present)
    })
}
