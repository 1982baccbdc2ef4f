//! Files whose lock shows that something is in use. The lock ends with the last process that has the file open, however it ends.
//! These functions wait only for processes that are being started; for others the caller waits.

use std::{
    fs::{File, TryLockError},
    io,
    path::Path,
    thread,
    time::{Duration, Instant},
};

/// How long a process that another thread starts may keep the locks of this process: until its `exec` it has all files open.
const FORK_MAX: Duration = Duration::from_millis(200);

/// Creates `path` and locks it; returns `None` if another process holds the lock.
///
/// Some file systems of clusters have no locks. There the file counts as locked, and a warning that ends with `advice` is logged.
///
/// # Errors
/// The file cannot be created; the error names no path.
pub fn acquire(path: &Path, advice: &str) -> io::Result<Option<File>> {
    let (file, started) = (File::create(path)?, Instant::now());
    loop {
        match try_lock(&file) {
            Ok(true) => return Ok(Some(file)),
            Ok(false) if started.elapsed() >= FORK_MAX => return Ok(None),
            Ok(false) => thread::sleep(FORK_MAX / 20),
            Err(e) => {
                tracing::warn!("{} cannot be locked: {e}; {advice}", path.display());
                return Ok(Some(file));
            }
        }
    }
}

/// Locks `file`; returns `false` if another process holds the lock.
pub fn try_lock(file: &File) -> io::Result<bool> {
    match file.try_lock() {
        Ok(()) => Ok(true),
        Err(TryLockError::WouldBlock) => Ok(false),
        Err(TryLockError::Error(e)) => Err(e),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_locked_once_until_its_last_holder_lets_go() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(".lock");
        let lock = acquire(&path, "").unwrap().unwrap();
        assert!(acquire(&path, "").unwrap().is_none());
        assert!(!try_lock(&File::open(&path).unwrap()).unwrap());
        let copy = lock.try_clone().unwrap();
        drop(lock);
        assert!(acquire(&path, "").unwrap().is_none());
        let released = thread::spawn(|| {
            thread::sleep(FORK_MAX / 4);
            drop(copy);
        });
        assert!(acquire(&path, "").unwrap().is_some());
        released.join().unwrap();
        assert!(acquire(&folder.path().join("nowhere/.lock"), "").is_err());
    }
}
