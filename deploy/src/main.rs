//! `driml`: every part of the system in one program.
//! It holds nothing of its own; see the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    driml::main()
}
