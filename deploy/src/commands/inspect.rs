//! `driml inspect`: what a world and an agent build, compute and send, and why.

use std::path::PathBuf;

use clap::Args;
use driml_launch::{console::print, inspect::Inspection, run_folder::RunFolder};
use driml_machine::{
    error::{Usage, usage},
    resources::Machine,
};
use driml_settings::{
    config::RunConfig,
    flags::{RunFlags, resolve},
};

#[derive(Debug, Args)]
pub(crate) struct InspectArgs {
    #[command(flatten)]
    pub(crate) settings: RunFlags,
    /// The settings of the run in this folder
    #[arg(long, value_name = "DIR", conflicts_with_all = ["RunFlags", "Flags"])]
    pub(crate) run: Option<PathBuf>,
    /// Print it as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

/// Prints what there is.
///
/// # Errors
/// Settings that cannot work, or a folder that is no run's.
pub(crate) fn run(args: &InspectArgs) -> anyhow::Result<()> {
    let config = match &args.run {
        Some(folder) => of_run(&RunFolder::new(folder))?,
        None => resolve(&args.settings, &Machine::this())?.0,
    };
    let inspection = Inspection::of(&config)?;
    if args.json {
        print(&inspection.json()?)
    } else {
        print(&inspection.describe())
    }
}

/// The settings of a run.
fn of_run(folder: &RunFolder) -> Result<RunConfig, Usage> {
    let path = folder.config();
    let name = path.display().to_string();
    let text = std::fs::read_to_string(&path).map_err(|e| {
        usage!(
            "{} is not the folder of a run: reading {name}: {e}",
            folder.display()
        )
    })?;
    RunConfig::parse(&name, &text)
}
