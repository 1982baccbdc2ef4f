//! The pinned wheel of procgen: which one it is, fetching it with pip, unpacking what the engine needs of it.
//! It decides nothing about where things end up; `install` does.

use std::fs::{self, DirBuilder, File};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use sha2::{Digest, Sha256};

use crate::error::InstallError;

/// The wheel's file name. It is the one for CPython 3.10, but no Python is needed to use the engine in it.
pub(crate) const WHEEL_NAME: &str =
    "procgen-0.10.7-cp310-cp310-manylinux_2_17_x86_64.manylinux2014_x86_64.whl";

/// SHA-256 of a wheel and of the library in it, in lower-case hexadecimal.
#[derive(Clone, Copy)]
pub(crate) struct Hashes<'a> {
    pub(crate) wheel: &'a str,
    pub(crate) library: &'a str,
}

/// Those of the wheel that the Python package index serves.
pub(crate) const PINNED: Hashes<'static> = Hashes {
    wheel: "4b594d14e42f0f2166e59a9e294477b906eb99c90c3343b570b7124cbc865f53",
    library: "f44786431a902e9ae1a32cd44f4aa650f4bdad893240a322e49e6098d6a7a2ea",
};

const LIBRARY_ENTRY: &str = "procgen/data/prebuilt/libenv.so";
const ASSETS_ENTRY: &str = "procgen/data/assets";
const LICENSE_ENTRY: &str = "procgen-0.10.7.dist-info/LICENSE";

/// Which wheel pip is to take, whatever Python it runs on.
const PIP_SELECTION: &str = "--no-deps --only-binary=:all: --python-version 3.10 --abi cp310 --platform manylinux2014_x86_64";

/// pip gives up by itself: 30 s without a byte, three tries.
const PIP_LIMITS: &str = "--timeout 30 --retries 2 --no-input --disable-pip-version-check";

/// Lines of pip's output that a message repeats.
const OUTPUT_LINES_MAX: usize = 6;

/// The command that fetches the wheel into the current folder, for people.
pub(crate) fn command_for_people() -> String {
    format!("python3 -m pip download procgen==0.10.7 {PIP_SELECTION}")
}

/// Fetches the wheel into the folder `to` with pip, which checks its hash, and gives its path.
pub(crate) fn fetch(to: &Path) -> Result<PathBuf, InstallError> {
    fetch_with("python3", to)
}

fn fetch_with(python: &str, to: &Path) -> Result<PathBuf, InstallError> {
    let pins = to.join("requirements.txt");
    let text = format!("procgen==0.10.7 --hash=sha256:{}\n", PINNED.wheel);
    fs::write(&pins, text).map_err(InstallError::io("writing", &pins))?;
    let [to_text, pins] = [to, &pins].map(|path| path.display().to_string());
    let mut arguments = vec!["download", "--require-hashes", "-r", &pins];
    arguments.extend(["--dest", &to_text]);
    arguments.extend(PIP_SELECTION.split(' ').chain(PIP_LIMITS.split(' ')));
    let output = pip(python, &arguments)?;
    let wheel = to.join(WHEEL_NAME);
    if output.status.success() && wheel.is_file() {
        return Ok(wheel);
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<&str> = said
        .lines()
        .filter(|line| !line.trim().is_empty())
        .collect();
    let last = &lines[lines.len().saturating_sub(OUTPUT_LINES_MAX)..];
    Err(InstallError::Fetch(format!(
        "`{python} -m pip download` failed ({}); check the network and which package index pip uses. Its output:\n  {}\n",
        output.status,
        last.join("\n  ")
    )))
}

pub(crate) fn check_pip() -> Result<(), InstallError> {
    pip("python3", &["--version"]).map(drop)
}

fn pip(python: &str, arguments: &[&str]) -> Result<Output, InstallError> {
    let mut command = Command::new(python);
    command.args(["-m", "pip"]).args(arguments);
    let missing = |what: &str| {
        let text = format!(
            "{what} is not installed; install Python and pip (`apt-get install python3-pip`, `dnf install python3-pip`)"
        );
        Err(InstallError::Fetch(text))
    };
    match command.stdin(Stdio::null()).output() {
        Err(error) if error.kind() == ErrorKind::NotFound => missing(python),
        Err(error) => Err(InstallError::io("running", Path::new(python))(error)),
        // The status of a launcher that finds no Python behind it.
        Ok(output) if output.status.code() == Some(127) => missing(python),
        Ok(output) if String::from_utf8_lossy(&output.stderr).contains("No module named pip") => {
            missing("pip")
        }
        Ok(output) => Ok(output),
    }
}

pub(crate) fn check_hash(path: &Path, expected: &str) -> Result<(), InstallError> {
    let mut hasher = Sha256::new();
    let mut file = File::open(path).map_err(InstallError::io("opening", path))?;
    io::copy(&mut file, &mut hasher).map_err(InstallError::io("reading", path))?;
    let bytes = hasher.finalize();
    let actual: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    if actual == expected {
        return Ok(());
    }
    let reason = format!("its SHA-256 is {actual}, expected {expected}");
    Err(bad(path)(reason))
}

fn bad<E: ToString>(path: &Path) -> impl Fn(E) -> InstallError {
    move |reason| InstallError::Wheel {
        path: path.to_owned(),
        reason: reason.to_string(),
    }
}

/// Unpacks the engine, its pictures and its licence into the new folder `to`: `libenv.so`, `assets/`, `LICENSE`. Other users can
/// change none of it, whatever the umask says.
///
/// An entry whose name leaves its folder (`..`) is an error, and nothing after it is unpacked.
pub(crate) fn unpack(wheel: &Path, to: &Path) -> Result<(), InstallError> {
    let file = File::open(wheel).map_err(InstallError::io("opening", wheel))?;
    let mut archive = zip::ZipArchive::new(file).map_err(bad(wheel))?;
    make_folder(&to.join("assets"))?;
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index).map_err(bad(wheel))?;
        let name = entry.enclosed_name().ok_or_else(|| {
            bad(wheel)(format!("entry {index} would be written outside its folder"))
        })?;
        let target = if name == Path::new(LIBRARY_ENTRY) {
            to.join("libenv.so")
        } else if name == Path::new(LICENSE_ENTRY) {
            to.join("LICENSE")
        } else if let Ok(asset) = name.strip_prefix(ASSETS_ENTRY) {
            to.join("assets").join(asset)
        } else {
            continue;
        };
        if entry.is_dir() {
            make_folder(&target)?;
            continue;
        }
        make_folder(target.parent().unwrap_or(to))?;
        let mut new = File::options();
        new.write(true).create_new(true).mode(0o644);
        new.open(&target)
            .and_then(|mut file| io::copy(&mut entry, &mut file))
            .map_err(InstallError::io("writing", &target))?;
    }
    match to.join("libenv.so").is_file() {
        true => Ok(()),
        false => Err(bad(wheel)(format!("it has no {LIBRARY_ENTRY}"))),
    }
}

