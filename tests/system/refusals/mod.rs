//! Input that a live run rejects, as tables of messages and expected replies: malformed messages, well-formed lies, messages that a role
//! may not send, wrong weights, and commands that connect to the wrong place. The codec's own tests check that no bytes make it panic; here
//! whole processes continue their work.

mod lies;
mod messages;
mod roles;
mod weights;
mod wrong_place;

use std::time::Duration;

use driml_protocol::{
    Ack, AffinityUpdate, BatchReply, BatchRequest, ChunkHeader, InsertReply, JoinReply, Keyed,
    Message, PROTOCOL_VERSION, RequestId, WeightsHeader, WeightsReply, WeightsUpload, codec,
    session::{self, SessionError},
};
use driml_tests::{Client, check_nothing_lost};
use zenoh::qos::Priority;

use crate::tiny_replay;

/// The expected result of a message that need not be answered.
const NO_REPLY: &str = "no answer";

/// How long to wait for a reply that must not come, and the time-out of one that must.
const NO_REPLY_WAIT: Duration = Duration::from_millis(700);
const REPLY_TIMEOUT: Duration = Duration::from_secs(20);

/// A message, and words that the reply must contain.
pub(crate) struct Row {
    key: String,
    bytes: Vec<u8>,
    expected: &'static str,
}

impl Row {
    pub(crate) fn new(
        key: impl Into<String>,
        bytes: impl Into<Vec<u8>>,
        expected: &'static str,
    ) -> Self {
        Self {
            key: key.into(),
            bytes: bytes.into(),
            expected,
        }
    }

    /// Returns a well-formed message of the client's run, at the key for its type.
    pub(crate) fn of<M: Keyed>(client: &Client, message: &M, expected: &'static str) -> Self {
        let actor = message.actor().unwrap_or_default();
        let key = client.keys.actor_key::<M>(actor);
        Self::new(key, encoded(client, message), expected)
    }
}

pub(crate) fn batch_request(learner: u64, rows: u32) -> BatchRequest {
    BatchRequest {
        learner,
        id: RequestId::first(7),
        rows,
        ..BatchRequest::default()
    }
}

/// Returns affinities of 0.5 for all pairs of actions.
fn affinity(learner: u64, version: u64, num_actions: u32) -> AffinityUpdate {
    AffinityUpdate {
        learner,
        version,
        matrix: vec![0.5; (num_actions * num_actions) as usize],
    }
}

/// Encodes weights of this version as a learner uploads them.
pub(crate) fn upload(spec_hash: u64, learner: u64, version: u64, safetensors: &[u8]) -> Vec<u8> {
    let weights = WeightsHeader::new(version, version, safetensors);
    let upload = WeightsUpload { learner, weights };
    codec::encode(spec_hash, &upload, safetensors).unwrap()
}

/// Returns the header of the first chunk of an actor: one stream of two steps.
fn chunk_header(client: &Client, actor: u32, incarnation: u64) -> ChunkHeader {
    ChunkHeader {
        incarnation,
        weights_version: 1,
        ..tiny_replay::header(&client.spec, actor, 1, 2)
    }
}

fn encoded(client: &Client, message: &impl Message) -> Vec<u8> {
    codec::encode(client.spec.hash(), message, &[]).unwrap()
}

/// Returns the same message with the next protocol version.
fn newer(mut bytes: Vec<u8>) -> Vec<u8> {
    bytes[4..6].copy_from_slice(&(PROTOCOL_VERSION + 1).to_le_bytes());
    bytes
}

/// Sends each row's message and checks the reply.
pub(crate) fn check_replies(client: &Client, rows: impl IntoIterator<Item = Row>) {
    for (i, row) in rows.into_iter().enumerate() {
        let (key, expected) = (row.key, row.expected);
        let wait_max = match expected {
            NO_REPLY => NO_REPLY_WAIT,
            _ => REPLY_TIMEOUT,
        };
        let bytes = row.bytes.into();
        let reply = match session::ask(&client.session, &key, bytes, Priority::Data, wait_max) {
            Ok(answer) => describe(&answer.to_bytes()),
            Err(e @ SessionError::Recovering(_)) => e.to_string(),
            Err(_) => NO_REPLY.to_owned(),
        };
        let is_right = reply.contains(expected);
        assert!(is_right, "{key}, row {i}: wanted {expected:?}, got {reply}");
    }
}

/// Sends each row's message and checks the reply, and that the replay server counts exactly `refused` more messages as refused.
fn check_refused(client: &Client, what: &str, rows: impl IntoIterator<Item = Row>, refused: u64) {
    let before = client.replay_status().unwrap().messages_refused;
    check_replies(client, rows);
    // A busy server may not have received the last message yet.
    let status = client.wait_for_replay(what, |replay| replay.messages_refused >= before + refused);
    assert_eq!(status.messages_refused - before, refused, "{what}");
}

/// Checks that the client's run continues and loses nothing.
fn check_continues(client: &Client) {
    let updates = client.learner_status().unwrap().updates;
    let transitions = client.replay_status().unwrap().transitions_inserted;
    client.wait_for_updates(updates + 20);
    let status = client.wait_for_transitions(transitions + 100);
    check_nothing_lost(&status);
    assert_eq!((status.actors, status.finished), (1, false));
    assert!(status.affinity_version < 1 << 20, "{status:#?}");
    let learner = client.learner_status().unwrap();
    assert!(learner.weights_version < 1 << 20, "{learner:#?}");
}

/// Returns a reply of any type as text.
fn describe(bytes: &[u8]) -> String {
    fn read<M: Message + std::fmt::Debug>(bytes: &[u8]) -> Option<String> {
        let (message, _) = codec::decode::<M>(bytes, None).ok()?;
        Some(format!("{message:?}"))
    }
    read::<InsertReply>(bytes)
        .or_else(|| read::<BatchReply>(bytes))
        .or_else(|| read::<JoinReply>(bytes))
        .or_else(|| read::<WeightsReply>(bytes))
        .or_else(|| read::<Ack>(bytes))
        .unwrap_or_else(|| "an answer of another kind".into())
}
