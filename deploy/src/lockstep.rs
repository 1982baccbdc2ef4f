//! Placeholder of the lockstep mode.
//! It runs nothing yet.

use std::path::Path;

use crate::config::RunConfig;

/// Runs all parts in one process in a fixed order.
///
/// # Errors
/// Always, for now.
pub(crate) fn run(_config: &RunConfig, _run_dir: &Path) -> anyhow::Result<()> {
    anyhow::bail!("the lockstep mode is not built yet")
}
