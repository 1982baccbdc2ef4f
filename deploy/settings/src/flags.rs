//! The flags that choose a run's settings, and the settings that they resolve to.
//! Every command that starts a run takes them.

use std::path::PathBuf;

use clap::Args;
use driml_envs::WorldName;
use driml_machine::{
    error::{Usage, usage},
    resources::Machine,
};

use crate::{
    config::RunConfig,
    presets,
    resolve::{self, Flags, Source},
};

/// World where none is given.
pub const ENV: &str = "procgen:coinrun";
/// Agent where none is given.
pub const AGENT: &str = "driml-ada";

/// What to train, and with which settings.
#[derive(Clone, Debug, Args)]
pub struct RunFlags {
    /// World, such as procgen:coinrun or mspacman; `driml presets` lists them. "exec:COMMAND" is a process of yours, such as
    /// driml_env.py around a Gymnasium environment [default: procgen:coinrun]
    #[arg(long, value_name = "WORLD")]
    pub env: Option<String>,
    /// Agent: c51, rainbow, driml-fix, driml-ada, driml-randk, driml-noact, cpc or curl [default: driml-ada]
    #[arg(long, value_name = "AGENT")]
    pub agent: Option<String>,
    /// Named settings; `driml presets` lists them [default: tuned on Procgen, paper elsewhere]
    #[arg(long, value_name = "NAME")]
    pub preset: Option<String>,
    /// Settings of another run, its config.toml, instead of world, agent and preset
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "env", "agent"])]
    pub config: Option<PathBuf>,
    /// What applies over them.
    #[command(flatten)]
    pub over: Flags,
}

/// The settings that the flags ask for, and where they come from.
pub fn resolve(args: &RunFlags, machine: &Machine) -> Result<(RunConfig, String), Usage> {
    let (source, from) = match &args.config {
        Some(path) => {
            let name = path.display().to_string();
            let text = std::fs::read_to_string(path);
            let text = text.map_err(|e| usage!("reading the settings {name}: {e}"))?;
            (Source::File(name.clone(), text), name)
        }
        None => {
            let world = args.env.as_deref().unwrap_or(ENV).parse();
            let world: WorldName = world.map_err(|e| usage!("--env: {e}"))?;
            let agent = presets::agent(args.agent.as_deref().unwrap_or(AGENT))?;
            let preset = presets::preset_or_default(args.preset.as_deref(), world)?;
            let source = Source::Layers(preset, world, agent);
            (source, format!("preset {}", preset.name))
        }
    };
    Ok((resolve::resolve(&source, &args.over, machine)?, from))
}

/// [`resolve`] of names and `--set`s, for code that has no command line.
pub fn of_names(
    preset: &str,
    world: &str,
    agent: &str,
    sets: &[&str],
    machine: &Machine,
) -> Result<RunConfig, Usage> {
    let flags = RunFlags {
        env: Some(world.into()),
        agent: Some(agent.into()),
        preset: Some(preset.into()),
        config: None,
        over: Flags {
            sets: sets.iter().map(|&set| set.into()).collect(),
            ..Flags::default()
        },
    };
    Ok(resolve(&flags, machine)?.0)
}
