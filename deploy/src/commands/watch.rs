//! `driml watch`: how a run goes, wherever its parts are and whoever started them.

use std::path::PathBuf;

use clap::Args;
use driml_launch::{
    run_folder::RunFolder,
    watch::{self, Outputs},
};

use super::look::LookFlags;

#[derive(Debug, Args)]
pub(crate) struct WatchArgs {
    #[command(flatten)]
    look: LookFlags,
    /// Write settings, metrics and summary there, as `driml train` does; a folder that holds the same run is gone on with
    #[arg(long, value_name = "DIR")]
    pub(crate) run_dir: Option<PathBuf>,
    /// Write events for TensorBoard too, in that folder
    #[arg(long, requires = "run_dir")]
    pub(crate) tensorboard: bool,
    /// One look and out, as `driml status` prints it; the exit code is 0 if nothing is missing, else 1
    #[arg(long, conflicts_with = "run_dir")]
    pub(crate) once: bool,
    /// With --once: print one JSON object
    #[arg(long, requires = "once")]
    pub(crate) json: bool,
    /// Write the numbers into this file in Prometheus' text format at each answer, whole or not at all: for node_exporter's textfile
    /// collector, which reads files named *.prom
    #[arg(long, value_name = "FILE")]
    pub(crate) prometheus: Option<PathBuf>,
}

/// Watches until the run is over.
///
/// # Errors
/// A call that cannot work, nobody there, or a folder that cannot be written to.
pub(crate) fn run(args: &WatchArgs) -> anyhow::Result<()> {
    let Some(connection) = args.look.open()? else {
        return Ok(());
    };
    let outputs = Outputs {
        run_dir: args.run_dir.as_ref().map(RunFolder::new),
        tensorboard: args.tensorboard,
        prometheus: args.prometheus.clone(),
    };
    match args.once {
        true => watch::once(connection, &outputs, args.json),
        false => watch::run(connection, &outputs),
    }
}
