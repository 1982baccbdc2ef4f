//! `driml inspect`: what a configuration builds, holds, sends and computes.

use std::path::PathBuf;

use clap::Args;
use driml_envs::WorldName;
use driml_launch::{
    checkpoint_choice::read_config,
    console::print,
    inspect::{Inspection, describe_worlds},
    run_folder::RunFolder,
};
use driml_machine::resources::Machine;
use driml_settings::flags::{RunFlags, resolve};

#[derive(Debug, Args)]
pub(crate) struct InspectArgs {
    #[command(flatten)]
    pub(crate) settings: RunFlags,
    /// Use the settings of the run in this folder
    #[arg(long, value_name = "DIR", conflicts_with_all = ["env", "agent", "preset", "config", "Flags"])]
    pub(crate) run: Option<PathBuf>,
    /// Print one line per world
    #[arg(long, conflicts_with_all = ["env", "config", "run"])]
    pub(crate) worlds: bool,
    /// Print JSON
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: &InspectArgs) -> anyhow::Result<()> {
    let machine = Machine::detect();
    if args.worlds {
        let mut flags = args.settings.clone();
        let mut inspections = Vec::new();
        for world in WorldName::all() {
            flags.env = Some(world.to_string());
            if flags.choice()?.fits_world() {
                inspections.push(Inspection::new(&resolve(&flags, &machine)?.0)?);
            }
        }
        return match args.json {
            true => print(&(serde_json::to_string_pretty(&inspections)? + "\n")),
            false => print(&describe_worlds(&inspections)),
        };
    }
    let config = match &args.run {
        Some(folder) => read_config(&RunFolder::new(folder))?,
        None => resolve(&args.settings, &machine)?.0,
    };
    let inspection = Inspection::new(&config)?;
    match args.json {
        true => print(&(serde_json::to_string_pretty(&inspection)? + "\n")),
        false => print(&inspection.describe()),
    }
}
