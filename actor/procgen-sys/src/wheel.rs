//! The pinned wheel of procgen: which wheel it is, and which of its files the engine needs. pip unpacks it.
//! It decides nothing about where the files go; `install` does.

use std::fs::{self, DirBuilder, File};
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use sha2::{Digest, Sha256};

use crate::error::ProcgenError;

/// The wheel's file name. It is the one for CPython 3.10, but no Python is needed to use the engine in it.
pub(crate) const WHEEL_NAME: &str =
    "procgen-0.10.7-cp310-cp310-manylinux_2_17_x86_64.manylinux2014_x86_64.whl";

/// SHA-256 of the wheel that the Python package index serves, in lower-case hexadecimal.
pub(crate) const WHEEL_SHA256: &str =
    "4b594d14e42f0f2166e59a9e294477b906eb99c90c3343b570b7124cbc865f53";

/// SHA-256 of the library in it.
pub(crate) const LIBRARY_SHA256: &str =
    "f44786431a902e9ae1a32cd44f4aa650f4bdad893240a322e49e6098d6a7a2ea";

/// The files of the wheel that the engine needs, and their names where they are installed.
const ENGINE_FILES: [(&str, &str); 3] = [
    ("procgen/data/prebuilt/libenv.so", "libenv.so"),
    ("procgen/data/assets", "assets"),
    ("procgen-0.10.7.dist-info/LICENSE", "LICENSE"),
];

/// pip's flags that select this wheel, whatever Python pip runs on.
const PIP_SELECTION: &str = "--no-deps --only-binary=:all: --python-version 3.10 --abi cp310 --platform manylinux2014_x86_64";

/// pip's flags that make it give up after three tries of 30 s without a byte.
const PIP_LIMITS: &str = "--timeout 30 --retries 2 --no-input --disable-pip-version-check";

/// The most lines of pip's output that a message quotes.
const OUTPUT_LINES_MAX: usize = 6;

/// The most characters of each; a full disk names every file in one line.
const LINE_CHARS_MAX: usize = 300;

/// The command that fetches the wheel into the current folder, for people.
pub(crate) fn fetch_command() -> String {
    format!("python3 -m pip download procgen==0.10.7 {PIP_SELECTION}")
}

