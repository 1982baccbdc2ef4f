//! The traits that make a type a message: its number on the wire, its key, and the check of its payload.
//! `messages::table` lists all messages.

use serde::{Serialize, de::DeserializeOwned};
use zenoh::qos::Priority;

use super::error::CodecError;

/// A message, which bincode encodes as the header. In a few messages, a payload of raw bytes follows the header.
pub trait Message: Clone + Serialize + DeserializeOwned {
    /// The message's number on the wire.
    const KIND: u16;
    /// The message's name in logs.
    const NAME: &'static str;

    /// Checks what the type cannot guarantee, such as the length of the payload that the header gives. The receiver calls this for every
    /// message. By default, no payload may follow the header.
    fn validate(&self, payload: &[u8]) -> Result<(), CodecError> {
        check_no_payload(payload)
    }

    /// The actor that the message names as its sender, if it names one.
    fn actor(&self) -> Option<u32> {
        None
    }
}

/// A message with a key at which it is queried, fetched or published. Replies have no key.
pub trait Keyed: Message {
    /// The message's key under the run's namespace.
    const KEY: &'static str;
    /// Whether each actor has its own key for the message, `KEY/<number>`, and the learner `KEY/learner`. Access control can then check
    /// senders by key, without reading messages; the receiver checks that key and message agree.
    const KEY_PER_ACTOR: bool = false;
    /// The message's priority over others on the same link.
    const PRIORITY: Priority = Priority::Data;
}

/// A message that asks for a reply.
pub trait Request: Keyed {
    /// The type of the reply.
    type Reply: Message;
}

pub(crate) fn check_no_payload(payload: &[u8]) -> Result<(), CodecError> {
    let bytes = payload.len();
    let why = format_args!("{bytes} bytes of payload follow a message that has none");
    CodecError::check(bytes == 0, why)
}
