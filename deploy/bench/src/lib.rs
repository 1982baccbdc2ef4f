//! `driml bench`: measures the speed of the components, alone and compared with other software for the same work.
//!
//! Each file is one bench and records figures, each with its name and unit; `flags.rs` lists the benches.
//! `deploy/bench/peers/` has the same work in Python. No bench passes or fails by its speed.
//!
//! Start with [`run`]; its arguments come from a command line:
//!
//! ```no_run
//! use clap::Parser;
//! use driml_bench::flags::BenchArgs;
//!
//! #[derive(Parser)]
//! struct CommandLine {
//!     #[command(flatten)]
//!     bench: BenchArgs,
//! }
//!
//! let line = CommandLine::parse_from(["driml", "policy", "--quick", "--json", "policy.json"]);
//! driml_bench::run(&line.bench)?; // Prints a table, and writes the same figures as JSON.
//! # Ok::<(), anyhow::Error>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod env;
pub mod flags;
mod in_process;
mod kernels;
mod learner;
mod peers;
mod policy;
mod recording;
mod replay;
mod report;
mod server;
mod settings;
mod subprocess;
mod system;

use std::path::Path;

use driml_launch::output;
use driml_learner::DeviceName;
use driml_machine::{device, resources::MachineInfo, speed_meter::SpeedMeter};

use crate::{
    flags::{BenchArgs, BenchCommand},
    report::{Bench, Figures, Report, publish},
};

/// Runs one bench and reports its figures. A bench that computes in this process first re-executes the program, if its number of threads is
/// not that of the flags.
pub fn run(BenchArgs { command, flags }: &BenchArgs) -> anyhow::Result<()> {
    let device_name = match command {
        BenchCommand::Learner(args) => args.on.device,
        _ => DeviceName::Cpu,
    };
    let gpu = device::check_device(device_name)?;
    let json = flags.json.as_deref().filter(|it| *it != Path::new("-"));
    json.map_or(Ok(()), |it| output::check_file("--json", it))?;
    let starts_processes = matches!(
        command,
        BenchCommand::System { .. } | BenchCommand::Scale { .. } | BenchCommand::Peers(_)
    );
    if !starts_processes {
        subprocess::ensure_threads(flags.threads)?;
    }
    let machine = MachineInfo::detect(gpu);
    let mut bench = Bench {
        flags,
        meter: SpeedMeter::new(flags.quick),
        figures: Figures::default(),
        table: None,
    };
    let (name, measured) = match command {
        BenchCommand::Learner(args) if args.kernels => ("learner", kernels::measure(&mut bench)),
        BenchCommand::Learner(args) => ("learner", learner::measure(args, &mut bench)),
        BenchCommand::Policy => ("policy", policy::measure(&mut bench)),
        BenchCommand::Replay(args) => ("replay", replay::measure(args, &mut bench)),
        BenchCommand::Env { env } => ("env", env::measure(env, &mut bench)),
        BenchCommand::System { frames } => ("system", system::measure(*frames, &mut bench)),
        BenchCommand::Scale { actors, seconds } => {
            ("scale", system::scale(actors, *seconds, &mut bench))
        }
        BenchCommand::Peers(args) => return peers::run(args, flags, machine),
    };
    measured?;
    let report = Report {
        bench: name.to_owned(),
        quick: flags.quick,
        threads: flags.threads,
        machine,
        figures: bench.figures.medians(),
    };
    let table = bench.table.unwrap_or_else(|| report.rows());
    publish(&report, &table, flags.json.as_deref())
}