/// Unpacks the engine, its pictures and its licence into the new folder `to`: `libenv.so`, `assets/`, `LICENSE`. pip
/// takes the wheel from the folder `provided`, else from the package index, and checks its hash.
pub(crate) fn unpack(python: &str, to: &Path, provided: Option<&Path>) -> Result<(), ProcgenError> {
    let [target, pins] = ["wheel", "txt"].map(|extension| to.with_extension(extension));
    let text = format!("procgen==0.10.7 --hash=sha256:{WHEEL_SHA256}\n");
    fs::write(&pins, text).map_err(ProcgenError::io("writing", &pins))?;
    let [target_text, pins] = [&target, &pins].map(|path| path.display().to_string());
    let mut arguments = vec!["install", "--no-compile", "--require-hashes", "-r", &pins];
    arguments.extend(["--target", &target_text]);
    arguments.extend(PIP_SELECTION.split(' ').chain(PIP_LIMITS.split(' ')));
    let provided = provided.map(|folder| folder.display().to_string());
    if let Some(folder) = &provided {
        arguments.extend(["--no-index", "--find-links", folder]);
    }
    let output = run_pip(python, &arguments)?;
    if output.status.success() {
        make_folder(to)?;
        for (path, name) in ENGINE_FILES {
            let path = target.join(path);
            fs::rename(&path, to.join(name)).map_err(ProcgenError::io("moving", &path))?;
        }
        return Ok(());
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    let lines = stderr.lines().filter(|line| !line.trim().is_empty());
    let lines: Vec<&str> = lines.collect();
    let last = lines[lines.len().saturating_sub(OUTPUT_LINES_MAX)..].iter();
    let cut = |line: &&str| line.chars().take(LINE_CHARS_MAX).collect::<String>();
    let last: Vec<_> = last.map(cut).collect();
    let hint = match stderr.contains("No space left") {
        true => "make room, or choose other places with DRIML_CACHE and TMPDIR",
        false => "check the network and which package index pip uses",
    };
    Err(ProcgenError::Fetch(format!(
        "`{python} -m pip install` failed ({}); {hint}. Its output:\n  {}\n",
        output.status,
        last.join("\n  ")
    )))
}

/// Runs pip with these arguments and returns its output. Returns an error if Python or pip is missing.
pub(crate) fn run_pip(python: &str, arguments: &[&str]) -> Result<Output, ProcgenError> {
    // Other users must not be able to change the files that pip writes, whatever the caller's umask.
    let mut command = Command::new("sh");
    command.args(["-c", "umask 022; exec \"$@\"", "sh", python, "-m", "pip"]);
    // A configuration of pip with `user = true` conflicts with `--target`; with `require-virtualenv = true` pip installs nothing here.
    command.args(arguments);
    command.envs([("PIP_USER", "0"), ("PIP_REQUIRE_VIRTUALENV", "0")]);
    let missing = |what: &str| {
        let text = format!(
            "{what} is not installed; install Python and pip (`apt-get install python3-pip`, `dnf install python3-pip`, in a virtual environment `python3 -m ensurepip`)"
        );
        Err(ProcgenError::Fetch(text))
    };
    match command.stdin(Stdio::null()).output() {
        Err(error) => Err(ProcgenError::io("running", Path::new("sh"))(error)),
        // The exit status of a shell that finds no Python, or of a launcher that finds none.
        Ok(output) if output.status.code() == Some(127) => missing(python),
        Ok(output) if String::from_utf8_lossy(&output.stderr).contains("No module named pip") => {
            missing("pip")
        }
        Ok(output) => Ok(output),
    }
}

pub(crate) fn check_hash(path: &Path, expected: &str) -> Result<(), ProcgenError> {
    let mut hasher = Sha256::new();
    let mut file = File::open(path).map_err(ProcgenError::io("opening", path))?;
    io::copy(&mut file, &mut hasher).map_err(ProcgenError::io("reading", path))?;
    let actual = format!("{:x}", hasher.finalize());
    if actual == expected {
        return Ok(());
    }
    let path = path.display();
    Err(ProcgenError::Wheel(format!(
        "{path}: its SHA-256 is {actual}, expected {expected}"
    )))
}

/// Makes a folder, and its parents, in which other users cannot change anything.
pub(crate) fn make_folder(path: &Path) -> Result<(), ProcgenError> {
    let created = DirBuilder::new().recursive(true).mode(0o755).create(path);
    created.map_err(ProcgenError::io("making", path))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    /// Unpacks into `fresh` in `folder`, with `script`, run in `folder`, in place of Python.
    fn unpack_by(script: &str, folder: &Path, provided: Option<&Path>) -> Result<(), ProcgenError> {
        let python = folder.join("python3");
        let script = format!("#!/bin/sh\ncd \"${{0%/*}}\"\n{script}\n");
        fs::write(&python, script).unwrap();
        fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).unwrap();
        unpack(python.to_str().unwrap(), &folder.join("fresh"), provided)
    }

    /// One test, as a script cannot be started while a process that another test starts has it open.
    #[test]
    fn pip_unpacks_what_the_engine_needs_and_each_way_it_can_fail_has_its_message() {
        for provided in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            let folder = folder.path();
            let script = "
                mkdir -p fresh.wheel/procgen/data/prebuilt fresh.wheel/procgen/data/assets/a
                mkdir fresh.wheel/procgen-0.10.7.dist-info
                cd fresh.wheel
                touch procgen/env.py procgen-0.10.7.dist-info/LICENSE
                echo \"$@\" >procgen/data/prebuilt/libenv.so
                echo png >procgen/data/assets/a/b.png";
            unpack_by(script, folder, provided.then_some(folder)).unwrap();
            let fresh = folder.join("fresh");
            assert!(fresh.join("assets/a/b.png").is_file());
            assert_eq!(fs::read_dir(&fresh).unwrap().count(), 3);
            let arguments = fs::read_to_string(fresh.join("libenv.so")).unwrap();
            let offline = format!("--no-index --find-links {}\n", folder.display());
            assert!(arguments.contains("--require-hashes"), "{arguments}");
            assert_eq!(arguments.ends_with(&offline), provided, "{arguments}");
            let mode = fs::metadata(fresh.join("libenv.so")).unwrap().permissions();
            assert_eq!(mode.mode() & 0o777, 0o644);
        }
        let folder = tempfile::tempdir().unwrap();
        for (script, texts) in [
            ("exit 127", &["python3 is not installed", "python3-pip"][..]),
            (
                "echo 'python3: No module named pip' >&2; exit 1",
                &["fetching procgen's engine: pip is not installed"],
            ),
            (
                "echo first >&2; echo 'ERROR: no such version' >&2; exit 1",
                &["(exit status: 1)", "  first\n  ERROR: no such version"],
            ),
            ("exit 0", &["moving ", "procgen/data/prebuilt/libenv.so"]),
        ] {
            let error = unpack_by(script, folder.path(), None).unwrap_err();
            let error = error.to_string();
            for text in texts {
                assert!(error.contains(text), "{script}: {error}");
            }
        }
        let to = folder.path().join("fresh");
        let error = unpack("/nowhere/python3", &to, None).unwrap_err();
        assert!(error.to_string().contains("is not installed"), "{error}");
    }
}
