//! The command line of `driml experiment`.
//! Each experiment interprets its own values; this module also reads the built-in settings of the full or smoke length.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::PathBuf,
};

use clap::{Args, Subcommand};
use driml_machine::{error::Usage, shell::quoted, whole_number};
use driml_settings::presets;
use serde::de::DeserializeOwned;

/// The paper's experiments.
#[derive(Debug, Subcommand)]
pub enum ExperimentCommand {
    /// Fig. 1: InfoNCE learns the transition ratio of a biased random walk
    RandomWalk(ExperimentFlags),
    /// Fig. 2: local DIM finds the patch of an Ising model in noise
    Ising(ExperimentFlags),
    /// Fig. 3: Ms. PacMan with random ghosts, and with a lethal ghost that changes; C51 and DRIML
    Pacman(PacmanArgs),
    /// Table 1: agents on Procgen's games
    Procgen(ProcgenArgs),
    /// Error of every numeric routine at the extremes of its range, against float64
    Stability(ExperimentFlags),
}

/// The largest seed of a run. Finished runs are looked for up to this seed.
pub(crate) const SEEDS_MAX: u32 = 1000;

/// What every experiment takes.
#[derive(Clone, Debug, Default, Args)]
pub struct ExperimentFlags {
    /// A test in seconds: shows only that the command works
    #[arg(long)]
    pub(crate) smoke: bool,
    /// Folder for figures, data and page [default: experiments/NAME or NAME-smoke]; a stopped experiment resumes there
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Seeds 1 to N [default: from the experiment's settings]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=SEEDS_MAX))]
    pub(crate) seeds: Option<u32>,
}

/// What the experiments that are made of whole runs take.
#[derive(Clone, Debug, Args)]
pub struct QueueFlags {
    /// Runs at once [default: from the experiment's settings]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=256))]
    pub(crate) jobs: Option<u32>,
    /// Only write figures, data and page of finished runs
    #[arg(long)]
    pub(crate) report: bool,
    /// One setting by its dotted path, such as learner.update.adam.lr=1e-4; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) sets: Vec<String>,
}

/// What `driml experiment pacman` takes.
#[derive(Clone, Debug, Args)]
pub struct PacmanArgs {
    #[command(flatten)]
    pub(crate) flags: ExperimentFlags,
    #[command(flatten)]
    pub(crate) queue: QueueFlags,
    /// Agents of (b) and (c) [default: c51,driml-fix]; the others are compared with the first
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) agents: Option<Vec<String>>,
    /// Frames per run of (a), random ghosts
    #[arg(long, value_name = "N", value_parser = whole_number::within(1_000..=1_000_000_000))]
    pub(crate) frames: Option<u64>,
    /// Episodes per task of (b) and (c), changing ghost; the paper has 5000
    #[arg(long, value_name = "N", value_parser = whole_number::within(1..=10_000_000))]
    pub(crate) episodes_per_task: Option<u64>,
}

/// What `driml experiment procgen` takes.
#[derive(Clone, Debug, Args)]
pub struct ProcgenArgs {
    #[command(flatten)]
    pub(crate) flags: ExperimentFlags,
    #[command(flatten)]
    pub(crate) queue: QueueFlags,
    /// Games, such as bigfish,starpilot, or all [default: all]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) games: Option<Vec<String>>,
    /// Agents, or all [default: c51,driml-ada]; driml-fix and driml-noact also with a k, as in driml-noact-k5
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) agents: Option<Vec<String>>,
    /// Frames per run [default: 1000000]; the paper has 50000000
    #[arg(long, value_name = "N", value_parser = whole_number::within(500..=1_000_000_000))]
    pub(crate) frames: Option<u64>,
    /// Greedy episodes per checkpoint, for the last three of a run [default: 100]; three times as many with averaged weights
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=1_000_000))]
    pub(crate) episodes: Option<u32>,
    /// Named settings [default: tuned]; `driml presets` lists them
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
}

