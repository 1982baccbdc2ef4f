//! `driml bench`: how fast the components are, alone and beside what others use for the same work.
//!
//! A file is one bench, and gives `Measurement`s, each of which says what it is of; [`flags::BenchCommand`]
//! lists them. `deploy/bench/peers/` has the same work in Python. Nothing here passes or fails by its speed.
//!
//! Start with [`run`]; what it takes comes from a command line:
//!
//! ```no_run
//! use clap::Parser;
//! use driml_bench::flags::BenchCommand;
//!
//! #[derive(Parser)]
//! struct CommandLine {
//!     #[command(subcommand)]
//!     bench: BenchCommand,
//! }
//!
//! let line = CommandLine::parse_from(["driml", "policy", "--quick", "--json", "policy.json"]);
//! driml_bench::run(&line.bench)?; // Prints a table, and writes the same figures as JSON.
//! # Ok::<(), anyhow::Error>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod alone;
mod assemble;
mod candle_baseline;
mod durable;
mod effort;
mod env;
pub mod flags;
mod growth;
mod launched;
mod learner;
mod measurements;
mod peers;
mod policy;
mod recording;
mod replay;
mod sampling;
mod scale;
mod settings;
mod system;
mod table;
mod taking_part;

use driml_learner::{DeviceName, Precision};
use driml_machine::device::ready_for;

use crate::{
    effort::Effort,
    flags::{BenchCommand, BenchFlags, Component},
    measurements::{MachineNote, Measurement},
};

/// Runs one bench and reports its figures.
///
/// # Errors
/// A component that failed, an engine that cannot be had, a file that cannot be written.
pub fn run(command: &BenchCommand) -> anyhow::Result<()> {
    let machine = MachineNote::this();
    let alone = |component, flags: &BenchFlags, device: DeviceName, instead: Instead<'_>| {
        ready_for(device)?;
        let effort = &Effort::new(flags);
        let figures = if !flags.here {
            alone::figures(component, &instead.flags(), flags, device)?
        } else {
            match instead {
                Instead::No => measure(component, flags, device)?,
                Instead::Worlds(worlds) => env::measure_worlds(effort, worlds)?,
                Instead::Growth => {
                    by_precision(flags, device, &|it| growth::measure(effort, device, it))?
                }
            }
        };
        measurements::report(
            component.name(),
            &figures,
            machine.computing_on(device),
            flags,
        )
    };
    let cpu = DeviceName::Cpu;
    match command {
        BenchCommand::Learner(args) => {
            let (flags, device) = (&args.flags, args.on.device);
            let instead = match args.growth {
                true => Instead::Growth,
                false => Instead::No,
            };
            alone(Component::Learner, flags, device, instead)
        }
        BenchCommand::Policy(flags) => alone(Component::Policy, flags, cpu, Instead::No),
        BenchCommand::Replay(args) => match (&args.replay_dir, &args.tls_dir) {
            _ if args.sampling => {
                let figures = sampling::measure(&Effort::new(&args.flags), args.held)?;
                measurements::report("sampling", &figures, machine, &args.flags)
            }
            (Some(dir), _) => {
                let figures = durable::measure(args, dir)?;
                measurements::report("durable replay", &figures, machine, &args.flags)
            }
            (None, Some(dir)) => {
                let figures = replay::measure_guarded(&Effort::new(&args.flags), dir)?;
                measurements::report("guarded replay", &figures, machine, &args.flags)
            }
            (None, None) => alone(Component::Replay, &args.flags, cpu, Instead::No),
        },
        BenchCommand::Env(args) => {
            let instead = match &args.env[..] {
                [] => Instead::No,
                worlds => Instead::Worlds(worlds),
            };
            alone(Component::Env, &args.flags, cpu, instead)
        }
        BenchCommand::System(args) => {
            measurements::report("system", &system::measure(args)?, machine, &args.flags)
        }
        BenchCommand::Scale(args) => scale::run(args, machine),
        BenchCommand::Peers(args) => peers::run(args),
    }
}

/// What is measured instead of the learner's updates at the paper's sizes, or of Procgen's steps.
#[derive(Clone, Copy)]
enum Instead<'a> {
    No,
    Growth,
    Worlds(&'a [String]),
}

impl Instead<'_> {
    /// The flags that ask another process for it.
    fn flags(self) -> Vec<String> {
        match self {
            Self::No => Vec::new(),
            Self::Growth => vec!["--growth".into()],
            Self::Worlds(worlds) => worlds
                .iter()
                .flat_map(|world| ["--env".to_owned(), world.clone()])
                .collect(),
        }
    }
}

fn measure(
    component: Component,
    flags: &BenchFlags,
    device: DeviceName,
) -> anyhow::Result<Vec<Measurement>> {
    let effort = &Effort::new(flags);
    match component {
        Component::Learner => {
            by_precision(flags, device, &|it| learner::measure(effort, device, it))
        }
        Component::Policy => by_precision(flags, device, &|it| policy::measure(effort, it)),
        Component::Replay => replay::measure(effort),
        Component::Env => env::measure(effort),
    }
}

/// The figures of each precision that is asked for.
fn by_precision(
    flags: &BenchFlags,
    device: DeviceName,
    measure: &dyn Fn(Precision) -> anyhow::Result<Vec<Measurement>>,
) -> anyhow::Result<Vec<Measurement>> {
    let mut figures = Vec::new();
    for precision in flags.precisions(device) {
        figures.extend(measure(precision)?);
    }
    Ok(figures)
}
