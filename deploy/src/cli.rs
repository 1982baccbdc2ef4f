//! The command line: commands, flags and their help.
//! It reads words only; what they mean together is for `config` and the commands.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use driml_learner::DeviceName;

/// Deep Reinforcement and InfoMax Learning: actors, a replay server and a learner.
#[derive(Debug, Parser)]
#[command(name = "driml", version, max_term_width = 100)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Train on this machine: start all parts, show how it goes, leave a run folder
    Local(LocalArgs),
    /// One actor of a run whose replay server is reached at ENDPOINT
    Actor(ActorArgs),
    /// The replay server of a run; the other parts connect to it and take its settings
    ReplayServer(ReplayServerArgs),
    /// The learner of a run whose replay server is reached at ENDPOINT
    Learner(LearnerArgs),
    /// Play whole episodes with a run's newest weights, beside a random policy
    Evaluate(EvaluateArgs),
    /// Check the learner's arithmetic against updates computed elsewhere in float64
    Parity(ParityArgs),
    /// Draw what runs recorded over their frames: return, losses, k, speed; or their action affinity
    Plot(PlotArgs),
    /// Run one of the paper's experiments: figures, data and a page
    #[command(subcommand)]
    Experiment(ExperimentCommand),
    /// Measure how fast the parts are, alone and beside what others use
    #[command(subcommand)]
    Bench(BenchCommand),
    /// List presets, agents and what differs by game; or print the settings of one game and agent with their sources
    Presets(PresetsArgs),
    /// What this machine can do and what it lacks, for training on the CPU and on a GPU
    Doctor(DoctorArgs),
    /// Procgen's engine
    #[command(subcommand)]
    Procgen(ProcgenCommand),
}

#[derive(Debug, Subcommand)]
pub(crate) enum ProcgenCommand {
    /// Fetch the engine into the cache folder (DRIML_CACHE, or the user's own)
    Install,
}

/// What to train, and with which settings.
#[derive(Clone, Debug, Args)]
pub(crate) struct RunFlags {
    /// World: procgen:GAME, mspacman, chain or ising [default: procgen:bigfish]
    #[arg(long, value_name = "WORLD")]
    pub(crate) env: Option<String>,
    /// Agent: c51, driml-fix, driml-ada, driml-randk, driml-noact, cpc or curl [default: driml-ada]
    #[arg(long, value_name = "AGENT")]
    pub(crate) agent: Option<String>,
    /// Named settings; `driml presets` lists them [default: paper]
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
    /// Resolved settings of another run, its config.toml, instead of world, agent and preset
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "env", "agent"])]
    pub(crate) config: Option<PathBuf>,
    /// Actor processes [default: by cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub(crate) actors: Option<u32>,
    /// Replay servers among which the actors and the memory are spread [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub(crate) replay_shards: Option<u32>,
    /// Copies of the world in each actor [default: 16]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub(crate) envs: Option<u32>,
    /// Frames of the whole run; it ends when they are in and their updates done
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=i64::MAX as u64))]
    pub(crate) frames: Option<u64>,
    /// Seed of every generator of the run
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(0..=i64::MAX as u64))]
    pub(crate) seed: Option<u64>,
    /// For studies alone: train with a known fault of the paper's published code
    #[arg(long, value_name = "FAULT", value_enum)]
    pub(crate) study: Option<Fault>,
    /// One setting by its dotted path, such as learner.update.adam.lr=1e-4; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) sets: Vec<String>,
}

/// A known fault of the paper's published code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Fault {
    /// n-step returns that bootstrap from s_{t+1}, with the end of an episode seen at step t alone
    BootstrapFromNextState,
}

/// What a resumed run has settled.
const RESUMED: [&str; 11] = [
    "env",
    "agent",
    "preset",
    "config",
    "actors",
    "replay_shards",
    "envs",
    "seed",
    "study",
    "run_dir",
    "lockstep",
];