/// Makes a folder, and those above it, in which other users can change nothing.
pub(crate) fn make_folder(path: &Path) -> Result<(), InstallError> {
    let made = DirBuilder::new().recursive(true).mode(0o755).create(path);
    made.map_err(InstallError::io("making", path))
}

#[cfg(test)]
pub(crate) mod tests {
    use std::io::Write;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    pub(crate) fn archive(path: &Path, entries: &[(&str, &[u8])]) {
        let mut writer = zip::ZipWriter::new(File::create(path).unwrap());
        for (name, bytes) in entries {
            let options = zip::write::SimpleFileOptions::default();
            writer.start_file(*name, options).unwrap();
            writer.write_all(bytes).unwrap();
        }
        writer.finish().unwrap();
    }

    #[test]
    fn the_library_and_the_pictures_are_unpacked_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let [wheel, to] = ["some.whl", "a/b/c/d"].map(|name| folder.path().join(name));
        let entries: [(&str, &[u8]); 4] = [
            (LIBRARY_ENTRY, b"elf"),
            ("procgen/data/assets/a/b.png", b"png"),
            ("procgen/env.py", b"print()"),
            (LICENSE_ENTRY, b"MIT"),
        ];
        archive(&wheel, &entries);
        unpack(&wheel, &to).unwrap();
        assert_eq!(fs::read(to.join("libenv.so")).unwrap(), b"elf");
        assert_eq!(fs::read(to.join("assets/a/b.png")).unwrap(), b"png");
        assert_eq!(fs::read_dir(&to).unwrap().count(), 3);

        for (entry, reason) in [
            (
                "procgen/env.py",
                "it has no procgen/data/prebuilt/libenv.so",
            ),
            (
                "procgen/data/assets/../../../../../evil",
                "outside its folder",
            ),
            ("../evil", "outside its folder"),
        ] {
            fs::remove_dir_all(&to).unwrap();
            archive(&wheel, &[(entry, b"evil")]);
            let error = unpack(&wheel, &to).unwrap_err().to_string();
            assert!(error.contains(reason), "{entry}: {error}");
            assert!(!folder.path().join("a/b/evil").exists(), "{entry}");
        }
        fs::write(&wheel, b"no zip").unwrap();
        let error = unpack(&wheel, &to).unwrap_err();
        assert!(matches!(error, InstallError::Wheel { .. }), "{error}");
    }

    #[test]
    fn a_hash_is_sha256() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), b"abc").unwrap();
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        check_hash(file.path(), abc).unwrap();
        let error = check_hash(file.path(), PINNED.wheel).unwrap_err();
        let text = format!("its SHA-256 is {abc}, expected {}", PINNED.wheel);
        assert!(error.to_string().contains(&text), "{error}");
    }

    #[test]
    fn each_way_pip_can_fail_has_its_message() {
        let folder = tempfile::tempdir().unwrap();
        let python = folder.path().join("python3");
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
            ("exit 0", &["failed (exit status: 0)"]),
        ] {
            fs::write(&python, format!("#!/bin/sh\n{script}\n")).unwrap();
            fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).unwrap();
            let error = fetch_with(python.to_str().unwrap(), folder.path());
            let error = error.unwrap_err().to_string();
            for text in texts {
                assert!(error.contains(text), "{script}: {error}");
            }
        }
        let error = fetch_with("/nowhere/python3", folder.path()).unwrap_err();
        assert!(error.to_string().contains("is not installed"), "{error}");
    }
}
