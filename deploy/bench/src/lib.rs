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
    let alone = |component, flags: &BenchFlags, device: DeviceName, growth: bool| {
        ready_for(device)?;
        let figures = if !flags.here {
            let more = if growth { &["--growth"][..] } else { &[] };
            alone::figures(component, more, flags, device)?
        } else if growth {
            let effort = &Effort::new(flags);
            by_precision(flags, device, &|it| growth::measure(effort, device, it))?
        } else {
            measure(component, flags, device)?
        };
        measurements::report(
            component.name(),
            &figures,
            machine.computing_on(device),
            flags,
        )
    };
    match command {
        BenchCommand::Learner(args) => {
            let (flags, device) = (&args.flags, args.on.device);
            alone(Component::Learner, flags, device, args.growth)
        }
        BenchCommand::Policy(flags) => alone(Component::Policy, flags, DeviceName::Cpu, false),
        BenchCommand::Replay(args) => match &args.replay_dir {
            Some(dir) => {
                let figures = durable::measure(args, dir)?;
                measurements::report("durable replay", &figures, machine, &args.flags)
            }
            None => alone(Component::Replay, &args.flags, DeviceName::Cpu, false),
        },
        BenchCommand::Env(flags) => alone(Component::Env, flags, DeviceName::Cpu, false),
        BenchCommand::System(args) => {
            measurements::report("system", &system::measure(args)?, machine, &args.flags)
        }
        BenchCommand::Scale(args) => scale::run(args, machine),
        BenchCommand::Peers(args) => peers::run(args),
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
