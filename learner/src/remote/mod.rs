//! The learner as a process of a run: everything that knows zenoh stands here.
//! What is learned, and how, it does not know: `learner` does.

pub mod batch_source;
mod error;
mod fetcher;
mod publish;
pub mod run;
mod shards;

use std::sync::{Mutex, MutexGuard, PoisonError};

pub use error::BatchError;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
