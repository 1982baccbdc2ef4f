//! The flags that choose a run's settings, and the settings that they resolve to.
//! Every command that starts a run takes them.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use driml_envs::WorldName;
use driml_machine::{
    error::{Usage, usage},
    resources::Machine,
};
use driml_replay_server::Study;

use crate::{
    config::{self, Flags, RunConfig, Source},
    presets,
};

const ENV: &str = "procgen:bigfish";
const AGENT: &str = "driml-ada";

/// What to train, and with which settings.
#[derive(Clone, Debug, Args)]
pub struct RunFlags {
    /// World, such as procgen:coinrun or mspacman; `driml presets` lists them [default: procgen:bigfish]
    #[arg(long, value_name = "WORLD")]
    pub env: Option<String>,
    /// Agent: c51, driml-fix, driml-ada, driml-randk, driml-noact, cpc or curl [default: driml-ada]
    #[arg(long, value_name = "AGENT")]
    pub agent: Option<String>,
    /// Named settings; `driml presets` lists them [default: paper]
    #[arg(long, value_name = "NAME")]
    pub preset: Option<String>,
    /// Resolved settings of another run, its config.toml, instead of world, agent and preset
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "env", "agent"])]
    pub config: Option<PathBuf>,
    /// Actor processes [default: by cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub actors: Option<u32>,
    /// Replay servers among which the actors and the memory are spread [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub replay_shards: Option<u32>,
    /// Copies of the world in each actor [default: 16]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub envs: Option<u32>,
    /// Frames of the whole run; it ends when they are in and their updates done
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=i64::MAX as u64))]
    pub frames: Option<u64>,
    /// Seed of every generator of the run
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(0..=i64::MAX as u64))]
    pub seed: Option<u64>,
    /// For studies alone: train with a known fault of the paper's published code
    #[arg(long, value_name = "FAULT", value_enum)]
    pub study: Option<ReproducedBug>,
    /// One setting by its dotted path, such as learner.update.adam.lr=1e-4; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
}

/// A known fault of the paper's published code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ReproducedBug {
    /// n-step returns that bootstrap from s_{t+1}, with the end of an episode seen at step t alone
    BootstrapFromNextState,
}

/// The settings that the flags ask for, and where they come from.
///
/// # Errors
/// Flags or a file that cannot work.
pub fn resolve(args: &RunFlags, machine: &Machine) -> Result<(RunConfig, String), Usage> {
    let (source, from) = match &args.config {
        Some(path) => {
            let name = path.display().to_string();
            let text = std::fs::read_to_string(path)
                .map_err(|e| usage!("reading the settings {name}: {e}"))?;
            (Source::File(name.clone(), text), name)
        }
        None => {
            let world: WorldName = args
                .env
                .as_deref()
                .unwrap_or(ENV)
                .parse()
                .map_err(|e| usage!("--env: {e}"))?;
            let agent = presets::agent(args.agent.as_deref().unwrap_or(AGENT))?;
            let preset =
                presets::preset(args.preset.as_deref().unwrap_or(presets::PRESETS[0].name))?;
            (
                Source::Layers(preset, world, agent.name),
                format!("preset {}", preset.name),
            )
        }
    };
    Ok((config::resolve(&source, &flags(args), machine)?, from))
}

/// The flags in the order in which they apply over presets or a file.
pub fn flags(args: &RunFlags) -> Flags {
    Flags {
        actors: args.actors,
        envs: args.envs,
        frames: args.frames,
        replay_shards: args.replay_shards,
        seed: args.seed,
        study: args.study.map(|fault| match fault {
            ReproducedBug::BootstrapFromNextState => Study::BootstrapFromNextState,
        }),
        sets: args.sets.clone(),
    }
}
