//! The pinned wheel: fetching it with pip, checking its hash, unpacking what the engine needs of it.
//! It decides nothing about where things end up; `install` does.

use std::fs::{self, DirBuilder, File};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use sha2::{Digest, Sha256};

use crate::error::InstallError;
use crate::release::{WHEEL_NAME, pip_arguments};

const LIBENV_ENTRY: &str = "procgen/data/prebuilt/libenv.so";
const ASSETS_ENTRY: &str = "procgen/data/assets/";
const LICENSE_ENTRY: &str = "procgen-0.10.7.dist-info/LICENSE";

/// How long pip may take; then it is ended and the fetch has failed.
const FETCH_MAX: Duration = Duration::from_secs(600);

/// The ways to call pip, in the order in which they are tried.
const PIPS: [&[&str]; 3] = [&["pip"], &["pip3"], &["python3", "-m", "pip"]];

/// Lines of pip's output that a message repeats.
const OUTPUT_LINES_MAX: usize = 6;

/// Fetches the wheel into the folder `to` with the first pip there is, and gives its path.
pub(crate) fn fetch(to: &Path) -> Result<PathBuf, InstallError> {
    fetch_with(&PIPS, to, FETCH_MAX)
}

/// The first pip there is, as a person calls it.
pub(crate) fn find_pip() -> Option<String> {
    let works = |pip: &[&str]| {
        let mut command = Command::new(pip[0]);
        command.args(&pip[1..]).arg("--version");
        command.stdin(Stdio::null()).output()
    };
    let found = PIPS
        .iter()
        .find(|pip| works(pip).is_ok_and(|output| output.status.success()))?;
    Some(found.join(" "))
}

fn fetch_with(pips: &[&[&str]], to: &Path, limit: Duration) -> Result<PathBuf, InstallError> {
    let log = to.join("pip.log");
    for pip in pips {
        let mut command = Command::new(pip[0]);
        command
            .args(&pip[1..])
            .args(pip_arguments(to))
            .stdin(Stdio::null());
        let shown = pip.join(" ");
        let status = match run(&mut command, &log, limit) {
            Ok(status) => status,
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(error) => return Err(InstallError::io("running", Path::new(&shown), error)),
        };
        let output = fs::read(&log).map_err(|error| InstallError::io("reading", &log, error))?;
        let output = String::from_utf8_lossy(&output);
        let absent = output.contains("No module named pip")
            || status.is_some_and(|status| status.code() == Some(127));
        if absent {
            continue;
        }
        let wheel = to.join(WHEEL_NAME);
        return match status {
            Some(status) if status.success() && wheel.is_file() => Ok(wheel),
            Some(status) => Err(InstallError::PipFailed {
                pip: shown,
                status: status.to_string(),
                output: last_lines(&output),
            }),
            None => Err(InstallError::PipFailed {
                pip: shown,
                status: format!("not done after {} s", limit.as_secs()),
                output: last_lines(&output),
            }),
        };
    }
    Err(InstallError::NoPip)
}

