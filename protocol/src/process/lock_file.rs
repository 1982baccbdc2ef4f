//! Files whose lock shows that something is in use. The lock ends with the last process that has the file open, however it ends.
//! These functions wait only for processes that are being started; for others the caller waits.

use std::{
    fs::{File, TryLockError},
    io,
    path::Path,
    thread,
    time::Duration,
};

/// How often a held lock is tried again: a process that another thread starts keeps all locks of this process until its `exec`.
/// Tries are counted and not time, as time passes for a stopped process too.
const RETRIES_MAX: u32 = 20;
/// The pause after each try.
const RETRY_PERIOD: Duration = Duration::from_millis(10);

/// Creates `path` and locks it; returns `None` if another process holds the lock.
///
/// Some file systems of clusters have no locks. There the file counts as locked, and a warning that ends with `advice` is logged.
///
/// # Errors
/// The file cannot be created; the error names no path.
pub fn acquire(path: &Path, advice: &str) -> io::Result<Option<File>> {
    let file = File::create(path)?;
    for _ in 0..=RETRIES_MAX {
        match try_lock(&file) {
            Ok(true) => return Ok(Some(file)),
            Ok(false) => thread::sleep(RETRY_PERIOD),
            Err(e) => {
                tracing::warn!("{} cannot be locked: {e}; {advice}", path.display());
                return Ok(Some(file));
            }
        }
    }
    Ok(None)
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
            thread::sleep(2 * RETRY_PERIOD);
            drop(copy);
        });
        assert!(acquire(&path, "").unwrap().is_some());
        released.join().unwrap();
        assert!(acquire(&folder.path().join("nowhere/.lock"), "").is_err());
    }
}
