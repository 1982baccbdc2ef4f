//! The folder with the unix sockets of a run's processes. It is private, lies among the temporary files, and is removed with the
//! last process that uses it. A socket's path must be short, so the folder is not in the run folder.
//!
//! The folder is in use as long as a process holds the lock on its file `in-use`: the launcher, and each process that the launcher
//! started, which has that file as its standard input. A folder whose launcher was killed is recognised by its free lock. The next
//! launcher that starts, or the last process that exits, removes it.

use std::{
    fs::{self, File, Permissions},
    io,
    os::unix::fs::{MetadataExt, PermissionsExt},
    path::{Path, PathBuf},
};

use driml_machine::error::Usage;
use driml_protocol::lock_file;
use nix::unistd::{dup2_stdin, geteuid};

use crate::{
    endpoint::{ADDRESS_ENDS, SOCKET_PATH_MAX},
    output::no_temporary_folder,
};

const PREFIX: &str = "driml-run-";
/// The longest path of a socket below the folder for temporary files.
const LONGEST_SOCKET: &str = "/driml-run-XXXXXX/replay-server-255.sock";
/// Where the folder lies if the path for temporary files is too long, or has characters that an endpoint cannot have.
const SHORT_PARENT: &str = "/tmp";
const IN_USE: &str = "in-use";

/// A run's folder for sockets, removed on drop.
#[derive(Debug)]
pub struct Rendezvous {
    folder: tempfile::TempDir,
    lock: File,
}

impl Rendezvous {
    pub(crate) fn create() -> Result<Self, Usage> {
        let parent = parent_folder(std::env::temp_dir());
        remove_unused(&parent);
        Self::create_in(&parent).map_err(|e| no_temporary_folder(&parent, &e))
    }

    fn create_in(parent: &Path) -> io::Result<Self> {
        // Private, because any process that can reach the socket can take part in the run.
        let folder = tempfile::Builder::new()
            .prefix(PREFIX)
            .permissions(Permissions::from_mode(0o700))
            .tempdir_in(parent)?;
        // Locked before it gets its final name; otherwise a process that sweeps just now would find a folder without a holder.
        let new_lock = folder.path().join("new");
        let lock = File::create(&new_lock)?;
        if let Err(e) = lock_file::try_lock(&lock) {
            // A folder that cannot be locked is never swept.
            tracing::debug!("locking {}: {e}", new_lock.display());
        }
        fs::rename(new_lock, folder.path().join(IN_USE))?;
        Ok(Self { folder, lock })
    }

    /// The path of the folder. It is written into the run folder, so that `--resume` can see whether the folder is still used.
    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    pub(crate) fn endpoint(&self, name: &str) -> String {
        let path = self.folder.path().join(format!("{name}.sock"));
        format!("unixsock-stream/{}", path.display())
    }

    /// A handle on the lock, for a process that uses the folder: its standard input.
    pub(crate) fn lock_handle(&self) -> io::Result<File> {
        self.lock.try_clone()
    }
}

/// Where such folders lie: in `folder`, the one for temporary files, if an endpoint can name a path there.
fn parent_folder(folder: PathBuf) -> PathBuf {
    let can_name = |path: &str| {
        path.len() + LONGEST_SOCKET.len() <= SOCKET_PATH_MAX && !path.contains(ADDRESS_ENDS)
    };
    let folder = std::path::absolute(folder).ok();
    let folder = folder.filter(|it| it.to_str().is_some_and(can_name));
    folder.unwrap_or_else(|| SHORT_PARENT.into())
}

/// Called at the orderly exit of a process: releases its lock on the folder, and sweeps, as its launcher may have been killed.
pub fn leave() {
    let nothing = File::open("/dev/null");
    match nothing.and_then(|nothing| Ok(dup2_stdin(nothing)?)) {
        Ok(()) => remove_unused(&parent_folder(std::env::temp_dir())),
        Err(e) => tracing::debug!("leaving the folder of the socket: {e}"),
    }
}

/// Removes this user's folders in `parent` that no process uses. A folder that cannot be removed stays and does no harm.
fn remove_unused(parent: &Path) {
    let entries = fs::read_dir(parent).into_iter().flatten().flatten();
    for entry in entries.filter(|it| it.file_name().to_string_lossy().starts_with(PREFIX)) {
        let is_ours = |it: fs::Metadata| it.is_dir() && it.uid() == geteuid().as_raw();
        if entry.metadata().is_ok_and(is_ours) && is_free(&entry.path()) == Some(true) {
            let removed = fs::remove_dir_all(entry.path());
            tracing::debug!("removing {}: {removed:?}", entry.path().display());
        }
    }
}

/// Whether the lock of the folder at `path` is free; none if that is not known.
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

    fn folders(parent: &Path) -> usize {
        fs::read_dir(parent).unwrap().count()
    }

    #[test]
    fn a_folder_that_no_endpoint_can_name_is_not_used() {
        let here = std::env::current_dir().unwrap();
        let relative = parent_folder("a".into());
        assert!(relative == here.join("a") || relative == Path::new("/tmp"));
        for (folder, parent) in [("/tmp/a", "/tmp/a"), ("/tmp/a#b", "/tmp"), ("/a?", "/tmp")] {
            assert_eq!(parent_folder(folder.into()), Path::new(parent));
        }
    }

    #[test]
    fn unused_folders_are_swept_and_nothing_else() {
        let parent = tempfile::tempdir().unwrap();
        let rendezvous = Rendezvous::create_in(parent.path()).unwrap();
        let path = rendezvous.folder.path().display().to_string();
        let endpoint = format!("unixsock-stream/{path}/learner.sock");
        assert_eq!(rendezvous.endpoint("learner"), endpoint);
        let mode = fs::metadata(rendezvous.folder.path()).unwrap().mode();
        assert_eq!(mode & 0o777, 0o700);
        // Folders of other programs, by their name or content.
        fs::create_dir(parent.path().join("driml-run-other")).unwrap();
        fs::create_dir(parent.path().join("else")).unwrap();
        fs::write(parent.path().join("else").join(IN_USE), "").unwrap();
        remove_unused(parent.path());
        assert_eq!(folders(parent.path()), 3);

        // As after the launcher was killed, while a process still uses the folder.
        let process = rendezvous.lock_handle().unwrap();
        let Rendezvous { folder, lock } = rendezvous;
        let path = folder.keep();
        fs::write(path.join("learner.sock"), "").unwrap();
        drop(lock);
        remove_unused(parent.path());
        assert!(path.exists() && is_used(&path));
        drop(process);
        assert!(!is_used(&path));
        remove_unused(parent.path());
        assert!(!is_used(&path), "it is gone");
        assert!(!path.exists());
        assert_eq!(folders(parent.path()), 2);
    }
}
