//! The reply of a replay server to all queries while it reads its replay back from disk: its progress.
//! The message is sent as an error reply; the requester retries.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::wire::{error::CodecError, message::check_no_payload};

/// The progress of a replay server that reads its replay back from disk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RecoveryProgress {
    /// Bytes of the log that have been read.
    pub bytes_read: u64,
    /// Bytes of the whole log.
    pub bytes: u64,
    /// Seconds since the reading began.
    pub since_s: f64,
}

impl RecoveryProgress {
    /// Whether the reading takes so long that the user should be told.
    pub fn is_slow(&self) -> bool {
        self.since_s >= 1.0
    }
}

impl fmt::Display for RecoveryProgress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (read, all) = (self.bytes_read >> 20, self.bytes >> 20);
        write!(f, "{read} of {all} MiB after {:.0} s", self.since_s)
    }
}

/// The replay server cannot answer yet, because it is reading its replay back. The query had no effect.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, thiserror::Error)]
#[error("the replay server reads its replay back from disk, {progress}")]
pub struct Recovering {
    /// The progress of the reading.
    pub progress: RecoveryProgress,
    /// The run's resolved settings, TOML, from which a status shows which run this is.
    pub config_toml: String,
}

impl Recovering {
    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        let since_s = self.progress.since_s;
        let is_possible = since_s.is_finite() && since_s >= 0.0;
        let why = format_args!("the recovery began {since_s} s ago, which is not possible");
        CodecError::check(is_possible, why)?;
        check_no_payload(payload)
    }
}
