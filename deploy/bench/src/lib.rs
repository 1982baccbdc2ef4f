//! `driml bench`: how fast the parts are, alone and beside what others use for the same work.
//!
//! A file is one bench, and gives `Measurement`s, each of which says what it is of; [`flags::BenchCommand`]
//! lists them. `deploy/bench/peers/` has the same work in Python. Nothing here passes or fails by its speed.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod alone;
mod assemble;
mod candle_baseline;
mod effort;
mod env;
pub mod flags;
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
    flags::{BenchCommand, BenchFlags, BenchPart},
    measurements::{MachineNote, Measurement},
};

/// Runs one bench and reports its figures.
///
/// # Errors
/// A part that failed, an engine that cannot be had, a file that cannot be written.
pub fn run(command: &BenchCommand) -> anyhow::Result<()> {
    let machine = MachineNote::this();
    let part = |part, flags: &BenchFlags, device: DeviceName| {
        ready_for(device)?;
        let figures = if flags.here {
            measure(part, flags, device)?
        } else {
            alone::figures(part, flags, device)?
        };
        measurements::report(part.name(), &figures, machine.computing_on(device), flags)
    };
    match command {
        BenchCommand::Learner(args) => part(BenchPart::Learner, &args.flags, args.on.device),
        BenchCommand::Policy(flags) => part(BenchPart::Policy, flags, DeviceName::Cpu),
        BenchCommand::Replay(flags) => part(BenchPart::Replay, flags, DeviceName::Cpu),
        BenchCommand::Env(flags) => part(BenchPart::Env, flags, DeviceName::Cpu),
        BenchCommand::System(args) => {
            measurements::report("system", &system::measure(args)?, machine, &args.flags)
        }
        BenchCommand::Scale(args) => scale::run(args, machine),
        BenchCommand::Peers(args) => peers::run(args),
    }
}

fn measure(
    part: BenchPart,
    flags: &BenchFlags,
    device: DeviceName,
) -> anyhow::Result<Vec<Measurement>> {
    let effort = &Effort::new(flags);
    let by_precision = |measure: &dyn Fn(Precision) -> anyhow::Result<Vec<Measurement>>| {
        let mut figures = Vec::new();
        for precision in flags.precisions(device) {
            figures.extend(measure(precision)?);
        }
        Ok(figures)
    };
    match part {
        BenchPart::Learner => {
            by_precision(&|precision| learner::measure(effort, device, precision))
        }
        BenchPart::Policy => by_precision(&|precision| policy::measure(effort, precision)),
        BenchPart::Replay => replay::measure(effort),
        BenchPart::Env => env::measure(effort),
    }
}
