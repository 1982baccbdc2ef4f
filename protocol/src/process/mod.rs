//! Tools that every process of a run needs besides messages: shutdown, writing and locking files, and limits on logging.
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

/// Locks `mutex`, even if a thread panicked while holding it: that panic ends the process, so it is not handled here.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
