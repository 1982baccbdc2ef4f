//! Finds and runs a Python that has the modules a test needs. Installs nothing.

use std::process::Command;

use crate::{process, skipped::succeeds};

/// A script that fails and names the missing modules if its Python lacks any of the modules in its arguments.
const FIND: &str = "
import importlib.util, sys
missing = ', '.join(name for name in sys.argv[1:] if importlib.util.find_spec(name) is None)
sys.exit(f'{sys.executable} has no {missing}: name one that has with DRIML_TEST_PYTHON' if missing else 0)
";

/// Returns the Python that `DRIML_TEST_PYTHON` names, or `python3`. Without these modules, reports the test as skipped.
pub fn find_python(modules: &[&str]) -> Option<String> {
    let python = std::env::var("DRIML_TEST_PYTHON").unwrap_or_else(|_| "python3".into());
    succeeds(Command::new(&python).args(["-c", FIND]).args(modules)).then_some(python)
}

/// Runs `script` with `args` in a Python, and returns what it prints.
pub fn run_script(python: &str, script: &[&str], args: &[&str]) -> String {
    let mut command = Command::new(python);
    // Write no `__pycache__` beside the scripts.
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    process::run(command.args(script).args(args))
}
