//! Runs the peers: Python scripts that do the same work and print one line of JSON.
//! It installs nothing, and says what is missing.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::Context;
use serde::Deserialize;

use crate::flags::{BenchPeersArgs, Component};

/// The scripts, which this program carries, so that it can be started anywhere.
const FILES: [(&str, &str); 6] = [
    ("measure.py", include_str!("../../peers/measure.py")),
    (
        "torch_network.py",
        include_str!("../../peers/torch_network.py"),
    ),
    (
        "torch_update.py",
        include_str!("../../peers/torch_update.py"),
    ),
    (
        "torch_policy.py",
        include_str!("../../peers/torch_policy.py"),
    ),
    (
        "reverb_replay.py",
        include_str!("../../peers/reverb_replay.py"),
    ),
    ("gym3_steps.py", include_str!("../../peers/gym3_steps.py")),
];

/// Puts the scripts into a folder.
///
/// # Errors
/// A file that cannot be written.
pub(super) fn write_all(folder: &Path) -> anyhow::Result<()> {
    for (name, text) in FILES {
        std::fs::write(folder.join(name), text).with_context(|| format!("writing {name}"))?;
    }
    Ok(())
}

/// The scripts' texts.
#[cfg(test)]
pub(super) fn texts() -> [&'static str; 6] {
    FILES.map(|(_, text)| text)
}

/// What others use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Peer {
    Torch,
    Reverb,
    Gym3,
}

impl Peer {
    /// Its name in tables and messages.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Torch => "PyTorch",
            Self::Reverb => "Reverb",
            Self::Gym3 => "gym3",
        }
    }

    /// The modules that it takes, the file that lists their packages, and the flag that names its interpreter.
    const fn needs(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::Torch => ("torch", "requirements-torch.txt", "--torch-python"),
            Self::Reverb => ("reverb", "requirements-reverb.txt", "--reverb-python"),
            Self::Gym3 => ("procgen", "requirements-gym3.txt", "--gym3-python"),
        }
    }
}

/// Why a peer has no figures, as the table says it.
#[derive(Debug)]
pub(super) struct Absent(pub(super) String);

/// One peer's script and how it is called.
pub(super) struct Script {
    peer: Peer,
    python: PathBuf,
    path: PathBuf,
    args: Vec<String>,
}

/// The line that a script prints.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Answer {
    /// Name and version.
    peer: String,
    /// By what was measured, as ours.
    figures: BTreeMap<String, f64>,
}

impl Script {
    /// The script that does a component's work, in `folder`; `frames` is the file that Reverb's frames come from.
    pub(super) fn new(
        component: Component,
        args: &BenchPeersArgs,
        folder: &Path,
        frames: &Path,
    ) -> Self {
        let (peer, name, own) = match component {
            Component::Learner => (Peer::Torch, "torch_update.py", &args.torch_python),
            Component::Policy => (Peer::Torch, "torch_policy.py", &args.torch_python),
            Component::Replay => (Peer::Reverb, "reverb_replay.py", &args.reverb_python),
            Component::Env => (Peer::Gym3, "gym3_steps.py", &args.gym3_python),
        };
        let mut words = vec!["--threads".to_owned(), args.flags.threads.to_string()];
        words.extend(args.flags.quick.then(|| "--quick".to_owned()));
        if component == Component::Replay {
            words.extend(["--frames".to_owned(), frames.display().to_string()]);
        }
        Self {
            peer,
            python: own.as_ref().unwrap_or(&args.python).clone(),
            path: folder.join(name),
            args: words,
        }
    }

    /// Whose script it is.
    pub(super) const fn peer(&self) -> Peer {
        self.peer
    }

    /// Whether the interpreter is there and finds the peer's module.
    pub(super) fn check(&self) -> Result<(), Absent> {
        let (module, requirements, flag) = self.peer.needs();
        let find =
            "import importlib.util, sys; sys.exit(importlib.util.find_spec(sys.argv[1]) is None)";
        let found = Command::new(&self.python)
            .args(["-c", find, module])
            .stdin(Stdio::null())
            .stderr(Stdio::null())
            .status();
        let (python, name) = (self.python.display(), self.peer.name());
        match found {
            Ok(status) if status.success() => Ok(()),
            Ok(_) => Err(Absent(format!(
                "{python} has no {name}: {python} -m pip install -r deploy/bench/peers/{requirements}, or name one that has it with {flag}"
            ))),
            Err(e) => Err(Absent(format!(
                "{python} cannot be started ({e}): name a Python that has {name} with {flag}"
            ))),
        }
    }

    /// Runs the script and gives its peer's name with version, and its figures. Its progress goes to stderr.
    pub(super) fn run(&self) -> Result<(String, BTreeMap<String, f64>), Absent> {
        let name = self.peer.name();
        let output = Command::new(&self.python)
            .arg(&self.path)
            .args(&self.args)
            .stdin(Stdio::null())
            .stderr(Stdio::inherit())
            .output()
            .map_err(|e| Absent(format!("the script of {name} could not be started: {e}")))?;
        if !output.status.success() {
            let how = output.status;
            return Err(Absent(format!(
                "the script of {name} failed ({how}); what it said is above"
            )));
        }
        let text = String::from_utf8_lossy(&output.stdout);
        let line = text.lines().last().unwrap_or_default();
        let answer: Answer = serde_json::from_str(line)
            .map_err(|e| Absent(format!("the script of {name} printed {line:?}: {e}")))?;
        Ok((answer.peer, answer.figures))
    }
}