/// Runs the command with its output in the file `log`; `None` when the limit passed and it was ended.
fn run(command: &mut Command, log: &Path, limit: Duration) -> io::Result<Option<ExitStatus>> {
    let out = File::create(log)?;
    let mut child = command.stdout(out.try_clone()?).stderr(out).spawn()?;
    let started = Instant::now();
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        if started.elapsed() >= limit {
            child.kill()?;
            child.wait()?;
            return Ok(None);
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}

fn last_lines(output: &str) -> String {
    let lines: Vec<&str> = output
        .lines()
        .map(str::trim_end)
        .filter(|line| !line.is_empty())
        .collect();
    lines[lines.len().saturating_sub(OUTPUT_LINES_MAX)..].join("\n  ")
}

/// SHA-256 of a file, in lower-case hexadecimal.
pub(crate) fn sha256(path: &Path) -> io::Result<String> {
    let mut file = File::open(path)?;
    let mut hasher = Sha256::new();
    let mut block = vec![0; 1 << 16];
    loop {
        let count = file.read(&mut block)?;
        if count == 0 {
            return Ok(hex(&hasher.finalize()));
        }
        hasher.update(&block[..count]);
    }
}

/// Bytes in lower-case hexadecimal.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Checks that the wheel is the pinned one.
pub(crate) fn check_hash(wheel: &Path, expected: &str) -> Result<(), InstallError> {
    let actual = sha256(wheel).map_err(|error| InstallError::io("reading", wheel, error))?;
    if actual == expected {
        return Ok(());
    }
    Err(InstallError::WrongHash {
        path: wheel.to_owned(),
        expected: expected.to_owned(),
        actual,
    })
}

/// Unpacks the engine, its pictures and its licence into the folder `to`: `libenv.so`, `assets/`, `LICENSE`.
///
/// An entry whose name leaves its folder (`..`, absolute) is an error, and nothing after it is unpacked.
pub(crate) fn unpack(wheel: &Path, to: &Path) -> Result<(), InstallError> {
    let bad = |reason: String| InstallError::BadWheel {
        path: wheel.to_owned(),
        reason,
    };
    let file = File::open(wheel).map_err(|error| InstallError::io("opening", wheel, error))?;
    let mut archive = zip::ZipArchive::new(file).map_err(|error| bad(error.to_string()))?;
    let mut found = false;
    for index in 0..archive.len() {
        let mut entry = archive
            .by_index(index)
            .map_err(|error| bad(error.to_string()))?;
        let name = entry
            .name()
            .map_err(|error| bad(error.to_string()))?
            .into_owned();
        // Both: the library's own judgement, and ours, which does not depend on how it cleans names up.
        let safe = entry.enclosed_name().is_some()
            && name.split('/').all(|part| part != "..")
            && !name.contains('\\');
        if !safe || name.starts_with('/') {
            return Err(bad(format!(
                "the entry \"{name}\" would be written outside its folder"
            )));
        }
        let target = if name == LIBENV_ENTRY {
            found = true;
            to.join("libenv.so")
        } else if name == LICENSE_ENTRY {
            to.join("LICENSE")
        } else if let Some(asset) = name.strip_prefix(ASSETS_ENTRY) {
            to.join("assets").join(asset)
        } else {
            continue;
        };
        if entry.is_dir() {
            make_folder(&target)?;
            continue;
        }
        if !entry.is_file() {
            return Err(bad(format!(
                "the entry \"{name}\" is neither a file nor a folder"
            )));
        }
        let parent = target.parent().unwrap_or(to);
        make_folder(parent)?;
        write(&mut entry, &target).map_err(|error| InstallError::io("writing", &target, error))?;
    }
    if found {
        Ok(())
    } else {
        Err(bad(format!("it has no {LIBENV_ENTRY}")))
    }
}

/// Makes a folder, and those above it, in which nobody else can change anything, whatever the umask says.
pub(crate) fn make_folder(path: &Path) -> Result<(), InstallError> {
    let made = DirBuilder::new().recursive(true).mode(0o755).create(path);
    made.map_err(|error| InstallError::io("making", path, error))
}

/// Writes a new file, which nobody else can change.
pub(crate) fn write(from: &mut impl Read, to: &Path) -> io::Result<()> {
    let mut options = File::options();
    let mut file = options.write(true).create_new(true).mode(0o644).open(to)?;
    io::copy(from, &mut file)?;
    file.flush()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::release::WHEEL_SHA256;

    /// A zip file with these entries.
    fn archive(folder: &Path, entries: &[(&str, &[u8])]) -> PathBuf {
        let path = folder.join("some.whl");
        let mut writer = zip::ZipWriter::new(File::create(&path).unwrap());
        for (name, bytes) in entries {
            writer
                .start_file(*name, zip::write::SimpleFileOptions::default())
                .unwrap();
            writer.write_all(bytes).unwrap();
        }
        writer.finish().unwrap();
        path
    }

    #[test]
    fn the_library_and_the_pictures_are_unpacked_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let entries: [(&str, &[u8]); 4] = [
            (LIBENV_ENTRY, b"elf"),
            ("procgen/data/assets/a/b.png", b"png"),
            ("procgen/env.py", b"print()"),
            (LICENSE_ENTRY, b"MIT"),
        ];
        let wheel = archive(folder.path(), &entries);
        let to = folder.path().join("to");
        fs::create_dir(&to).unwrap();
        unpack(&wheel, &to).unwrap();
        assert_eq!(fs::read(to.join("libenv.so")).unwrap(), b"elf");
        assert_eq!(fs::read(to.join("assets/a/b.png")).unwrap(), b"png");
        assert_eq!(fs::read_dir(&to).unwrap().count(), 3);
    }

    #[test]
    fn an_entry_that_leaves_its_folder_is_refused() {
        for name in [
            "procgen/data/assets/../../../../evil",
            "/evil",
            "../evil",
            "procgen/data/assets/..\\evil",
        ] {
            let folder = tempfile::tempdir().unwrap();
            let wheel = archive(folder.path(), &[(name, b"evil"), (LIBENV_ENTRY, b"elf")]);
            let to = folder.path().join("a/b/c/d");
            fs::create_dir_all(&to).unwrap();
            let error = unpack(&wheel, &to).unwrap_err().to_string();
            assert!(error.contains("outside its folder"), "{name}: {error}");
            assert_eq!(fs::read_dir(&to).unwrap().count(), 0, "{name}");
        }
    }

    #[test]
    fn a_wheel_without_the_engine_and_a_file_that_is_no_wheel_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let wheel = archive(folder.path(), &[("procgen/env.py", b"")]);
        let error = unpack(&wheel, folder.path()).unwrap_err().to_string();
        assert!(
            error.contains("has no procgen/data/prebuilt/libenv.so"),
            "{error}"
        );
        fs::write(&wheel, b"no zip").unwrap();
        assert!(matches!(
            unpack(&wheel, folder.path()),
            Err(InstallError::BadWheel { .. })
        ));
    }

    #[test]
    fn the_hash_is_sha256() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), b"abc").unwrap();
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(sha256(file.path()).unwrap(), abc);
        check_hash(file.path(), abc).unwrap();
        let error = check_hash(file.path(), WHEEL_SHA256)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains(WHEEL_SHA256) && error.contains(abc),
            "{error}"
        );
    }

    /// An executable script that stands for pip.
    #[cfg(unix)]
    fn script(folder: &Path, text: &str) -> String {
        use std::os::unix::fs::PermissionsExt;
        let path = folder.join("pip");
        fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        path.display().to_string()
    }

    #[cfg(unix)]
    #[test]
    fn each_way_pip_can_fail_has_its_own_message() {
        let folder = tempfile::tempdir().unwrap();
        let limit = Duration::from_secs(20);
        let fetch =
            |pip: &str, limit| fetch_with(&[&["/nowhere/pip"], &[pip]], folder.path(), limit);

        let error = fetch("/nowhere/pip3", limit).unwrap_err();
        assert!(matches!(error, InstallError::NoPip), "{error}");

        let pip = script(
            folder.path(),
            "echo 'pyenv: pip: command not found' >&2; exit 127",
        );
        assert!(matches!(fetch(&pip, limit), Err(InstallError::NoPip)));

        let pip = script(
            folder.path(),
            "echo first; echo 'ERROR: Could not find a version' >&2; exit 1",
        );
        let error = fetch(&pip, limit).unwrap_err().to_string();
        assert!(
            error.contains("first\n  ERROR: Could not find a version"),
            "{error}"
        );
        assert!(error.contains("exit status: 1"), "{error}");

        let pip = script(folder.path(), "exec sleep 60");
        let error = fetch(&pip, Duration::from_millis(200))
            .unwrap_err()
            .to_string();
        assert!(error.contains("not done after"), "{error}");
    }
}
