//! The list of commands. Each has its flags and its code in a file of `commands`, or in the crate that it is named for.

use clap::{
    Arg, CommandFactory, Parser, Subcommand,
    error::{ContextKind, ContextValue},
};
use driml_bench::flags::BenchArgs;
use driml_experiments::{
    flags::{ExperimentCommand, SweepArgs, TradeoffArgs},
    plot::{self, flags::PlotArgs},
};
use driml_launch::watch::{StatusFlags, WatchFlags};

use crate::commands::{
    actor, completions, doctor, evaluate, inspect, learner, parity, presets, procgen,
    replay_server, train, watch,
};

pub(crate) const EXAMPLES: &str = "\
Examples:
  driml train --env chain --agent c51
  driml train --env procgen:starpilot --frames 1e6 --seed 3 --run-dir runs/starpilot
  driml train --resume runs/starpilot

`driml presets --env starpilot --agent c51` prints what a preset sets: every setting with its source.";

/// The version, and the commit that the program was built from.
const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("DRIML_COMMIT"), ")");

/// Deep Reinforcement and InfoMax Learning: actors, a replay server and a learner.
#[derive(Debug, Parser)]
#[command(name = "driml", version = VERSION, max_term_width = 100)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    #[command(visible_alias = "local", after_help = EXAMPLES)]
    /// Train on this machine: start all processes, show progress, write a run folder
    Train(train::TrainArgs),
    /// Run one actor of a run whose replay server is at ENDPOINT
    Actor(actor::ActorArgs),
    /// Run the replay server, to which the other processes connect and which sends them their settings
    ReplayServer(replay_server::ReplayServerArgs),
    /// Run the learner of a run whose replay server is at ENDPOINT
    Learner(learner::LearnerArgs),
    /// Show a run's processes, which one waits, and how to unblock it
    Status(watch::ObserverArgs<StatusFlags>),
    /// Monitor a run, local or remote, and record it in a folder
    Watch(watch::ObserverArgs<WatchFlags>),
    /// Play episodes with the weights of a run or a pretrained network, beside a random policy
    Evaluate(evaluate::EvaluateArgs),
    /// Count the parameters, FLOPs and bytes of a configuration, without training
    Inspect(inspect::InspectArgs),
    /// Check the learner's arithmetic against float64 updates of another framework
    Parity(parity::ParityArgs),
    /// Plot return, losses, k and speed of runs, or their action affinity
    Plot(PlotArgs),
    /// Train with every combination of settings and seeds; write a table and a plot
    #[command(visible_alias = "grid")]
    Sweep(SweepArgs),
    /// Run one of the paper's experiments: figures, data and a page
    #[command(subcommand)]
    Experiment(ExperimentCommand),
    /// Measure how settings change speed and return
    Tradeoff(TradeoffArgs),
    /// Measure the speed of learner, policy, replay, worlds and whole runs, also beside PyTorch, Reverb and gym3
    Bench(BenchArgs),
    /// List worlds, agents and presets, or print every setting of a combination with its source
    Presets(presets::PresetsArgs),
    /// Check whether this machine can train on the CPU and on a GPU
    Doctor(doctor::DoctorArgs),
    /// Install Procgen's engine
    #[command(subcommand)]
    Procgen(procgen::ProcgenCommand),
    /// Print a shell completion script
    Completions(completions::CompletionsArgs),
    /// Write the manual pages
    Man(completions::ManArgs),
}

/// The command line. A negative number after a flag is the flag's value, which its own check rejects.
pub(crate) fn command_line() -> clap::Command {
    fn take_negative_numbers(command: clap::Command) -> clap::Command {
        let takes = |arg: &Arg| arg.get_long().is_some() && arg.get_action().takes_values();
        let args = command.mut_args(|arg| match takes(&arg) {
            true => arg.allow_negative_numbers(true),
            false => arg,
        });
        args.mut_subcommands(take_negative_numbers)
    }
    take_negative_numbers(Cli::command())
}

