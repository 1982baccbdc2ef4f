//! What can be wrong with an affinity estimate: its settings, its pairs of actions or its saved state.

/// A fault in settings or pairs.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("action affinity: {0}")]
pub struct AffinityError(pub(super) String);
