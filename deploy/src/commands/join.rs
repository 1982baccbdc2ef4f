//! What the commands that take part in a run share: how they reach it, and what they leave when they end.

use anyhow::Context;
use clap::Args;
use driml_launch::{endpoint::NAMESPACE, meeting, shared_memory};
use driml_machine::error::Usage;
use driml_protocol::{Keys, Shutdown, session};

/// How a process reaches the run.
#[derive(Debug, Args)]
pub(crate) struct JoinFlags {
    /// Prefix of the run's keys
    #[arg(long, value_name = "NS", default_value = NAMESPACE)]
    pub(crate) namespace: String,
    /// End when the process that started this one, which has this number, ends
    #[arg(long, value_name = "PID", hide = true)]
    pub(crate) exit_with_parent: Option<u32>,
}

/// Checks how a process reaches the run, and starts to listen for signals.
///
/// # Errors
/// A namespace that is none.
pub(super) fn join(flags: &JoinFlags) -> anyhow::Result<Shutdown> {
    Keys::new(&flags.namespace).map_err(Usage)?;
    if flags.exit_with_parent.is_none() {
        session::sweep_shared_memory();
    }
    Shutdown::on_signals(flags.exit_with_parent).context("listening for signals")
}

/// What a process does when it has ended, well or not: nothing of it is left outside the run folder.
pub(super) fn clean_up_after(ran: anyhow::Result<()>) -> anyhow::Result<()> {
    meeting::leave();
    shared_memory::remove_own();
    ran
}
