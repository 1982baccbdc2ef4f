//! The folder in which the processes of a run meet at unix sockets: private, beside other temporary files, and removed with the
//! last process that uses it. A socket's path must be short, so it is not in the run folder.
//!
//! The folder is in use as long as a process holds the lock of one file in it: the launcher, and each process that it started,
//! which has the file as its standard input. A folder whose launcher was killed is recognised by this, and removed by the next
//! launcher that starts or the last process that ends.

use std::{
    fs::{self, File, Permissions},
    io,
    os::unix::fs::{MetadataExt, PermissionsExt},
    path::{Path, PathBuf},
};

use anyhow::Context;
use driml_protocol::lock_file;
use nix::unistd::{dup2_stdin, geteuid};

use crate::endpoint::{ADDRESS_ENDS, SOCKET_PATH_MAX};

const PREFIX: &str = "driml-run-";
/// The longest name of a socket behind the folder for temporary files.
const SOCKET: &str = "/driml-run-XXXXXX/replay-server-255.sock";
/// Where the folder is if the one for temporary files has too long a name.
const SHORT_PLACE: &str = "/tmp";
const IN_USE: &str = "in-use";

/// A run's folder for sockets. Dropping it removes it.
#[derive(Debug)]
pub struct Rendezvous {
    folder: tempfile::TempDir,
    lock: File,
}

impl Rendezvous {
    /// Makes one, and removes those that are no longer in use.
    pub(crate) fn create() -> anyhow::Result<Self> {
        let place = place_under(std::env::temp_dir());
        sweep(&place);
        Self::create_in(&place).with_context(|| {
            let place = place.display();
            format!("making a folder for the socket in {place}: set TMPDIR to a folder that may be written")
        })
    }

    fn create_in(place: &Path) -> io::Result<Self> {
        // Any process that can reach the socket can take part in the run.
        let folder = tempfile::Builder::new()
            .prefix(PREFIX)
            .permissions(Permissions::from_mode(0o700))
            .tempdir_in(place)?;
        // Locked before it has the name by which it is known, or a process that sweeps just now would find it without a holder.
        let fresh = folder.path().join("new");
        let lock = File::create(&fresh)?;
        if let Err(e) = lock_file::try_lock(&lock) {
            // What cannot be locked is not swept.
            tracing::debug!("locking {}: {e}", fresh.display());
        }
        fs::rename(fresh, folder.path().join(IN_USE))?;
        Ok(Self { folder, lock })
    }

    /// Where the folder lies: written into the run folder, so that `--resume` can see whether it is still used.
    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    pub(crate) fn endpoint(&self, name: &str) -> String {
        let path = self.folder.path().join(format!("{name}.sock"));
        format!("unixsock-stream/{}", path.display())
    }

    /// The lock, for a process that uses the folder: its standard input.
    pub(crate) fn hold(&self) -> io::Result<File> {
        self.lock.try_clone()
    }
}

/// Where such folders are, beside other temporary files if these are in `folder`.
fn place_under(folder: PathBuf) -> PathBuf {
    let path = folder.to_string_lossy();
    let fits = path.len() + SOCKET.len() <= SOCKET_PATH_MAX && !path.contains(ADDRESS_ENDS);
    if fits { folder } else { SHORT_PLACE.into() }
}

/// What a process does at its orderly end: uses no such folder any more, and sweeps, as its launcher may have been killed.
pub fn leave() {
    let nothing = File::open("/dev/null");
    match nothing.and_then(|nothing| Ok(dup2_stdin(nothing)?)) {
        Ok(()) => sweep(&place_under(std::env::temp_dir())),
        Err(e) => tracing::debug!("leaving the folder of the socket: {e}"),
    }
}

/// Removes folders of this user in `place` that are no longer in use. What cannot be removed stays and does no harm.
fn sweep(place: &Path) {
    let entries = fs::read_dir(place).into_iter().flatten().flatten();
    for entry in entries.filter(|it| it.file_name().to_string_lossy().starts_with(PREFIX)) {
        let is_ours = |it: fs::Metadata| it.is_dir() && it.uid() == geteuid().as_raw();
        let is_ours = entry.metadata().is_ok_and(is_ours);
        if is_ours && is_free(&entry.path()) == Some(true) {
            let removed = fs::remove_dir_all(entry.path());
            tracing::debug!("removing {}: {removed:?}", entry.path().display());
        }
    }
}

/// Whether the lock of the folder at `path` can be had; none if that is not known.
fn is_free(path: &Path) -> Option<bool> {
    let lock = File::open(path.join(IN_USE)).ok()?;
    lock_file::try_lock(&lock).ok()
}

pub(crate) fn is_used(path: &Path) -> bool {
    is_free(path) == Some(false)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folders(place: &Path) -> usize {
        fs::read_dir(place).unwrap().count()
    }

    #[test]
    fn a_folder_that_no_endpoint_can_name_is_not_used() {
        for (folder, place) in [("/tmp/a", "/tmp/a"), ("/tmp/a#b", "/tmp"), ("/a?", "/tmp")] {
            assert_eq!(place_under(folder.into()), Path::new(place));
        }
    }

    #[test]
    fn unused_folders_are_swept_and_nothing_else() {
        let place = tempfile::tempdir().unwrap();
        let rendezvous = Rendezvous::create_in(place.path()).unwrap();
        let path = rendezvous.folder.path().display().to_string();
        let endpoint = format!("unixsock-stream/{path}/learner.sock");
        assert_eq!(rendezvous.endpoint("learner"), endpoint);
        let mode = fs::metadata(rendezvous.folder.path()).unwrap().mode();
        assert_eq!(mode & 0o777, 0o700);
        // Of another program, by its name or content.
        fs::create_dir(place.path().join("driml-run-other")).unwrap();
        fs::create_dir(place.path().join("else")).unwrap();
        fs::write(place.path().join("else").join(IN_USE), "").unwrap();
        sweep(place.path());
        assert_eq!(folders(place.path()), 3);

        // As after the launcher was killed: a process still uses it.
        let process = rendezvous.hold().unwrap();
        let Rendezvous { folder, lock } = rendezvous;
        let path = folder.keep();
        fs::write(path.join("learner.sock"), "").unwrap();
        drop(lock);
        sweep(place.path());
        assert!(path.exists() && is_used(&path));
        drop(process);
        assert!(!is_used(&path));
        sweep(place.path());
        assert!(!is_used(&path), "it is gone");
        assert!(!path.exists());
        assert_eq!(folders(place.path()), 2);
    }
}
