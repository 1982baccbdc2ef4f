//! The flags that choose a run's settings, and how presets or a file, flags and `--set` are combined. Every command that starts a run takes
//! these flags. The only numbers filled in here are derived from others or from the machine.

use std::path::PathBuf;

use clap::Args;
use driml_machine::{
    error::{Usage, usage},
    resources::{self, Machine},
    whole_number,
};
use toml::{Table, Value};

use crate::{
    config::RunConfig,
    derived, memory,
    overrides::{Override, find, insert, insert_missing, remove},
    presets::{Choice, agents},
};

/// The limit on a compressed replay, which the machine's memory decides if the user does not.
const COMPRESSED_MAX: &str = "replay.compressed_bytes_max";

/// What to train, and with which settings.
#[derive(Clone, Debug, Args)]
pub struct RunFlags {
    /// World, such as mspacman [default: procgen:coinrun]; `driml presets` lists them. "exec:COMMAND" is a process of yours, such as
    /// driml_env.py around a Gymnasium environment
    #[arg(long, value_name = "WORLD")]
    pub env: Option<String>,
    /// Agent; the help lists all, also those that a program adds.
    #[arg(long, value_name = "AGENT", help = agent_help())]
    pub agent: Option<String>,
    /// Named settings [default: tuned on Procgen, paper elsewhere]; `driml presets` lists them
    #[arg(long, value_name = "NAME")]
    pub preset: Option<String>,
    /// Settings of another run, its config.toml, instead of world, agent and preset
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "env", "agent"])]
    pub config: Option<PathBuf>,
    /// What applies over them.
    #[command(flatten)]
    pub flags: Flags,
}

impl RunFlags {
    /// Preset, world and agent.
    pub fn choice(&self) -> Result<Choice, Usage> {
        let names = [&self.preset, &self.env, &self.agent];
        let [preset, env, agent] = names.map(Option::as_deref);
        Choice::new(preset, env, agent)
    }
}

fn agent_help() -> String {
    let names: Vec<_> = agents().into_iter().map(|it| it.name).collect();
    format!("Agent: {} [default: driml-ada]", names.join(", "))
}

/// Flags over the source; `--set` applies after the others.
#[derive(Clone, Debug, Default, Args)]
pub struct Flags {
    /// Actor processes [default: by number of cores]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=256))]
    pub actors: Option<u32>,
    /// Replay servers, each with a share of the actors and memory [default: 1]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=256))]
    pub replay_shards: Option<u32>,
    /// Environments per actor [default: as the preset says]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=4096))]
    pub envs: Option<u32>,
    /// Frames of the run; it is finished when they are stored and their updates are done
    #[arg(long, value_name = "N", value_parser = whole_number::within(1..=i64::MAX as u64))]
    pub frames: Option<u64>,
    /// Seed of the run
    #[arg(long, value_name = "S", value_parser = whole_number::within(0..=i64::MAX as u64))]
    pub seed: Option<u64>,
    /// One setting by its dotted path, such as learner.update.adam.lr=1e-4; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    /// Whether one replay server starts on this machine, and the rest of the run is elsewhere or started before.
    #[arg(skip)]
    pub server_alone: bool,
}

/// Returns the settings that the flags ask for, and the name of their source.
pub fn resolve(args: &RunFlags, machine: &Machine) -> Result<(RunConfig, String), Usage> {
    let (source, from) = match &args.config {
        Some(path) => {
            // The folder of a run stands for its settings.
            let in_folder = path.join("config.toml");
            let path = if path.is_dir() { &in_folder } else { path };
            let name = path.display().to_string();
            let text = std::fs::read_to_string(path);
            let text = text.map_err(|e| usage!("reading the settings {name}: {e}; --config takes a TOML file or the folder of a run"))?;
            (Source::of_another_run(&name, &text)?, name)
        }
        None => {
            let choice = args.choice()?;
            let from = format!("preset {}", choice.preset.name);
            (Source::Presets(choice), from)
        }
    };
    Ok((source.resolve(&args.flags, machine)?, from))
}

/// Like [`resolve`], from names and `--set` values, for code without a command line.
pub fn resolve_names(
    preset: &str,
    world: &str,
    agent: &str,
    sets: &[&str],
    machine: &Machine,
) -> Result<RunConfig, Usage> {
    let choice = Choice::new(Some(preset), Some(world), Some(agent))?;
    let flags = Flags {
        sets: sets.iter().map(|&set| set.into()).collect(),
        ..Flags::default()
    };
    Source::Presets(choice).resolve(&flags, machine)
}

/// The source of the settings before flags are applied.
#[derive(Clone, Debug)]
pub enum Source {
    /// Preset, world and agent.
    Presets(Choice),
    /// A file that driml wrote: its name and text.
    File(String, String),
}

