//! `driml inspect`: what a world and an agent build, compute and send, and why.

use std::path::PathBuf;

use clap::Args;
use driml_envs::WorldName;
use driml_launch::{
    console::{self, print},
    inspect::{Inspection, worlds},
    run_folder::RunFolder,
};
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
    /// Also play all --frames, without learning, and count what the rows of batches hold; some thousand frames are enough
    #[arg(long, requires = "frames")]
    pub(crate) play: bool,
    /// The agent in every world, a Markdown table
    #[arg(long, conflicts_with_all = ["env", "config", "run", "json"])]
    pub(crate) worlds: bool,
    /// With --worlds: as CSV, in bytes and FLOPs
    #[arg(long, requires = "worlds")]
    pub(crate) csv: bool,
    /// Print it as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

/// Prints what there is.
///
/// # Errors
/// Settings that cannot work, or a folder that is no run's.
pub(crate) fn run(args: &InspectArgs) -> anyhow::Result<()> {
    if args.worlds {
        return print(&in_every_world(args)?);
    }
    let config = match &args.run {
        Some(folder) => of_run(&RunFolder::new(folder))?,
        None => resolve(&args.settings, &Machine::this())?.0,
    };
    let mut inspection = Inspection::of(&config)?;
    if args.play {
        config.world.install(&mut console::line)?;
        inspection.played = Some(Inspection::play(&config)?);
    }
    if args.json {
        print(&inspection.json()?)
    } else {
        print(&inspection.describe())
    }
}

/// The table of the agent in every world.
fn in_every_world(args: &InspectArgs) -> anyhow::Result<String> {
    let machine = Machine::this();
    let mut configs = Vec::new();
    for world in WorldName::all() {
        let name = world.to_string();
        let flags = RunFlags {
            env: Some(name.clone()),
            ..args.settings.clone()
        };
        let config = resolve(&flags, &machine)?.0;
        let played = if args.play {
            console::line(&format!("playing {name}"));
            config.world.install(&mut console::line)?;
            Some(Inspection::play(&config)?)
        } else {
            None
        };
        configs.push((config, played));
    }
    match args.csv {
        true => worlds::csv(&configs),
        false => worlds::markdown(&configs),
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
