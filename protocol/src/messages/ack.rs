//! The answer that says no more than that a message was understood.

use serde::{Deserialize, Serialize};

use crate::wire::message::{Kind, Message};

/// "Understood".
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ack;

impl Message for Ack {
    const KIND: Kind = Kind::Ack;
}
