//! Placeholder of `driml evaluate`.
//! It plays nothing yet.

use crate::cli::EvaluateArgs;

/// Plays whole episodes with a run's newest weights.
///
/// # Errors
/// Always, for now.
pub(crate) fn run(_args: &EvaluateArgs) -> anyhow::Result<()> {
    anyhow::bail!("`driml evaluate` is not built yet")
}