/// Flags of CleanRL and Stable-Baselines3, and what `driml train` takes instead.
const FLAGS_ELSEWHERE: [(&str, &str); 7] = [
    ("--batch-size", "--set learner.batch_size=256"),
    ("--buffer-size", "--set replay.capacity_transitions=1e5"),
    ("--gamma", "--set run.gamma=0.99"),
    ("--learning-rate", "--set learner.update.adam.lr=1e-4"),
    ("--lr", "--set learner.update.adam.lr=1e-4"),
    ("--num-envs", "--actors 1 --envs 16"),
    ("--total-timesteps", "--frames 1e6"),
];

/// Adds to the error about a flag of another program what to use instead.
pub(crate) fn add_equivalent(mut error: clap::Error) -> clap::Error {
    let unknown = error.get(ContextKind::InvalidArg).map(ToString::to_string);
    let mut known = FLAGS_ELSEWHERE.iter();
    if let Some((_, equivalent)) = known.find(|it| unknown.as_deref() == Some(it.0)) {
        // The flag with the most similar name, and its usage, have nothing to do with it.
        error.remove(ContextKind::SuggestedArg);
        error.remove(ContextKind::Usage);
        let tip = format!("driml train takes {equivalent}").into();
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip]));
    }
    error
}

impl Command {
    pub(crate) fn run(self) -> anyhow::Result<()> {
        match self {
            Self::Train(args) => train::run(args, VERSION),
            Self::Actor(args) => actor::run(args),
            Self::ReplayServer(args) => replay_server::run(args),
            Self::Learner(args) => learner::run(args),
            Self::Status(args) => watch::status(&args),
            Self::Watch(args) => watch::run(&args),
            Self::Evaluate(args) => evaluate::run(args),
            Self::Inspect(args) => inspect::run(&args),
            Self::Parity(args) => parity::run(&args),
            Self::Plot(args) => plot::run(&args),
            Self::Sweep(args) => driml_experiments::sweep(&args),
            Self::Experiment(command) => driml_experiments::run(&command),
            Self::Tradeoff(args) => driml_experiments::tradeoff(&args),
            Self::Bench(args) => driml_bench::run(&args),
            Self::Presets(args) => presets::run(&args),
            Self::Doctor(args) => doctor::run(&args),
            Self::Procgen(command) => procgen::run(&command),
            Self::Completions(args) => completions::completions(&args, Cli::command()),
            Self::Man(args) => completions::man(&args, Cli::command()),
        }
    }
}

#[cfg(test)]
mod tests {
    use driml_machine::resources::Machine;
    use driml_settings::flags::resolve;

    use super::*;

    #[test]
    fn the_command_line_is_consistent_and_each_flag_has_one_name() {
        Cli::command().debug_assert();
        // Only what a parent process sets is hidden.
        fn check(command: &clap::Command) {
            for arg in command.get_arguments() {
                let is_hidden = arg.get_id() == "exit_with_parent";
                let found = (arg.get_all_aliases(), arg.is_hide_set());
                assert_eq!(found, (None, is_hidden), "{command} {arg}");
            }
            command.get_subcommands().for_each(check);
        }
        check(&Cli::command());
    }

    #[test]
    fn what_is_named_for_a_flag_of_another_program_can_be_set() {
        let machine = Machine {
            cores: 2,
            memory_bytes: 64 << 30,
            fast_bf16: false,
        };
        for (flag, equivalent) in FLAGS_ELSEWHERE {
            let parse = |flags| Cli::try_parse_from(format!("driml train {flags}").split(' '));
            let error = add_equivalent(parse(flag).unwrap_err()).to_string();
            assert!(error.contains(equivalent), "{error}");
            let Command::Train(args) = parse(equivalent).unwrap().command else {
                panic!("{equivalent}");
            };
            resolve(&args.run, &machine).unwrap();
        }
    }
}