#[derive(Debug, Args)]
pub(crate) struct LocalArgs {
    #[command(flatten)]
    pub(crate) run: RunFlags,
    /// Where settings, metrics, checkpoints, logs and summary go [default: runs/WORLD-AGENT-seedS-TIME]
    #[arg(long, value_name = "DIR")]
    pub(crate) run_dir: Option<PathBuf>,
    /// Go on with the interrupted run in this folder, from its newest checkpoint and with its own settings, but for --frames,
    /// --device and --set
    #[arg(long, value_name = "DIR", conflicts_with_all = RESUMED)]
    pub(crate) resume: Option<PathBuf>,
    /// What the learner computes on: cpu, cuda (the first GPU) or cuda:N [default: as the settings say, cpu]
    #[arg(long, value_name = "DEVICE")]
    pub(crate) device: Option<DeviceName>,
    /// All parts in one process in a fixed order: the same seed gives the same weights
    #[arg(long, conflicts_with = "listen")]
    pub(crate) lockstep: bool,
    /// Endpoint on which the parts meet [default: a unix socket in a fresh folder]
    #[arg(long, value_name = "ENDPOINT")]
    pub(crate) listen: Option<String>,
    /// End as after Ctrl-C when the process that started this one, which has this number, ends
    #[arg(long, value_name = "PID", hide = true)]
    pub(crate) exit_with_parent: Option<u32>,
}

/// How a part reaches the run.
#[derive(Debug, Args)]
pub(crate) struct JoinFlags {
    /// Prefix of the run's keys
    #[arg(long, value_name = "NS", default_value = NAMESPACE)]
    pub(crate) namespace: String,
    /// End when the process that started this one, which has this number, ends
    #[arg(long, value_name = "PID", hide = true)]
    pub(crate) exit_with_parent: Option<u32>,
}

/// The prefix of a run's keys unless it is told otherwise.
pub(crate) const NAMESPACE: &str = "driml";

#[derive(Debug, Args)]
pub(crate) struct ActorArgs {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; may be given several times
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub(crate) connect: Vec<String>,
    /// Which actor this is; unique in the run
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) id: u32,
    /// Copies of the world [default: as the run's settings say]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub(crate) envs: Option<u32>,
    #[command(flatten)]
    pub(crate) join: JoinFlags,
}

/// What the learner computes on.
#[derive(Clone, Copy, Debug, Args)]
pub(crate) struct DeviceFlag {
    /// What to compute on: cpu, cuda (the first GPU) or cuda:N
    #[arg(long, value_name = "DEVICE", default_value_t = DeviceName::Cpu)]
    pub(crate) device: DeviceName,
}

#[derive(Debug, Args)]
pub(crate) struct LearnerArgs {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; once for each of the run's replay shards
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub(crate) connect: Vec<String>,
    /// Where checkpoints go: DIR/checkpoints
    #[arg(long, value_name = "DIR")]
    pub(crate) run_dir: PathBuf,
    #[command(flatten)]
    pub(crate) on: DeviceFlag,
    #[command(flatten)]
    pub(crate) join: JoinFlags,
}

#[derive(Debug, Args)]
pub(crate) struct ReplayServerArgs {
    /// Endpoint to listen on, such as tcp/127.0.0.1:7447; may be given several times. Whoever reaches it can take part in the
    /// run and change what is learned: an address that others reach, such as tcp/0.0.0.0:7447, belongs in a trusted network
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub(crate) listen: Vec<String>,
    /// Router to connect to as well
    #[arg(long, value_name = "ENDPOINT")]
    pub(crate) connect: Vec<String>,
    /// Which of the run's --replay-shards this is
    #[arg(long, value_name = "I", default_value_t = 0)]
    pub(crate) shard: u32,
    /// Go on after so many updates: those of the newest checkpoint in the learner's run folder
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=u64::from(u32::MAX)))]
    pub(crate) after_updates: u64,
    #[command(flatten)]
    pub(crate) run: RunFlags,
    #[command(flatten)]
    pub(crate) join: JoinFlags,
}

/// Which levels to play.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Levels {
    /// Those trained on, as in the training: where an episode went on through completed levels, it does
    Train,
    /// Those trained on, drawn at random, each an episode of its own (Procgen)
    TrainSingle,
    /// Others of the same game, each an episode of its own (Procgen)
    Unseen,
}

