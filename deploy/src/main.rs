//! `driml`: every part of the system in one program.
//! The library holds all code.

use std::process::ExitCode;

fn main() -> ExitCode {
    driml::main()
}
