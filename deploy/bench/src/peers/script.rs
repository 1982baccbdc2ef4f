//! Both sides of a comparison as processes: this program's bench, and Python scripts that do the same work.
//! This file installs nothing, and reports what is missing.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context, ensure};
use driml_machine::process_env;
use serde::Deserialize;

use crate::{
    flags::{BenchFlags, BenchPeersArgs, Component},
    report::{Measurement, Report},
};

macro_rules! embed {
    ($($path:literal)+) => {
        [$(($path, include_str!($path))),+]
    };
}

/// The scripts by their paths, which are embedded in the program so that it can be started anywhere.
pub(super) const SCRIPTS: [(&str, &str); 6] = embed!(
    "../../peers/measure.py" "../../../python/driml_net.py" "../../peers/torch_update.py"
    "../../peers/torch_policy.py" "../../peers/reverb_replay.py" "../../peers/gym3_steps.py"
);

/// The script of a component's peer, and its arguments.
pub(super) struct Script {
    pub(super) peer: &'static str,
    module: &'static str,
    /// The peer's short name, in the name of its requirements file and of the flag for its interpreter.
    short_name: &'static str,
    python: PathBuf,
    file: &'static str,
    args: Vec<String>,
}

/// The line that a script prints: the peer's name with version, and its figures.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Answer {
    pub(super) peer: String,
    pub(super) figures: BTreeMap<String, f64>,
}

impl Script {
    /// Returns the script that does a component's work; `frames` is the file with the frames for Reverb.
    pub(super) fn new(
        component: Component,
        args: &BenchPeersArgs,
        flags: &BenchFlags,
        frames: &Path,
    ) -> Self {
        let (torch, reverb, gym3) = (&args.torch_python, &args.reverb_python, &args.gym3_python);
        let (peer, module, short_name, file, own) = match component {
            Component::Learner => ("PyTorch", "torch", "torch", "torch_update.py", torch),
            Component::Policy => ("PyTorch", "torch", "torch", "torch_policy.py", torch),
            Component::Replay => ("Reverb", "reverb", "reverb", "reverb_replay.py", reverb),
            Component::Env => ("gym3", "procgen", "gym3", "gym3_steps.py", gym3),
        };
        let mut words = vec!["--threads".to_owned(), flags.threads.to_string()];
        words.extend(flags.quick.then(|| "--quick".to_owned()));
        if component == Component::Replay {
            words.extend(["--frames".to_owned(), frames.display().to_string()]);
        }
        Self {
            peer,
            module,
            short_name,
            python: own.as_ref().unwrap_or(&args.python).clone(),
            file,
            args: words,
        }
    }

    /// Checks that the interpreter exists and finds the peer's module. The error says, for the table, why there are no figures.
    pub(super) fn check(&self) -> Result<(), String> {
        let find =
            "import importlib.util, sys; sys.exit(importlib.util.find_spec(sys.argv[1]) is None)";
        let found = Command::new(&self.python)
            .args(["-c", find, self.module])
            .stdin(Stdio::null())
            .stderr(Stdio::null())
            .status();
        let (python, peer, short_name) = (self.python.display(), self.peer, self.short_name);
        match found {
            Ok(status) if status.success() => Ok(()),
            Ok(_) => Err(format!(
                "{python} has no {peer}: {python} -m pip install -r deploy/bench/peers/requirements-{short_name}.txt, or name one that has it with --{short_name}-python"
            )),
            Err(e) => Err(format!(
                "{python} cannot be started ({e}): name a Python that has {peer} with --{short_name}-python"
            )),
        }
    }

    /// Runs the script in `folder`. Progress goes to stderr.
    pub(super) fn run(&self, folder: &Path) -> anyhow::Result<Answer> {
        let mut command = Command::new(&self.python);
        command.arg(folder.join(self.file)).args(&self.args);
        let text = run_for_stdout(command, &format!("the script of {}", self.peer))?;
        let line = text.lines().last().unwrap_or_default();
        let answer = serde_json::from_str(line);
        answer.with_context(|| format!("the script of {} printed {line:?}", self.peer))
    }
}

/// Runs this program's bench of a component and returns the figures. Progress goes to stderr.
pub(super) fn ours(component: Component, flags: &BenchFlags) -> anyhow::Result<Vec<Measurement>> {
    let mut command = Command::new(process_env::program_path());
    command.args(["bench", &component.name(), "--json", "-"]);
    command.args(["--threads", &flags.threads.to_string()]);
    command.args(flags.quick.then_some("--quick"));
    for precision in &flags.precision {
        command.args(["--precision", &precision.to_string()]);
    }
    let text = run_for_stdout(command, &format!("the bench of the {}", component.name()))?;
    let report: Report = serde_json::from_str(&text).context("reading a bench's figures")?;
    Ok(report.figures)
}

fn run_for_stdout(mut command: Command, what: &str) -> anyhow::Result<String> {
    command.stdin(Stdio::null()).stderr(Stdio::inherit());
    let output = command.output();
    let output = output.with_context(|| format!("{what} could not be started"))?;
    let how = output.status;
    ensure!(how.success(), "{what} failed ({how}); its output is above");
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}
