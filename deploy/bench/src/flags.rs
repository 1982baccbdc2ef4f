//! The command line of `driml bench`.
//! Each bench interprets its own flags.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use driml_learner::{DeviceName, Precision};
use driml_machine::{device::DeviceFlag, whole_number};

/// The arguments of `driml bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    pub(crate) command: BenchCommand,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Updates of the learner, also with candle's operations
    Learner(BenchLearnerArgs),
    /// Decisions of an actor's policy
    Policy,
    /// Inserts into a replay server and batches from it, with and without transport
    Replay(BenchReplayArgs),
    /// Steps of Procgen or another world
    Env {
        /// Measure this world instead, such as "exec:COMMAND"; may be given several times
        #[arg(long, value_name = "WORLD")]
        env: Vec<String>,
    },
    /// A short run with real processes: speed, waiting time, memory
    System {
        /// Frames of the run [default: 12000, or 5000 with --quick]
        #[arg(long, value_name = "N", value_parser = whole_number::within(2_000..=100_000_000))]
        frames: Option<u64>,
    },
    /// Runs with more and more actors: throughput, waiting time, age of weights
    Scale {
        /// Numbers of actors, such as 1,8,32 [default: 1,2,4,8,16,32, or 1,2 with --quick]
        #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = whole_number::within_u32(1..=256))]
        actors: Vec<u32>,
        /// Seconds per number of actors [default: 5, or 2 with --quick]
        #[arg(long, value_name = "S", value_parser = whole_number::within_u32(1..=86_400))]
        seconds: Option<u32>,
    },
    /// Learner, policy, replay and env, in turn with PyTorch, Reverb and gym3 on the same work
    Peers(BenchPeersArgs),
}

/// The flags of all benches.
#[derive(Clone, Debug, Args)]
pub(crate) struct BenchFlags {
    /// Few iterations: shows only that the bench works
    #[arg(long, global = true)]
    pub(crate) quick: bool,
    /// Also write the numbers as JSON; `-` prints them instead of the table
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Threads for arithmetic
    #[arg(long, global = true, value_name = "N", default_value_t = 2, value_parser = whole_number::within_u32(1..=1024))]
    pub(crate) threads: u32,
    /// Precision of products, for learner and policy [default: both]; may be given several times
    #[arg(long, global = true, value_name = "PRECISION")]
    pub(crate) precision: Vec<Precision>,
}

impl BenchFlags {
    pub(crate) fn unless_quick<T>(&self, full: T, quick: T) -> T {
        if self.quick { quick } else { full }
    }

    /// Returns the precisions to measure: the named ones, else those that the device supports.
    pub(crate) fn precisions(&self, device: DeviceName) -> Vec<Precision> {
        match (&self.precision[..], device) {
            ([], DeviceName::Cpu) => Precision::ALL.to_vec(),
            ([], _) => vec![Precision::F32],
            (named, _) => named.to_vec(),
        }
    }
}

#[derive(Clone, Debug, Args)]
pub(crate) struct BenchLearnerArgs {
    /// Measure C51 + global DIM with growing batch, observation, atoms and vectors instead
    #[arg(long)]
    pub(crate) growth: bool,
    /// Measure GFLOP/s of convolutions and updates, and the processor's peak, instead
    #[arg(long, conflicts_with_all = ["growth", "device"])]
    pub(crate) kernels: bool,
    #[command(flatten)]
    pub(crate) on: DeviceFlag,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct BenchReplayArgs {
    /// Compare a replay on disk, in DIR/driml-bench, with one in memory instead; also measures reading it back
    #[arg(long, value_name = "DIR")]
    pub(crate) replay_dir: Option<PathBuf>,
    /// Measure uniform and prioritised sampling instead, without transport
    #[arg(long, conflicts_with_all = ["replay_dir", "tls_dir", "rounds"])]
    pub(crate) sampling: bool,
    /// Transitions to store: 10.8 kB each, 96 bytes with --sampling
    #[arg(long, value_name = "N", default_value_t = 20_000, value_parser = whole_number::within(1_000..=100_000_000))]
    pub(crate) held: u64,
    /// Rounds per server [default: 3 with --replay-dir, else 1]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=1000))]
    pub(crate) rounds: Option<u32>,
    /// Compare TCP and QUIC instead; this folder has certificates of replay-server, observer, learner and actors 1 to 5
    #[arg(long, value_name = "DIR", conflicts_with_all = ["replay_dir", "rounds"])]
    pub(crate) tls_dir: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct BenchPeersArgs {
    /// Only these components
    #[arg(long, value_enum, value_delimiter = ',', value_name = "COMPONENTS")]
    pub(crate) only: Vec<Component>,
    /// Rounds of both programs [default: 5, or 1 with --quick]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=1000))]
    pub(crate) rounds: Option<u32>,
    /// Python with all peers
    #[arg(long, value_name = "PATH", default_value = "python3")]
    pub(crate) python: PathBuf,
    /// Python with PyTorch
    #[arg(long, value_name = "PATH")]
    pub(crate) torch_python: Option<PathBuf>,
    /// Python with Reverb
    #[arg(long, value_name = "PATH")]
    pub(crate) reverb_python: Option<PathBuf>,
    /// Python with Procgen and gym3
    #[arg(long, value_name = "PATH")]
    pub(crate) gym3_python: Option<PathBuf>,
}

/// A component that is measured by itself, and beside a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub(crate) enum Component {
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
    pub(crate) fn name(self) -> String {
        let value = self.to_possible_value().expect("no component is hidden");
        value.get_name().to_owned()
    }
}
