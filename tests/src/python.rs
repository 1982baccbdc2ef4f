//! A Python that has what a test needs, if there is one. It installs nothing.

use std::process::Command;

use crate::{process, skipped::succeeds};

/// Says which of the modules that it is called with are missing.
const FIND: &str = "
import importlib.util, sys
missing = ', '.join(name for name in sys.argv[1:] if importlib.util.find_spec(name) is None)
sys.exit(f'{sys.executable} has no {missing}: name one that has with DRIML_TEST_PYTHON' if missing else 0)
";

/// A Python that finds all these modules, which `DRIML_TEST_PYTHON` names, or `python3`; none, and a line on stderr that names the test, if
/// there is none.
pub fn python_with(modules: &[&str]) -> Option<String> {
    let python = std::env::var("DRIML_TEST_PYTHON").unwrap_or_else(|_| "python3".into());
    succeeds(Command::new(&python).args(["-c", FIND]).args(modules)).then_some(python)
}

/// What a Python prints when it runs `script` with `args`.
pub fn run(python: &str, script: &[&str], args: &[&str]) -> String {
    let mut command = Command::new(python);
    // Nothing is left beside the scripts.
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    process::run(command.args(script).args(args))
}
