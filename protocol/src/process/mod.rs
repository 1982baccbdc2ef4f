//! Tools that every process of a run needs besides messages: threads, shutdown, writing and locking files, and limits on logging.
//! They send nothing.

pub(crate) mod activity;
pub mod atomic_write;
pub mod fail_point;
pub mod last_warning;
pub mod lock_file;
pub(crate) mod log_limiter;
pub(crate) mod shutdown;
pub(crate) mod silence;
pub(crate) mod termination;

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, JoinHandle};

/// Locks `mutex`, even if a thread panicked while holding it: that panic ends the process, so it is not handled here.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Starts a thread of this name, with which a panic in it is reported.
pub fn spawn<T: Send + 'static>(
    name: impl Into<String>,
    work: impl FnOnce() -> T + Send + 'static,
) -> std::io::Result<JoinHandle<T>> {
    Builder::new().name(name.into()).spawn(work)
}