impl Source {
    /// The settings of another run, from the file `name`. What only follows from them also follows from what flags change.
    fn of_another_run(name: &str, text: &str) -> Result<Self, Usage> {
        let mut table = derived::parse_file(name, text)?;
        derived::remove_following(&mut table)?;
        Ok(Self::File(name.into(), table.to_string()))
    }

    /// Resolves the settings of a run: source, flags, `--set`, what the machine decides, what follows from the rest.
    ///
    /// # Errors
    /// A setting is unknown, of the wrong type, out of range, or at odds with another. The error names the first such setting.
    pub fn resolve(&self, flags: &Flags, machine: &Machine) -> Result<RunConfig, Usage> {
        let mut table = match self {
            Self::Presets(choice) => {
                let (mut table, world) = (choice.merged()?, choice.world);
                // Everything else follows from these names.
                insert(&mut table, "run.world", world.to_string().into());
                insert(&mut table, "run.agent", choice.agent.name.into());
                insert(&mut table, derived::FRAME_PATH, Table::new().into());
                if let Some(command) = world.command() {
                    // The start of the world needs its time-outs now.
                    for text in &flags.sets {
                        let parsed = Override::parse(text)?;
                        if parsed.path.starts_with("world.") {
                            parsed.apply(&mut table)?;
                        }
                    }
                    derived::fill_in_declaration(&mut table, command)?;
                }
                for (path, value) in [
                    ("local.actors", Value::from(machine.default_actors())),
                    ("local.learner_threads", machine.cores.into()),
                    ("local.learner_device", "cpu".into()),
                    ("actor.envs", resources::ENVS_PER_ACTOR.into()),
                    ("actor.world_threads", 0.into()),
                ] {
                    insert_missing(&mut table, path, value);
                }
                table
            }
            Self::File(name, text) => derived::parse_file(name, text)?,
        };
        for (path, value) in [
            ("local.actors", flags.actors.map(u64::from)),
            ("actor.envs", flags.envs.map(u64::from)),
            ("replay.transitions_max", flags.frames),
            ("replay.shards", flags.replay_shards.map(u64::from)),
            ("run.seed", flags.seed),
        ] {
            if let Some(number) = value {
                let whole = i64::try_from(number)
                    .map_err(|_| usage!("{path} = {number}: the largest number is {}", i64::MAX))?;
                insert(&mut table, path, whole.into());
            }
        }
        let sized_by_machine = matches!(self, Self::Presets(_));
        let by_hand = apply_sets(&mut table, &flags.sets)?;
        let is_set = |path: &str| by_hand.iter().any(|set| set == path);
        if sized_by_machine || is_set("model.torso") {
            derived::drop_other_torsos(&mut table, is_set)?;
        }
        let compression = find(&table, "replay.compression").and_then(Value::as_str);
        let is_off = compression == Some("none") && is_set("replay.compression");
        if is_off && !is_set(COMPRESSED_MAX) {
            remove(&mut table, COMPRESSED_MAX);
        }
        let is_capacity_set = is_set("replay.capacity_transitions") || !sized_by_machine;
        let in_file = |e| match self {
            Self::File(name, _) if flags.sets.is_empty() => usage!("{name}: {e}"),
            _ => e,
        };
        derived::resolve_precision(&mut table, machine.fast_bf16).map_err(in_file)?;
        let mut config = RunConfig::derive(table).map_err(in_file)?;
        memory::fit(&mut config, is_capacity_set, flags.server_alone, machine).map_err(in_file)?;
        config = config.checked().map_err(in_file)?;
        if let Self::Presets(choice) = self {
            config.accuracy_note = choice.preset.accuracy_note();
        }
        Ok(config)
    }
}

/// Applies every `--set`; returns the paths that were set.
fn apply_sets(table: &mut Table, sets: &[String]) -> Result<Vec<String>, Usage> {
    let mut paths = Vec::with_capacity(sets.len());
    for text in sets {
        let parsed = Override::parse(text)?;
        if let Some((known, how)) = derived::find_derived(&parsed.path) {
            return Err(usage!("{known} cannot be set: it {how}"));
        }
        let mut tried = table.clone();
        let is_new = parsed.apply(&mut tried)?;
        // A new key may be an optional setting, which the type of its table knows.
        if is_new {
            let mut read = tried.clone();
            derived::resolve_precision(&mut read, false)?;
            let read = RunConfig::derive(read);
            let key = parsed.path.rsplit('.').next().unwrap_or_default();
            let unknown = format!("unknown field `{key}`");
            if read.is_err_and(|e| e.0.contains(&unknown)) {
                return Err(parsed.unknown_key(table));
            }
        }
        *table = tried;
        paths.push(parsed.path);
    }
    Ok(paths)
}

#[cfg(test)]
mod tests;
