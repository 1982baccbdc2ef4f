//! An actor's end, with its own count of what it produced.
//! How long it is tried is the actor's business.

use serde::{Deserialize, Serialize};

use super::ack::Ack;
use crate::wire::message::{Keyed, Kind, Message, Request};

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

impl Message for Leave {
    const KIND: Kind = Kind::Leave;

    fn actor(&self) -> Option<u32> {
        Some(self.actor)
    }
}

impl Keyed for Leave {
    const KEY: &'static str = "leave";
    const BY_ACTOR: bool = true;
}

impl Request for Leave {
    type Reply = Ack;
}
