//! `driml status`: who takes part in a run, who waits for whom, and what it would take to go on.

use clap::Args;
use driml_launch::status;

use super::look::LookFlags;

#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    look: LookFlags,
    /// Ask every two seconds until the run is over or Ctrl-C
    #[arg(long)]
    pub(crate) watch: bool,
    /// Write JSON to stdout, an object for each answer
    #[arg(long)]
    pub(crate) json: bool,
}

/// Asks, and prints the answers.
///
/// # Errors
/// A call that cannot work, or nobody there.
pub(crate) fn run(args: &StatusArgs) -> anyhow::Result<()> {
    match args.look.open()? {
        Some(mut connection) => {
            let folder = args.look.folder();
            status::run(&mut connection, folder.as_ref(), args.watch, args.json).map(drop)
        }
        None => Ok(()),
    }
}