/// What `driml tradeoff` takes.
#[derive(Clone, Debug, Args)]
pub struct TradeoffArgs {
    /// World, such as mspacman, coinrun or chain
    #[arg(long, value_name = "WORLD", default_value = "mspacman")]
    pub(crate) env: String,
    /// Minutes for new runs; levels that do not fit with all their seeds are skipped
    #[arg(long, value_name = "MINUTES", default_value_t = 180, value_parser = whole_number::within_u32(1..=100_000))]
    pub(crate) budget: u32,
    /// Settings to change, such as learner.precision,DIM [default: all]; a wrong name lists them
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) dials: Vec<String>,
    /// Only measure speeds and print the plan
    #[arg(long, conflicts_with = "report")]
    pub(crate) plan: bool,
    /// Frames per run [default: by world, fewer if the budget is small]
    #[arg(long, value_name = "N", value_parser = whole_number::within(1_000..=1_000_000_000))]
    pub(crate) frames: Option<u64>,
    /// Greedy episodes per run [default: 100]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=1_000_000))]
    pub(crate) episodes: Option<u32>,
    #[command(flatten)]
    pub(crate) flags: ExperimentFlags,
    #[command(flatten)]
    pub(crate) queue: QueueFlags,
}

/// What `driml sweep` takes.
#[derive(Clone, Debug, Args)]
pub struct SweepArgs {
    /// Worlds, such as coinrun,maze or mspacman [default: as `driml train`]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) env: Vec<String>,
    /// Agents, such as c51,driml-ada [default: as `driml train`]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) agent: Vec<String>,
    /// Named settings; `driml presets` lists them
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
    /// Frames per run
    #[arg(long, value_name = "N", value_parser = whole_number::within(1..=i64::MAX as u64))]
    pub(crate) frames: Option<u64>,
    /// A setting by its dotted path and its values, such as learner.batch_size=64,256; may be given several times for every
    /// combination
    #[arg(long = "set", value_name = "KEY=VALUE,..")]
    pub(crate) sets: Vec<String>,
    /// Seeds 1 to N per combination
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = whole_number::within_u32(1..=SEEDS_MAX))]
    pub(crate) seeds: u32,
    /// Runs at once; they share the cores
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = whole_number::within_u32(1..=256))]
    pub(crate) jobs: u32,
    /// Only write table and plot of finished runs
    #[arg(long)]
    pub(crate) report: bool,
    /// Folder for runs, table and plot [default: experiments/sweep]; a stopped sweep resumes there
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

/// Reads an experiment's built-in settings: the table `full`, over it the table `smoke` for that length, and `--seeds`.
pub(crate) fn read_settings<T: DeserializeOwned>(text: &str, flags: &ExperimentFlags) -> T {
    let read = || -> Result<T, toml::de::Error> {
        let mut lengths: BTreeMap<String, toml::Table> = toml::from_str(text)?;
        let mut settings = lengths.remove("full").unwrap_or_default();
        let shorter = lengths.remove("smoke").filter(|_| flags.smoke);
        presets::merge(&mut settings, shorter.unwrap_or_default());
        settings.extend(flags.seeds.map(|seeds| ("seeds".to_owned(), seeds.into())));
        settings.try_into()
    };
    read().unwrap_or_else(|e| panic!("the settings are built in, and a test reads them: {e}"))
}

/// Expands each name with `expand` and drops duplicates, because runs of the same name would share a folder.
pub(crate) fn expand_unique(
    names: &[String],
    expand: impl Fn(&str) -> Result<Vec<String>, Usage>,
) -> Result<Vec<String>, Usage> {
    let all = names.iter().map(|name| expand(name));
    let all = all.collect::<Result<Vec<_>, _>>()?.concat();
    let mut seen = BTreeSet::new();
    let new = |name: &String| seen.insert(name.clone());
    Ok(all.into_iter().filter(new).collect())
}

/// Returns the command line of this process for a page, without `--out` and `--report`.
pub(crate) fn this_command_line() -> String {
    let mut words = vec!["driml".to_owned()];
    let args = std::env::args_os().skip(1);
    let mut args = args.map(|word| word.to_string_lossy().into_owned());
    while let Some(word) = args.next() {
        if word == "--out" {
            args.next();
        } else if word != "--report" && !word.starts_with("--out=") {
            words.push(quoted(&word));
        }
    }
    words.join(" ")
}

#[cfg(test)]
pub(crate) mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct CommandLine<T: Args> {
        #[command(flatten)]
        args: T,
    }

    pub(crate) fn parse<T: Args>(words: &str) -> T {
        let words = ["driml"].into_iter().chain(words.split_whitespace());
        CommandLine::parse_from(words).args
    }
}
