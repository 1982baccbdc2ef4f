//! A Python that has what a test needs, if there is one. It installs nothing.

use std::process::{Command, Stdio};

use crate::{process, skipped::skip};

/// The variable that names the Python to take; without it `python3` is tried.
const VARIABLE: &str = "DRIML_TEST_PYTHON";

/// A Python that finds all these modules; none, and a line on stderr that names the test, if there is none.
pub fn python_with(modules: &[&str]) -> Option<String> {
    let python = std::env::var(VARIABLE).unwrap_or_else(|_| "python3".into());
    let find = "import importlib.util, sys; sys.exit(any(importlib.util.find_spec(m) is None for m in sys.argv[1:]))";
    let found = Command::new(&python)
        .args(["-c", find])
        .args(modules)
        .stderr(Stdio::null())
        .status();
    if found.is_ok_and(|status| status.success()) {
        return Some(python);
    }
    skip(&format!(
        "{python} has not all of {}: name one that has with {VARIABLE}",
        modules.join(", ")
    ));
    None
}

/// What a Python prints when it runs `script` with `args`.
pub fn run(python: &str, script: &[&str], args: &[&str]) -> String {
    let mut command = Command::new(python);
    // Nothing is left beside the scripts.
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    process::run(command.args(script).args(args))
}
