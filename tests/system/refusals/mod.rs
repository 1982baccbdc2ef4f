//! What a live run refuses, as tables of what is sent and what comes of it: malformed messages, well-formed lies, what a role may not
//! send, wrong weights, and commands that connect to the wrong place.
//! That no bytes make the codec panic is its own test; here whole processes continue their work.

mod lies;
mod messages;
mod roles;
mod weights;
mod wrong_place;

use std::time::Duration;

use driml_protocol::{
    BatchReply, Done, InsertReply, JoinReply, Message, PROTOCOL_VERSION, WeightsReply, codec,
    session,
};
use driml_tests::Client;
use zenoh::qos::Priority;

/// What comes of a message to whose sender nothing is promised.
const SILENCE: &str = "no answer";

/// How long an answer is waited for that does not come, and one that does.
const NO_ANSWER: Duration = Duration::from_millis(700);
const ANSWER_MAX: Duration = Duration::from_secs(20);

/// A message, and words of the answer to it.
struct Row {
    key: String,
    bytes: Vec<u8>,
    expected: &'static str,
}

impl Row {
    fn new(key: impl Into<String>, bytes: impl Into<Vec<u8>>, expected: &'static str) -> Self {
        Self {
            key: key.into(),
            bytes: bytes.into(),
            expected,
        }
    }

    /// A well-formed message of the client's run.
    fn of(
        client: &Client,
        key: impl Into<String>,
        message: &impl Message,
        expected: &'static str,
    ) -> Self {
        Self::new(key, sealed(client, message), expected)
    }
}

fn sealed(client: &Client, message: &impl Message) -> Vec<u8> {
    codec::encode(client.spec.hash(), message, &[]).unwrap()
}

/// The same message of a version to come.
fn newer(mut bytes: Vec<u8>) -> Vec<u8> {
    bytes[4..6].copy_from_slice(&(PROTOCOL_VERSION + 1).to_le_bytes());
    bytes
}

/// Sends each row's message and checks the answer.
fn send(client: &Client, rows: impl IntoIterator<Item = Row>) {
    for (i, row) in rows.into_iter().enumerate() {
        let Row {
            key,
            bytes,
            expected,
        } = row;
        let wait_max = match expected {
            SILENCE => NO_ANSWER,
            _ => ANSWER_MAX,
        };
        let bytes = bytes.into();
        let said = match session::ask(&client.session, &key, bytes, Priority::Data, wait_max) {
            Ok(answer) => in_words(&answer.to_bytes()),
            Err(_) => SILENCE.to_owned(),
        };
        assert!(
            said.contains(expected),
            "{key}, row {i}: wanted {expected:?}, got {said}"
        );
    }
}

/// An answer of any kind.
fn in_words(bytes: &[u8]) -> String {
    fn read<M: Message + std::fmt::Debug>(bytes: &[u8]) -> Option<String> {
        let (message, _) = codec::decode::<M>(bytes, None).ok()?;
        Some(format!("{message:?}"))
    }
    read::<InsertReply>(bytes)
        .or_else(|| read::<BatchReply>(bytes))
        .or_else(|| read::<JoinReply>(bytes))
        .or_else(|| read::<WeightsReply>(bytes))
        .or_else(|| read::<Done>(bytes))
        .unwrap_or_else(|| "an answer of another kind".into())
}
