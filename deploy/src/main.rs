//! `driml`: every process of the system in one program.
//! All code is in the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    driml::main()
}