#[derive(Debug, Args)]
pub(crate) struct EvaluateArgs {
    /// Folder of the run
    #[arg(long, value_name = "DIR")]
    pub(crate) run: PathBuf,
    /// Whole episodes to play
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub(crate) episodes: u32,
    /// Which levels to play
    #[arg(long, value_enum, default_value_t = Levels::Train)]
    pub(crate) levels: Levels,
    /// Seed of the worlds and of exploration
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub(crate) seed: u64,
}

#[derive(Debug, Args)]
pub(crate) struct PresetsArgs {
    /// Print the settings for this game of Procgen, or another world
    #[arg(long, value_name = "GAME")]
    pub(crate) game: Option<String>,
    /// Print the settings of this agent
    #[arg(long, value_name = "AGENT")]
    pub(crate) agent: Option<String>,
    /// Print the settings of this preset
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
}

#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// Where runs go: the disk that is looked at
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub(crate) run_dir: PathBuf,
    /// Fail also where --device cuda would
    #[arg(long)]
    pub(crate) cuda: bool,
    /// Print the facts as JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Only the CUDA devices, as JSON: so the usual program asks its CUDA flavour
    #[arg(long, hide = true)]
    pub(crate) devices: bool,
}

/// What the band over several seeds shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Band {
    /// From the smallest to the largest value
    Range,
    /// One standard deviation to each side of the mean
    Sd,
}

#[derive(Debug, Args)]
pub(crate) struct PlotArgs {
    /// Folders of runs; those that differ in their seed alone become one line with a band
    #[arg(value_name = "RUN", required = true)]
    pub(crate) runs: Vec<PathBuf>,
    /// Column of metrics.csv, one chart each; may be given several times [default: return, losses, k, speed]
    #[arg(long, value_name = "COLUMN")]
    pub(crate) column: Vec<String>,
    /// Draw the mean over so many frames before each point
    #[arg(long, value_name = "FRAMES", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) smooth: Option<u64>,
    /// What the band over several seeds shows
    #[arg(long, value_enum, default_value_t = Band::Range)]
    pub(crate) band: Band,
    /// One line a run, whatever its settings
    #[arg(long)]
    pub(crate) separate: bool,
    /// The action affinity A of each run's newest checkpoint as a heat map, instead of charts
    #[arg(long, conflicts_with_all = ["column", "smooth", "band", "separate"])]
    pub(crate) affinity: bool,
    /// Picture to write, .svg or .png
    #[arg(long, value_name = "FILE", default_value = "plot.svg")]
    pub(crate) out: PathBuf,
}

/// The paper's experiments.
#[derive(Debug, Subcommand)]
pub(crate) enum ExperimentCommand {
    /// Fig. 1: InfoNCE learns the transition ratio of a biased random walk; does it converge with the spectral gap?
    RandomWalk(ExperimentFlags),
    /// Fig. 2: local DIM finds the patch of an Ising model in noise
    Ising(ExperimentFlags),
    /// Fig. 3: Ms. PacMan's ghosts, predictable or not, and one lethal ghost that changes; C51 beside DRIML
    Pacman(PacmanArgs),
    /// Table 1: agents on Procgen's games, from a queue of whole runs
    Procgen(ProcgenArgs),
}

/// What the experiments that are made of whole runs take.
#[derive(Clone, Debug, Args)]
pub(crate) struct QueueFlags {
    /// Runs at once [default: as the experiment's settings say]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub(crate) jobs: Option<u32>,
    /// Start nothing: figures, data and page of the runs that are finished
    #[arg(long)]
    pub(crate) report: bool,
    /// One setting of every run, as `driml local` takes it; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) sets: Vec<String>,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct PacmanArgs {
    #[command(flatten)]
    pub(crate) flags: ExperimentFlags,
    #[command(flatten)]
    pub(crate) queue: QueueFlags,
    /// Agents of the continual tasks; the first is what the others are compared with [default: c51,driml-fix]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) agents: Vec<String>,
    /// Frames of each run with ghosts that move at random (a)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1_000..=1_000_000_000))]
    pub(crate) frames: Option<u64>,
    /// Episodes until the next ghost is the lethal one (b, c); the paper's are 5000
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    pub(crate) episodes_per_task: Option<u64>,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct ProcgenArgs {
    #[command(flatten)]
    pub(crate) flags: ExperimentFlags,
    #[command(flatten)]
    pub(crate) queue: QueueFlags,
    /// Games, such as bigfish,starpilot; or all [default: as the experiment's settings say]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) games: Vec<String>,
    /// Agents, driml-fix and driml-noact also with a k, as in driml-noact-k5; or all [default: c51,driml-fix,driml-ada]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) agents: Vec<String>,
    /// Frames of each run; the paper's are 50000000
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(500..=1_000_000_000))]
    pub(crate) frames: Option<u64>,
    /// Episodes played with each run's weights on each kind of levels
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub(crate) episodes: Option<u32>,
    /// Named settings of every run; `driml presets` lists them
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
    /// Instead: short runs of c51 on every game, to see on which it learns soonest
    #[arg(long)]
    pub(crate) screen: bool,
}

