//! Files and folders that a call names for its output: checked before the work, and replaced whole.
//! One that cannot be written is a wrong call (exit code 64). What a run writes later is in `run_folder`.

use std::{fs, io, path::Path};

use driml_machine::error::{Usage, usage};
use driml_protocol::atomic_write;
use nix::{
    errno::Errno,
    unistd::{AccessFlags, access},
};
use tempfile::TempDir;

/// Rejects a file that cannot be written, before any work is done for it. `what` names it in the error, such as `--out`.
pub fn check_file(what: &str, path: &Path) -> Result<(), Usage> {
    let folder = path.parent().filter(|it| *it != Path::new(""));
    let folder = folder.unwrap_or(Path::new("."));
    match access(folder, AccessFlags::W_OK | AccessFlags::X_OK) {
        _ if path.is_dir() => Err(unwritable(what, path, Errno::EISDIR)),
        _ if folder.is_file() => Err(unwritable(what, path, Errno::ENOTDIR)),
        Err(e) if !is_special(path) => Err(unwritable(what, path, e)),
        _ => Ok(()),
    }
}

/// Rejects a folder that cannot be made or written to, without making it.
pub fn check_folder(what: &str, path: &Path) -> Result<(), Usage> {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let Some(existing) = absolute.ancestors().find(|it| it.exists()) else {
        return Ok(());
    };
    match access(existing, AccessFlags::W_OK | AccessFlags::X_OK) {
        _ if !existing.is_dir() => Err(unwritable(what, path, Errno::ENOTDIR)),
        Err(e) => Err(unwritable(what, path, e)),
        Ok(()) => Ok(()),
    }
}

/// Makes a folder and those above it.
pub fn make_folder(what: &str, path: &Path) -> Result<(), Usage> {
    fs::create_dir_all(path).map_err(|e| unwritable(what, path, e))
}

/// Writes a file whole or not at all. A link, pipe or device stays, and is written to.
pub fn write_file(what: &str, path: &Path, bytes: &[u8]) -> Result<(), Usage> {
    check_file(what, path)?;
    let written = match is_special(path) {
        true => fs::write(path, bytes),
        false => atomic_write::write(path, bytes),
    };
    written.map_err(|e| unwritable(what, path, e))
}

fn is_special(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|it| !it.is_file())
}

/// Makes a folder among the temporary files, which is removed on drop.
pub fn temporary_folder() -> Result<TempDir, Usage> {
    let made = tempfile::Builder::new().prefix("driml-").tempdir();
    made.map_err(|e| no_temporary_folder(&std::env::temp_dir(), &e))
}

/// The error for a folder that cannot be made in `parent`, the folder for temporary files.
pub(crate) fn no_temporary_folder(parent: &Path, error: &io::Error) -> Usage {
    let parent = parent.display();
    usage!(
        "no temporary folder can be made in {parent}: {error}; set TMPDIR to a folder that can be written"
    )
}

/// The error for an output that cannot be written.
pub fn unwritable(what: &str, path: &Path, error: impl Into<io::Error>) -> Usage {
    let (path, error) = (path.display(), error.into());
    usage!("{what} {path} cannot be written: {error}; choose another place")
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    /// A reader that has opened the old file reads it to its end.
    #[test]
    fn a_file_is_replaced_whole_and_a_link_stays() {
        let folder = tempfile::tempdir().unwrap();
        let [path, link] = ["a.csv", "link"].map(|name| folder.path().join(name));
        std::os::unix::fs::symlink(&path, &link).unwrap();
        write_file("--out", &path, b"old").unwrap();
        let mut reader = fs::File::open(&path).unwrap();
        write_file("--out", &path, b"new").unwrap();
        let mut text = String::new();
        reader.read_to_string(&mut text).unwrap();
        assert_eq!(text, "old");
        write_file("--out", &link, b"newer").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"newer");
        assert!(link.is_symlink());
        let said = check_file("--out", &path.join("x")).unwrap_err().0;
        assert!(said.contains("Not a directory"), "{said}");
    }
}
