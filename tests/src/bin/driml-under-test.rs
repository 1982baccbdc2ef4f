//! The program under test: `driml`, built as a binary of this package so that cargo tells the tests where it lies.
//! It adds nothing; the launcher starts its processes from this same file.

use std::process::ExitCode;

fn main() -> ExitCode {
    driml::main()
}
