//! An actor's end, with its own count of what it produced.
//! How long it is tried is the actor's business.

use serde::{Deserialize, Serialize};

/// An actor's last word: its own count of what it produced, against which the replay server checks its count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Leave {
    /// The actor's number in the run.
    pub actor: u32,
    /// Which life of it.
    pub incarnation: u64,
    /// Transitions produced, less those that the replay server answered with `Finished` or `Refused`.
    pub produced: u64,
}
