//! The program under test: `driml`, built as a binary of this package so that cargo gives the tests its path.
//! It adds nothing to `driml`. The launcher starts its processes from this same file.

use std::process::ExitCode;

fn main() -> ExitCode {
    driml::main()
}
