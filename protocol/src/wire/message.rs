//! What makes a type a message: its number on the wire, and what it promises of the payload behind it.
//! Which messages there are is in `messages`, one file each.

use serde::{Serialize, de::DeserializeOwned};
use zenoh::qos::Priority;

use super::error::CodecError;

/// A message: the header that bincode writes. A few have a payload, raw bytes that follow the header.
pub trait Message: Serialize + DeserializeOwned {
    /// Its number on the wire.
    const KIND: Kind;

    /// Checks what the type alone does not promise, such as that the payload is as long as the header says. Called for every
    /// message that is received; unless it is overridden, no payload may follow the header.
    ///
    /// # Errors
    /// What is wrong with it.
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

/// The numbers of all messages, so that none is given twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Kind {
    /// Transitions, actor to replay server.
    Chunk = 1,
    /// The answer to a chunk.
    InsertReply = 2,
    /// A request for a batch, learner to replay server.
    BatchRequest = 3,
    /// A batch, or why there is none yet.
    BatchReply = 4,
    /// The action-affinity matrix, learner to replay server.
    Affinity = 5,
    /// A piece of the newest weights, replay server to actors.
    Weights = 6,
    /// "Newer weights exist", replay server to actors.
    WeightsVersion = 7,
    /// An actor's last word.
    Leave = 8,
    /// The replay server's account of itself.
    ReplayStatus = 9,
    /// The learner's account of itself.
    LearnerStatus = 10,
    /// What a joining process needs to know.
    RunInfo = 11,
    /// "Understood"; carries nothing.
    Ack = 12,
    /// An actor that starts.
    ActorJoin = 13,
    /// A learner that starts.
    LearnerJoin = 14,
    /// The answer to a process that starts.
    JoinReply = 15,
    /// What became of a chunk, actor to replay server.
    ChunkPoll = 16,
    /// New weights, learner to replay server.
    WeightsUpload = 17,
    /// A request for a piece of the newest weights, actor to replay server.
    WeightsRequest = 18,
    /// The state of an actor or the learner, to the replay server.
    Report = 19,
    /// The replay server's account of who takes part.
    ProcessesStatus = 20,
    /// Priorities of the rows of a batch, learner to replay server.
    Priorities = 21,
    /// A request for the episodes that ended.
    EpisodesRequest = 22,
    /// Episodes that ended.
    EpisodesReply = 23,
    /// "Not yet: the replay is being read back from disk", replay server in answer to any query.
    Recovering = 24,
}
