//! The command line of `driml bench`.
//! What a value means is for the bench that takes it.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use driml_learner::{DeviceName, Precision};
use driml_machine::{device::DeviceFlag, whole_number};

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Updates of the learner, and the same update from candle's stock operations
    Learner(BenchLearnerArgs),
    /// Frames through an actor's policy
    Policy(BenchFlags),
    /// Transitions into a replay server and batches out of it, over the wire; and its batches without the wire
    Replay(BenchReplayArgs),
    /// Procgen's steps through our wrapper, or those of other worlds
    Env(BenchEnvArgs),
    /// A short run with real processes: its speed, how long the learner computes and waits, its memory
    System(BenchSystemArgs),
    /// More and more actors, synthetic and real: what is stored and served, how long each waits, how old the weights are
    Scale(BenchScaleArgs),
    /// All of these but the run, in turn with PyTorch, Reverb and gym3 doing the same work
    Peers(BenchPeersArgs),
}

/// What every bench can be told.
#[derive(Clone, Debug, Args)]
pub struct BenchFlags {
    /// A few iterations only: shows that it works, measures little
    #[arg(long)]
    pub(crate) quick: bool,
    /// Write the figures as JSON too; `-` is stdout, then without the table
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Threads for arithmetic
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) threads: u32,
    /// Precision of products, for the learner and the policy; may be given several times [default: both]
    #[arg(long, value_name = "PRECISION")]
    pub(crate) precision: Vec<Precision>,
    /// Measure in this very process, whose environment is already that of a run's process
    #[arg(long, hide = true)]
    pub(crate) here: bool,
}

impl BenchFlags {
    /// The precisions to measure, those that a GPU does not have left out.
    pub(crate) fn precisions(&self, device: DeviceName) -> Vec<Precision> {
        let asked = if self.precision.is_empty() {
            &Precision::ALL[..]
        } else {
            &self.precision
        };
        let there = |precision: &&Precision| {
            device == DeviceName::Cpu || !self.precision.is_empty() || **precision == Precision::F32
        };
        asked.iter().filter(there).copied().collect()
    }
}

/// What `driml bench learner` takes.
#[derive(Clone, Debug, Args)]
pub struct BenchLearnerArgs {
    /// Instead: C51 + global DIM as batch, observation, atoms and vectors grow, beside the FLOPs of an update
    #[arg(long)]
    pub(crate) growth: bool,
    #[command(flatten)]
    pub(crate) on: DeviceFlag,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// What `driml bench env` takes.
#[derive(Clone, Debug, Args)]
pub struct BenchEnvArgs {
    /// Instead: this world, such as "exec:COMMAND"; may be given several times
    #[arg(long, value_name = "WORLD")]
    pub(crate) env: Vec<String>,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// What `driml bench replay` takes.
#[derive(Clone, Debug, Args)]
pub struct BenchReplayArgs {
    /// Instead: a server that keeps its replay on disk in this folder, which is emptied, in turn with one that does not; and how long it
    /// takes to read it back
    #[arg(long, value_name = "DIR")]
    pub(crate) replay_dir: Option<PathBuf>,
    /// Instead: rows drawn uniformly and by priority, without a wire
    #[arg(long, conflicts_with_all = ["replay_dir", "tls_dir"])]
    pub(crate) sampling: bool,
    /// With --replay-dir: transitions that are held and read back, of 10.8 kB each. With --sampling: transitions that are held, of 96
    /// bytes each
    #[arg(long, value_name = "N", default_value_t = 20_000, value_parser = whole_number::within(1_000..=100_000_000))]
    pub(crate) held: u64,
    /// With --replay-dir: rounds of both
    #[arg(long, value_name = "N", default_value_t = 3, requires = "replay_dir")]
    pub(crate) rounds: u32,
    /// Instead: over TCP and over QUIC, with the certificates of replay-server, observer, learner and actors 1 to 5 in this folder
    #[arg(long, value_name = "DIR", conflicts_with = "replay_dir")]
    pub(crate) tls_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// What `driml bench system` takes.
#[derive(Debug, Args)]
pub struct BenchSystemArgs {
    /// Frames of the run [default: 12000, or 2500 with --quick]
    #[arg(long, value_name = "N", value_parser = whole_number::within(2_000..=100_000_000))]
    pub(crate) frames: Option<u64>,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// What `driml bench scale` takes.
#[derive(Clone, Debug, Args)]
pub struct BenchScaleArgs {
    /// What to measure; may be given several times [default: all]
    #[arg(long, value_name = "CASE", value_enum)]
    pub(crate) case: Vec<ScaleCase>,
    /// Numbers of actors, such as 1,8,32 [default: by case]
    #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub(crate) actors: Vec<u32>,
    /// Transitions a second that each actor of the case `open` offers
    #[arg(long, value_name = "N", default_value_t = 1000.0, value_parser = rate)]
    pub(crate) actor_rate: f64,
    /// Batches a second that a synthetic learner asks for
    #[arg(long, value_name = "N", default_value_t = 20.0, value_parser = rate)]
    pub(crate) batch_rate: f64,
    /// Seconds for which each number of actors is watched
    #[arg(long, value_name = "S", default_value_t = 5.0, value_parser = rate)]
    pub(crate) seconds: f64,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// What is scaled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ScaleCase {
    /// Paced synthetic actors and a limiter that never closes
    Open,
    /// Synthetic actors at a limiter that is closed most of the time
    Closed,
    /// Whole runs on Procgen
    Processes,
}

/// A number above 0 that is no more than a million.
fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e6 => Ok(value),
        _ => Err("it must be a number above 0, at most 1000000".into()),
    }
}

/// What `driml bench peers` takes.
#[derive(Debug, Args)]
pub struct BenchPeersArgs {
    /// Only these components
    #[arg(long, value_enum, value_delimiter = ',', value_name = "COMPONENTS")]
    pub(crate) only: Vec<Component>,
    /// Rounds of ours, theirs [default: 5, or 1 with --quick]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) rounds: Option<u32>,
    /// Python that has every peer, unless one of the next three says otherwise
    #[arg(long, value_name = "PATH", default_value = "python3")]
    pub(crate) python: PathBuf,
    /// Python that has PyTorch
    #[arg(long, value_name = "PATH")]
    pub(crate) torch_python: Option<PathBuf>,
    /// Python that has Reverb
    #[arg(long, value_name = "PATH")]
    pub(crate) reverb_python: Option<PathBuf>,
    /// Python that has Procgen and gym3
    #[arg(long, value_name = "PATH")]
    pub(crate) gym3_python: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// A component that is measured by itself, and beside a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub enum Component {
    /// Updates, beside PyTorch's
    Learner,
    /// Frames through the policy, beside PyTorch's
    Policy,
    /// Inserts and batches, beside Reverb's
    Replay,
    /// Steps of Procgen, beside gym3's
    Env,
}

impl Component {
    /// Its name on the command line.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Learner => "learner",
            Self::Policy => "policy",
            Self::Replay => "replay",
            Self::Env => "env",
        }
    }
}
