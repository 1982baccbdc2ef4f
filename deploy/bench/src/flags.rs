//! The command line of `driml bench`.
//! What a value means is for the bench that takes it.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use driml_learner::{DeviceName, Precision};
use driml_machine::{device::DeviceFlag, whole_number};

/// What `driml bench` takes.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// What to measure.
    #[command(subcommand)]
    pub(crate) command: BenchCommand,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Updates of the learner, and the same update from candle's own operations
    Learner(BenchLearnerArgs),
    /// Frames through an actor's policy
    Policy,
    /// Transitions into a replay server and batches out of it, over the wire; and its batches without the wire
    Replay(BenchReplayArgs),
    /// Procgen's steps through our wrapper, or those of other worlds
    Env {
        /// Instead: this world, such as "exec:COMMAND"; may be given several times
        #[arg(long, value_name = "WORLD")]
        env: Vec<String>,
    },
    /// A short run with real processes: its speed, how long the learner computes and waits, its memory
    System {
        /// Frames of the run [default: 12000, or 5000 with --quick]
        #[arg(long, value_name = "N", value_parser = whole_number::within(2_000..=100_000_000))]
        frames: Option<u64>,
    },
    /// Whole runs with more and more actors: what is stored and served, how long each waits, how old the weights are
    Scale {
        /// Numbers of actors, such as 1,8,32 [default: 1,2,4,8,16,32, or 1,2 with --quick]
        #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=4096))]
        actors: Vec<u32>,
        /// Seconds for which each number of actors is watched [default: 5, or 2 with --quick]
        #[arg(long, value_name = "S", value_parser = clap::value_parser!(u32).range(1..=86_400))]
        seconds: Option<u32>,
    },
    /// All of these but the runs, in turn with PyTorch, Reverb and gym3 doing the same work
    Peers(BenchPeersArgs),
}

/// What every bench can be told.
#[derive(Clone, Debug, Args)]
pub struct BenchFlags {
    /// A few iterations only: shows that it works, measures little
    #[arg(long, global = true)]
    pub(crate) quick: bool,
    /// Write the figures as JSON too; `-` is stdout, then without the table
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Threads for arithmetic
    #[arg(long, global = true, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) threads: u32,
    /// Precision of products, for the learner and the policy; may be given several times [default: both]
    #[arg(long, global = true, value_name = "PRECISION")]
    pub(crate) precision: Vec<Precision>,
}

impl BenchFlags {
    /// The precisions to measure: unless they are named, those that the device has.
    pub(crate) fn precisions(&self, device: DeviceName) -> Vec<Precision> {
        match (&self.precision[..], device) {
            ([], DeviceName::Cpu) => Precision::ALL.to_vec(),
            ([], _) => vec![Precision::F32],
            (named, _) => named.to_vec(),
        }
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
}

/// What `driml bench replay` takes.
#[derive(Clone, Debug, Args)]
pub struct BenchReplayArgs {
    /// Instead: a server that keeps its replay on disk in this folder, which is emptied, in turn with one that does not; and how long it
    /// takes to read it back
    #[arg(long, value_name = "DIR")]
    pub(crate) replay_dir: Option<PathBuf>,
    /// Instead: rows drawn uniformly and by priority, without a wire
    #[arg(long, conflicts_with_all = ["replay_dir", "tls_dir", "rounds"])]
    pub(crate) sampling: bool,
    /// Transitions that are held: of 10.8 kB each, with --sampling of 96 bytes each
    #[arg(long, value_name = "N", default_value_t = 20_000, value_parser = whole_number::within(1_000..=100_000_000))]
    pub(crate) held: u64,
    /// Rounds of each server [default: 3 with --replay-dir, else 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) rounds: Option<u32>,
    /// Instead: over TCP and over QUIC, with the certificates of replay-server, observer, learner and actors 1 to 5 in this folder
    #[arg(long, value_name = "DIR", conflicts_with_all = ["replay_dir", "rounds"])]
    pub(crate) tls_dir: Option<PathBuf>,
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