/// What every experiment takes.
#[derive(Clone, Debug, Args)]
pub(crate) struct ExperimentFlags {
    /// The same in seconds: shows that everything works, and nothing else
    #[arg(long)]
    pub(crate) smoke: bool,
    /// Where figures, data and page go; an experiment that was stopped goes on there [default: experiments/NAME]
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Seeds 1 to N [default: as the experiment's settings say]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) seeds: Option<u32>,
}

#[derive(Debug, Args)]
pub(crate) struct ParityArgs {
    /// Case files (safetensors)
    #[arg(value_name = "FILE", required = true)]
    pub(crate) files: Vec<PathBuf>,
    #[command(flatten)]
    pub(crate) on: DeviceFlag,
    /// With candle's own operations, as on a GPU, in place of this project's kernels
    #[arg(long)]
    pub(crate) stock: bool,
}

#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Updates of the learner, and the same update from candle's stock operations
    Learner(BenchLearnerArgs),
    /// Frames through an actor's policy
    Policy(BenchFlags),
    /// Transitions into a replay server and batches out of it, over the wire; and its batches without the wire
    Replay(BenchFlags),
    /// Procgen's steps through our wrapper
    Env(BenchFlags),
    /// A short run with real processes: its speed, how long the learner computes and waits, its memory
    System(BenchSystemArgs),
    /// More and more actors, synthetic and real: what is stored and served, how long each waits, how old the weights are
    Scale(BenchScaleArgs),
    /// All of these but the run, in turn with PyTorch, Reverb and gym3 doing the same work
    Peers(BenchPeersArgs),
}

/// What every bench can be told.
#[derive(Clone, Debug, Args)]
pub(crate) struct BenchFlags {
    /// A few iterations only: shows that it works, measures little
    #[arg(long)]
    pub(crate) quick: bool,
    /// Write the figures as JSON too; `-` is stdout, then without the table
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Threads for arithmetic
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) threads: u32,
    /// Measure in this very process, whose environment is already that of a part
    #[arg(long, hide = true)]
    pub(crate) here: bool,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct BenchLearnerArgs {
    #[command(flatten)]
    pub(crate) on: DeviceFlag,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

#[derive(Debug, Args)]
pub(crate) struct BenchSystemArgs {
    /// Frames of the run [default: 12000, or 2500 with --quick]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(2_000..=100_000_000))]
    pub(crate) frames: Option<u64>,
    #[command(flatten)]
    pub(crate) flags: BenchFlags,
}

/// What is scaled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ScaleCase {
    /// Paced synthetic actors and a limiter that never closes
    Open,
    /// Synthetic actors at a limiter that is closed most of the time
    Closed,
    /// Whole runs on Procgen
    Processes,
}

#[derive(Clone, Debug, Args)]
pub(crate) struct BenchScaleArgs {
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

/// A number above 0 that is no more than a million.
fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e6 => Ok(value),
        _ => Err("it must be a number above 0, at most 1000000".into()),
    }
}

/// A part that is measured by itself, and beside a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub(crate) enum BenchPart {
    /// Beside PyTorch
    Learner,
    /// Beside PyTorch
    Policy,
    /// Beside Reverb
    Replay,
    /// Beside gym3
    Env,
}

#[derive(Debug, Args)]
pub(crate) struct BenchPeersArgs {
    /// Only these parts
    #[arg(long, value_enum, value_delimiter = ',', value_name = "PARTS")]
    pub(crate) only: Vec<BenchPart>,
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

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
