//! The composition root: the command line, a run's settings, the launcher and the run folder.
//! It computes nothing that is learned; actors, replay server and learner are crates of their own.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod bench;
mod child;
mod cli;
mod config;
mod console;
#[cfg(not(feature = "cuda"))]
mod cuda;
mod derived;
mod display;
mod doctor;
mod error;
mod evaluate;
mod experiment;
mod figure;
mod interrupts;
mod local;
mod lockstep;
mod machine;
mod meeting;
mod overrides;
mod panics;
mod part_log;
mod plan;
mod plot;
mod presets;
mod processes;
mod record;
mod resume;
mod shared_memory;
mod statuses;

use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;
use driml_learner::{DeviceName, Operations};
use driml_protocol::{Keys, Shutdown, session};

use crate::{
    cli::{Cli, Command, JoinFlags, ParityArgs, ProcgenCommand, ReplayServerArgs},
    console::print,
    error::{Interrupted, Usage, usage},
};

/// Exit code of a call or configuration that cannot work (`EX_USAGE`).
const EXIT_USAGE: u8 = 64;
/// Exit code after Ctrl-C, as shells have it.
const EXIT_INTERRUPTED: u8 = 130;

/// Runs the program: 0 when all went well, 64 for a call that cannot work, 130 when interrupted, 1 for all else.
pub fn main() -> ExitCode {
    panics::end_the_process();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            // Nothing is left to be done if the terminal is gone.
            let _ = e.print();
            return if e.use_stderr() {
                ExitCode::from(EXIT_USAGE)
            } else {
                ExitCode::SUCCESS
            };
        }
    };
    console::log_to_stderr();
    match run(cli.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) if e.is::<Interrupted>() => ExitCode::from(EXIT_INTERRUPTED),
        Err(e) => {
            console::line(&format!("error: {}", console::describe(&e)));
            if e.is::<Usage>() {
                ExitCode::from(EXIT_USAGE)
            } else {
                ExitCode::FAILURE
            }
        }
    }
}

fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Local(args) => local::run(args),
        Command::Actor(args) => {
            check_endpoints(&args.connect)?;
            let shutdown = join(&args.join)?;
            let (connect, namespace) = (args.connect, args.join.namespace);
            let run = driml_actor::RunArgs {
                connect,
                namespace,
                actor: args.id,
                envs: args.envs,
            };
            clean_up_after(driml_actor::run(run, &shutdown))
        }
        Command::Learner(args) => {
            check_endpoints(&args.connect)?;
            ready_for(args.on.device)?;
            let shutdown = join(&args.join)?;
            let (connect, namespace) = (args.connect, args.join.namespace);
            let run = driml_learner::RunArgs {
                connect,
                namespace,
                run_dir: args.run_dir,
                device: args.on.device,
            };
            clean_up_after(driml_learner::run(run, &shutdown))
        }
        Command::ReplayServer(args) => replay_server(args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Parity(args) => parity(&args),
        Command::Plot(args) => plot::run(&args),
        Command::Experiment(command) => experiment::run(&command),
        Command::Bench(command) => bench::run(&command),
        Command::Presets(args) => presets::print(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Procgen(ProcgenCommand::Install) => {
            let engine = procgen_sys::Engine::install(&mut console::line)?;
            print(&format!(
                "procgen's engine is in {}\n",
                engine.root().display()
            ))
        }
    }
}

fn replay_server(args: ReplayServerArgs) -> anyhow::Result<()> {
    check_endpoints(&args.listen)?;
    check_endpoints(&args.connect)?;
    let (config, _) = local::resolve(&args.run, &machine::Machine::this())?;
    let shutdown = join(&args.join)?;
    for note in &config.notes {
        tracing::warn!("{note}");
    }
    let run = driml_replay_server::RunArgs {
        listen: args.listen,
        connect: args.connect,
        namespace: args.join.namespace,
        shard: args.shard,
        after_updates: args.after_updates,
        config_toml: config.to_toml(),
    };
    clean_up_after(driml_replay_server::run(run, &shutdown))
}

fn parity(args: &ParityArgs) -> anyhow::Result<()> {
    let mut failed = 0;
    ready_for(args.on.device)?;
    let mut compute = args.on.device.open()?;
    if args.stock {
        compute.operations = Operations::Stock;
    }
    for file in &args.files {
        let report = driml_learner::parity::check_file(file, &compute)?;
        print(&report.to_string())?;
        failed += usize::from(!report.passed());
    }
    anyhow::ensure!(
        failed == 0,
        "{failed} of {} files are out of tolerance",
        args.files.len()
    );
    Ok(())
}

/// Makes sure that this program can compute on `device`: without CUDA in it, it goes on as the flavour that has it.
///
/// # Errors
/// There is no such flavour, it cannot start here, or there is no such device.
fn ready_for(device: DeviceName) -> anyhow::Result<()> {
    match device {
        DeviceName::Cpu => Ok(()),
        #[cfg(not(feature = "cuda"))]
        DeviceName::Cuda(_) => Err(cuda::hand_over()),
        #[cfg(feature = "cuda")]
        DeviceName::Cuda(ordinal) => Ok(doctor::cuda::check(ordinal)?),
    }
}

/// Checks how a part reaches the run, and starts to listen for signals.
fn join(flags: &JoinFlags) -> anyhow::Result<Shutdown> {
    Keys::new(&flags.namespace).map_err(Usage)?;
    if flags.exit_with_parent.is_none() {
        session::sweep_shared_memory();
    }
    Shutdown::on_signals(flags.exit_with_parent).context("listening for signals")
}

/// What a part does when it has ended, well or not: nothing of it is left outside the run folder.
fn clean_up_after(ran: anyhow::Result<()>) -> anyhow::Result<()> {
    meeting::leave();
    shared_memory::remove_own();
    ran
}

/// Refuses what zenoh could not open.
fn check_endpoints(endpoints: &[String]) -> Result<(), Usage> {
    let good = |endpoint: &str| match endpoint.split_once('/') {
        Some(("tcp" | "tls", address)) => address
            .rsplit_once(':')
            .is_some_and(|(host, _)| !host.is_empty()),
        Some(("unixsock-stream", path)) => !path.is_empty(),
        _ => false,
    };
    match endpoints.iter().find(|endpoint| !good(endpoint)) {
        Some(endpoint) => Err(usage!(
            "{endpoint:?} is no endpoint: take tcp/HOST:PORT, tls/HOST:PORT or unixsock-stream/PATH"
        )),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_that_zenoh_cannot_open_are_refused() {
        for good in [
            "tcp/127.0.0.1:7447",
            "tcp/[::1]:7447",
            "tls/host:1",
            "unixsock-stream//tmp/driml.sock",
        ] {
            assert!(check_endpoints(&[good.into()]).is_ok(), "{good}");
        }
        for bad in [
            "",
            "localhost:7447",
            "tcp/localhost",
            "tcp/:1",
            "udp/1.2.3.4:5",
            "unixsock-stream/",
        ] {
            assert!(check_endpoints(&[bad.into()]).is_err(), "{bad}");
        }
    }
}
