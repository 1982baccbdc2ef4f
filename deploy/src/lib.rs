//! The program `driml`: the command line, and each command's own flags.
//! It computes nothing; each command calls the crate that does its work.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod cli;
mod commands;
#[cfg(test)]
mod recipes;
#[cfg(test)]
mod reference;
mod registry;

use std::process::ExitCode;

use clap::FromArgMatches;
use driml_launch::{console, panics};
use driml_machine::{
    error::{EXIT_INTERRUPTED, EXIT_USAGE, Interrupted, Usage},
    process_env,
};

pub use crate::registry::Registry;

use crate::cli::{Cli, Command, add_equivalent, command_line};

/// Runs the program. The exit code is 0 on success, 64 for a call that cannot work or whose output cannot be written, 130 after an
/// interrupt, and 1 for other errors.
pub fn main() -> ExitCode {
    main_with(Registry::default())
}

/// Runs like [`main`], for a program that adds worlds, losses or agents.
pub fn main_with(registry: Registry) -> ExitCode {
    registry.register();
    panics::abort_on_panic();
    let matched = command_line().try_get_matches();
    let cli = match matched.and_then(|it| Cli::from_arg_matches(&it)) {
        Ok(cli) => cli,
        Err(e) => {
            let e = add_equivalent(e);
            // If printing fails, the terminal is gone.
            let _ = e.print();
            return match e.use_stderr() {
                true => ExitCode::from(EXIT_USAGE),
                false => ExitCode::SUCCESS,
            };
        }
    };
    let is_replay_server = matches!(cli.command, Command::ReplayServer(_));
    let environment = process_env::ensure_environment(is_replay_server);
    console::log_to_stderr();
    if let Err(e) = environment {
        tracing::warn!(
            "this process continues slower, because it cannot restart with the environment that it needs: {e}"
        );
    }
    let ran = cli.command.run();
    panics::mark_process_ending();
    match ran {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) if e.is::<Interrupted>() => ExitCode::from(EXIT_INTERRUPTED),
        Err(e) => {
            console::eprintln(&format!("error: {}", console::describe_error(&e)));
            match e.is::<Usage>() {
                true => ExitCode::from(EXIT_USAGE),
                false => ExitCode::FAILURE,
            }
        }
    }
}
