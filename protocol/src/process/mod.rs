//! What every process of a run needs beside messages: when to end, how to write and lock a file, how seldom to log.
//! It sends nothing.

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

/// Locks `mutex`, also if a thread panicked while it held it: that panic ends the process, so nothing is done about it here.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
