//! Opening a zenoh session that suits large, acknowledged messages, and the two ways to talk over it.
//! It does not scout, gossip or mesh: one part listens, the others connect and redial.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::{CodecError, Hello, Keys, Kind, Shutdown, codec};
use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, Query, QueryTarget},
};

/// How a part reaches the others.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Endpoints {
    /// Endpoints to listen on, such as `tcp/127.0.0.1:7447` or `unixsock-stream//tmp/driml.sock`.
    pub listen: Vec<String>,
    /// Endpoints to connect to, and to redial whenever the link breaks.
    pub connect: Vec<String>,
}

/// Why a message could not be exchanged.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The session could not be opened.
    #[error("opening a zenoh session (listen {listen:?}, connect {connect:?}): {why}")]
    Open {
        /// Endpoints to listen on.
        listen: Vec<String>,
        /// Endpoints to connect to.
        connect: Vec<String>,
        /// What zenoh said.
        why: String,
    },
    /// Nobody answered.
    #[error("{key}: nobody answered within {within_ms} ms")]
    NoReply {
        /// Where it was asked.
        key: String,
        /// How long.
        within_ms: u128,
    },
    /// zenoh failed.
    #[error("{key}: {why}")]
    Zenoh {
        /// Where.
        key: String,
        /// What zenoh said.
        why: String,
    },
}

/// Why a part could not join a run.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// Nobody there.
    #[error("no replay server answered within {} s: is it running, and is the endpoint right? ({last})", JOIN_MAX.as_secs())]
    Nobody {
        /// The last try's error.
        last: SessionError,
    },
    /// An answer that cannot be read.
    #[error("the replay server's greeting: {0}")]
    Codec(#[from] CodecError),
}

/// How long a joining part waits for a replay server.
const JOIN_MAX: Duration = Duration::from_secs(60);
/// One try of that.
const JOIN_TRY: Duration = Duration::from_secs(2);

/// Longest message accepted from a peer, bytes.
const MESSAGE_BYTES_MAX: usize = 1 << 29;

/// Opens a session. A part that listens is the run's router; one that only connects is a client.
///
/// # Errors
/// An endpoint that cannot be listened on; a client whose endpoint nobody listens on after ten seconds.
pub fn open(endpoints: &Endpoints) -> Result<Session, SessionError> {
    let fail = |why: String| SessionError::Open {
        listen: endpoints.listen.clone(),
        connect: endpoints.connect.clone(),
        why,
    };
    let list = |list: &[String]| -> String {
        format!(
            "[{}]",
            list.iter()
                .map(|e| format!("{e:?}"))
                .collect::<Vec<_>>()
                .join(", ")
        )
    };
    let router = !endpoints.listen.is_empty();
    let max = MESSAGE_BYTES_MAX.to_string();
    let settings: &[(&str, &str)] = &[
        ("mode", if router { "\"router\"" } else { "\"client\"" }),
        ("listen/endpoints", &list(&endpoints.listen)),
        ("connect/endpoints", &list(&endpoints.connect)),
        ("connect/timeout_ms", if router { "-1" } else { "10000" }),
        (
            "connect/exit_on_failure",
            if router { "false" } else { "true" },
        ),
        (
            "connect/retry",
            "{ period_init_ms: 50, period_max_ms: 1000, period_increase_factor: 2 }",
        ),
        ("scouting/delay", "20"),
        ("scouting/multicast/enabled", "false"),
        ("scouting/gossip/enabled", "false"),
        ("transport/unicast/open_timeout", "2000"),
        ("transport/unicast/accept_timeout", "5000"),
        ("transport/link/tx/queue/size/data", "16"),
        (
            "transport/link/tx/queue/congestion_control/block/wait_before_close",
            "3600000000",
        ),
        ("transport/link/rx/max_message_size", &max),
        ("transport/link/rx/buffer_size", "4194304"),
        ("transport/shared_memory/enabled", "false"),
    ];
    let mut config = zenoh::Config::default();
    for (key, value) in settings {
        config
            .insert_json5(key, value)
            .map_err(|e| fail(format!("{key} = {value}: {e}")))?;
    }
    zenoh::open(config).wait().map_err(|e| fail(e.to_string()))
}

/// A payload of several pieces, joined without a copy.
pub fn join_pieces(pieces: impl IntoIterator<Item = Vec<u8>>) -> ZBytes {
    let mut writer = ZBytes::writer();
    for piece in pieces {
        writer.append(ZBytes::from(piece));
    }
    writer.finish()
}

/// Asks one question and waits for its one answer.
///
/// # Errors
/// Nobody there (at once), no answer in time, or the answerer's own error. All may be tried again.
pub fn ask(
    session: &Session,
    key: &str,
    payload: ZBytes,
    priority: Priority,
    timeout: Duration,
) -> Result<Vec<u8>, SessionError> {
    let failed = |why: String| SessionError::Zenoh {
        key: key.into(),
        why,
    };
    let replies = session
        .get(key)
        .payload(payload)
        .target(QueryTarget::BestMatching)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Block)
        .priority(priority)
        .timeout(timeout)
        .wait()
        .map_err(|e| failed(e.to_string()))?;
    let silent = || SessionError::NoReply {
        key: key.into(),
        within_ms: timeout.as_millis(),
    };
    let reply = replies.recv().map_err(|_| silent())?;
    match reply.into_result() {
        Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
        Err(e) => Err(failed(
            e.payload().try_to_string().unwrap_or_default().into_owned(),
        )),
    }
}

/// Answers a question with `payload`; an asker that has gone away is logged and forgotten.
pub fn answer(query: &Query, payload: ZBytes) {
    if let Err(e) = query.reply(query.key_expr().clone(), payload).wait() {
        tracing::debug!("{}: the asker is gone: {e}", query.key_expr());
    }
}

/// Asks the replay server for the run's settings, waiting for it if it is not there yet; `None` if told to stop before.
///
/// # Errors
/// Nobody there within a minute, or another protocol version.
pub fn join(
    session: &Session,
    keys: &Keys,
    shutdown: &Shutdown,
) -> Result<Option<Hello>, JoinError> {
    let started = Instant::now();
    loop {
        match ask(
            session,
            &keys.hello(),
            ZBytes::new(),
            Priority::Data,
            JOIN_TRY,
        ) {
            Ok(bytes) => return Ok(Some(codec::decode(&bytes, Kind::Hello, None)?.0)),
            Err(last) if started.elapsed() > JOIN_MAX => return Err(JoinError::Nobody { last }),
            Err(e) => tracing::debug!("no replay server yet: {e}"),
        }
        if shutdown.wait_timeout(Duration::from_millis(200)) {
            return Ok(None);
        }
    }
}
