//! How far a log has been read back, for those who ask meanwhile, and the word that it need not be read to its end.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Instant,
};

use driml_protocol::{RecoveryProgress, Shutdown};

/// How far the reading is; threads share it by reference.
#[derive(Debug)]
pub struct Reading {
    started: Instant,
    bytes: AtomicU64,
    bytes_read: AtomicU64,
    stop: Shutdown,
}

impl Reading {
    /// Nothing is read yet; once `stop` is raised, nothing more need be.
    pub fn begin(stop: Shutdown) -> Self {
        Self {
            started: Instant::now(),
            bytes: AtomicU64::new(0),
            bytes_read: AtomicU64::new(0),
            stop,
        }
    }

    /// The log has so many bytes.
    pub(super) fn set_bytes(&self, bytes: u64) {
        self.bytes.store(bytes, Ordering::Relaxed);
    }

    /// So many more of them have been read.
    pub(super) fn add_read(&self, bytes: u64) {
        self.bytes_read.fetch_add(bytes, Ordering::Relaxed);
    }

    /// Whether the rest need not be read.
    pub(super) fn is_stopped(&self) -> bool {
        self.stop.is_set()
    }

    /// How far it is now.
    pub fn progress(&self) -> RecoveryProgress {
        RecoveryProgress {
            bytes_read: self.bytes_read.load(Ordering::Relaxed),
            bytes: self.bytes.load(Ordering::Relaxed),
            since_s: self.started.elapsed().as_secs_f64(),
        }
    }
}
