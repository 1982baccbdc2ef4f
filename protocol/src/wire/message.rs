//! What makes a type a message: its number on the wire, and what it promises of the payload behind it.
//! Which messages there are is in `messages::table`.

use serde::{Serialize, de::DeserializeOwned};
use zenoh::qos::Priority;

use super::error::CodecError;

/// A message: the header that bincode writes. A few have a payload, raw bytes that follow the header.
pub trait Message: Clone + Serialize + DeserializeOwned {
    /// Its number on the wire.
    const KIND: u16;
    /// Its name in logs.
    const NAME: &'static str;

    /// Checks what the type alone does not promise, such as that the payload is as long as the header says. Called for every
    /// message that is received; unless it is overridden, no payload may follow the header.
    fn validate(&self, payload: &[u8]) -> Result<(), CodecError> {
        no_payload(payload)
    }

    /// The actor that it speaks for, if it is one actor's word.
    fn actor(&self) -> Option<u32> {
        None
    }
}

/// A message with a key at which it is queried, fetched or published. Replies have none, they travel back.
pub trait Keyed: Message {
    /// Its key under the run's namespace.
    const KEY: &'static str;
    /// Whether each actor has its own key for it, `KEY/<number>`. Then access control can check senders by their keys, without reading
    /// messages; the receiver checks that key and message agree. The learner's key is `KEY/learner`.
    const BY_ACTOR: bool = false;
    /// How urgent it is beside other messages on the same link.
    const PRIORITY: Priority = Priority::Data;
}

/// A message that asks for a reply.
pub trait Request: Keyed {
    /// What it is answered with.
    type Reply: Message;
}

pub(crate) fn no_payload(payload: &[u8]) -> Result<(), CodecError> {
    match payload.len() {
        0 => Ok(()),
        bytes => Err(CodecError::Header(format!(
            "{bytes} bytes of payload follow a message that has none"
        ))),
    }
}
