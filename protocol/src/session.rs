//! Opening a zenoh session that suits large, acknowledged messages, and the two ways to talk over it.
//! It does not scout, gossip or mesh: one part listens, the others connect and redial.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};
use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    handlers::FifoChannelHandler,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, Query, QueryTarget, Reply},
};

use crate::{
    messages::recovering::Recovering,
    process::shutdown::Shutdown,
    reach::{self, Unreachable},
    tls::{self, Credentials, Role, TlsError},
    wire::{codec, error::CodecError, keys::Keys},
};

/// How a process reaches the others.
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
    /// Nothing accepts connections where the session was to connect.
    #[error(transparent)]
    Unreachable(#[from] Unreachable),
    /// Something listens that does not speak this protocol.
    #[error(
        "something listens on {} that is not driml ({what}): is the endpoint right? If it is, its process may be suspended",
        .connect.join(", ")
    )]
    NotDriml {
        /// Endpoints to connect to.
        connect: Vec<String>,
        /// What it says, or that it says nothing.
        what: String,
    },
    /// No replay server lets this process in over QUIC. Whether none listens or one side rejects the other's certificate is known to
    /// zenoh alone, whose log has it on the side that rejects.
    #[error(
        "no replay server lets this process in on {}: is it running, with --tls-dir, and is the endpoint right (its port is one of UDP)? If \
         so, one side rejects the other's certificate: `driml doctor --tls-dir` on both machines and the replay server's log say why",
        .connect.join(", ")
    )]
    NotLetIn {
        /// Endpoints to connect to.
        connect: Vec<String>,
    },
    /// A certificate is not good.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// No process answers at this key.
    #[error("{key}: no process answers there")]
    NoAnswerer {
        /// Where it was asked.
        key: String,
    },
    /// No answer in time.
    #[error("{key}: no answer within {within_ms} ms")]
    NoReply {
        /// Where it was asked.
        key: String,
        /// How long the reply was waited for.
        within_ms: u128,
    },
    /// The replay server is reading its replay back from disk, and will answer then. It is there: this may be waited for as long as it
    /// takes.
    #[error("{0}")]
    Recovering(Recovering),
    /// A request that is larger than a message may be.
    #[error("{key}: {why}")]
    TooLarge {
        /// Where it was to be asked.
        key: String,
        /// Which limit it is over.
        why: CodecError,
    },
    /// A reply that is damaged, foreign or of another kind.
    #[error("{key}: {why}")]
    Unreadable {
        /// Where it was asked.
        key: String,
        /// What is wrong with it.
        why: CodecError,
    },
    /// zenoh could not send, or the other side replied with an error.
    #[error("{key}: {why}")]
    Zenoh {
        /// Where it was asked.
        key: String,
        /// What zenoh said.
        why: String,
    },
}

/// What zenoh replies where a process does not.
const TIMED_OUT: &str = "Timeout";
/// What zenoh says where no endpoint could be connected to.
const NOTHING_LISTENS: &str = "Unable to connect to any of";

/// How long one message may take to go out before its link is given up: below every time-out of a question, so that a peer that
/// was frozen or vanished is gone before others miss an answer. It comes back, and asks again, once it is well. A message must
/// be small enough for this: 3 MB need 3 Mbit/s.
const STALLED_MAX: Duration = Duration::from_secs(8);
/// How long a client tries to connect.
const CONNECT_MAX: Duration = Duration::from_secs(10);
/// How long a first try may take to find that those who listen understand; then it is looked who they are.
const UNDERSTOOD_MAX: Duration = Duration::from_millis(2500);
/// Longest message accepted from a peer, bytes, while a process does not know its run's sizes yet.
pub const MESSAGE_BYTES_MAX: usize = 1 << 29;
/// The same for a process that only receives settings, status and pieces of weights.
pub const SMALL_MESSAGE_BYTES_MAX: usize = 1 << 22;

/// Opens a session. A process that listens is the run's router; one that only connects is a client.
///
/// # Errors
/// An endpoint that cannot be listened on; a client with nothing listening on its endpoint after ten seconds.
pub fn open(endpoints: &Endpoints) -> Result<Session, SessionError> {
    open_with(endpoints, MESSAGE_BYTES_MAX, &[])
}

/// As [`open`], with certificates where there are any: then endpoints are `quic/HOST:PORT` or unix sockets, and a replay server
/// gives each role of the run with these keys what it needs and no more. Messages of more than `message_bytes_max` bytes, which no
/// peer of this run sends, are dropped while they come in.
///
/// # Errors
/// As [`open`]; one side rejects the other's certificate.
pub fn open_as(
    endpoints: &Endpoints,
    keys: &Keys,
    credentials: Option<&Credentials>,
    message_bytes_max: usize,
) -> Result<Session, SessionError> {
    let Some(credentials) = credentials else {
        return open_with(endpoints, message_bytes_max, &[]);
    };
    credentials.warn_if_it_expires_soon();
    let mut settings = vec![
        ("transport/link/tls", credentials.zenoh_settings()),
        (
            "transport/link/protocols",
            "[\"quic\", \"unixsock-stream\"]".into(),
        ),
    ];
    if credentials.role() == Role::ReplayServer {
        settings.push(("access_control", tls::rules(keys)));
    }
    open_with(endpoints, message_bytes_max, &settings)
}

/// [`open_as`] of a process that has to wait for its replay server; `None` if it is told to stop before.
///
/// # Errors
/// As [`open_as`].
pub fn open_unless(
    shutdown: &Shutdown,
    endpoints: Endpoints,
    keys: &Keys,
    credentials: Option<&Arc<Credentials>>,
    message_bytes_max: usize,
) -> Result<Option<Session>, SessionError> {
    let (keys, credentials) = (keys.clone(), credentials.cloned());
    let Endpoints { listen, connect } = endpoints.clone();
    let open = move || open_as(&endpoints, &keys, credentials.as_deref(), message_bytes_max);
    match shutdown.unless_set("connecting", open) {
        Ok(opened) => opened.transpose(),
        Err(e) => Err(SessionError::Open {
            listen,
            connect,
            why: format!("starting a thread: {e}"),
        }),
    }
}

/// Whether an endpoint is reached over QUIC, with certificates.
pub fn is_quic(endpoint: &str) -> bool {
    endpoint.starts_with("quic/")
}

fn open_with(
    endpoints: &Endpoints,
    message_bytes_max: usize,
    more: &[(&str, String)],
) -> Result<Session, SessionError> {
    let fail = |why: String| SessionError::Open {
        listen: endpoints.listen.clone(),
        connect: endpoints.connect.clone(),
        // zenoh adds where in its own sources it failed.
        why: why.split(" at /").next().unwrap_or_default().to_owned(),
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
    let max = message_bytes_max.to_string();
    let stalled_us = STALLED_MAX.as_micros().to_string();
    let settings: &[(&str, &str)] = &[
        ("mode", if router { "\"router\"" } else { "\"client\"" }),
        ("listen/endpoints", &list(&endpoints.listen)),
        ("connect/endpoints", &list(&endpoints.connect)),
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
        // Long enough for a machine that is busy with much else: a process that got no processor for a while is not gone. One
        // that died is known at once, as its connection closes; over QUIC, which has no system to close it, after this long.
        ("transport/link/tx/lease", "30000"),
        ("transport/link/tx/queue/size/data", "16"),
        (
            "transport/link/tx/queue/congestion_control/block/wait_before_close",
            &stalled_us,
        ),
        ("transport/link/rx/max_message_size", &max),
        ("transport/link/rx/buffer_size", "4194304"),
        // Only what a process itself puts into shared memory goes through it.
        (
            "transport/shared_memory/transport_optimization/enabled",
            "false",
        ),
    ];
    let open_within = |shared_memory: &str, connect_ms: &str| {
        let mut config = zenoh::Config::default();
        let more = more.iter().map(|(key, value)| (*key, value.as_str()));
        let last = [
            ("connect/timeout_ms", connect_ms),
            ("transport/shared_memory/enabled", shared_memory),
        ];
        for (key, value) in settings.iter().copied().chain(more).chain(last) {
            config
                .insert_json5(key, value)
                .map_err(|e| format!("{key} = {value}: {e}"))?;
        }
        zenoh::open(config).wait().map_err(|e| e.to_string())
    };
    let open = |connect_ms: &str| {
        open_within("true", connect_ms).or_else(|why| {
            // Without shared memory nothing would listen either.
            if why.contains(NOTHING_LISTENS) {
                return Err(why);
            }
            tracing::debug!("trying again without shared memory: {why}");
            open_within("false", connect_ms)
        })
    };
    if router {
        return open("-1").map_err(fail);
    }
    reach::wait_for_any(&endpoints.connect, CONNECT_MAX)?;
    let connect = || endpoints.connect.clone();
    let not_driml = |what: String| match endpoints.connect.iter().any(|it| is_quic(it)) {
        true => SessionError::NotLetIn { connect: connect() },
        false => SessionError::NotDriml {
            connect: connect(),
            what,
        },
    };
    let milliseconds = |it: Duration| it.as_millis().to_string();
    let why = match open(&milliseconds(UNDERSTOOD_MAX)) {
        Err(why) if why.contains(NOTHING_LISTENS) => why,
        opened => return opened.map_err(fail),
    };
    // A process of the run may be slow on a busy machine, and then sends nothing; a foreign server may introduce itself.
    let mut listening = endpoints.connect.iter();
    if let Some(words) = listening.find_map(|it| reach::what_listens(it)) {
        return Err(not_driml(format!("it says {words:?}")));
    }
    tracing::debug!("trying again: {why}");
    open(&milliseconds(CONNECT_MAX.saturating_sub(UNDERSTOOD_MAX))).map_err(|why| {
        match why.contains(NOTHING_LISTENS) {
            true => not_driml("it says nothing that could be understood".into()),
            false => fail(why),
        }
    })
}

/// Removes the shared memory of processes that ended without doing so, as killed ones do; that of living ones stays. For the
/// launcher and for processes started by hand: many processes that start at once need not all look.
pub fn sweep_shared_memory() {
    zenoh::shm::cleanup_orphaned_shm_segments();
}

/// The bytes of a reply that is to come.
#[derive(Debug)]
pub struct PendingBytes {
    key: String,
    timeout: Duration,
    replies: FifoChannelHandler<Reply>,
    /// Why the replies so far are no answer.
    failed: Option<SessionError>,
}

/// Sends one question; questions of one priority arrive in the order in which they were sent.
///
/// # Errors
/// zenoh refused. It may be tried again.
pub fn send(
    session: &Session,
    key: &str,
    payload: ZBytes,
    priority: Priority,
    timeout: Duration,
) -> Result<PendingBytes, SessionError> {
    let replies = session
        .get(key)
        .payload(payload)
        // Foreign processes that answer, too: with one target zenoh might choose one of them.
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Block)
        .priority(priority)
        .timeout(timeout)
        .wait()
        .map_err(|e| SessionError::Zenoh {
            key: key.into(),
            why: e.to_string(),
        })?;
    Ok(PendingBytes {
        key: key.into(),
        timeout,
        replies,
        failed: None,
    })
}

impl PendingBytes {
    /// Waits for the one answer.
    ///
    /// # Errors
    /// No process answers (at once), no answer in time, or the answerer's error. All may be tried again.
    pub fn wait(mut self) -> Result<ZBytes, SessionError> {
        self.wait_for(|bytes| Ok(bytes.clone()))
    }

    /// Waits for the one answer that `read` takes. Without certificates foreign processes may answer, too.
    pub(crate) fn wait_for<T>(
        &mut self,
        read: impl Fn(&ZBytes) -> Result<T, CodecError>,
    ) -> Result<T, SessionError> {
        loop {
            let reply = self.replies.recv().ok();
            if let Some(answer) = self.read(reply, &read)? {
                return Ok(answer);
            }
        }
    }

    /// [`PendingBytes::wait_for`] at most for `wait_max`; `None` if it has not come by then.
    pub(crate) fn wait_for_within<T>(
        &mut self,
        wait_max: Duration,
        read: impl Fn(&ZBytes) -> Result<T, CodecError>,
    ) -> Result<Option<T>, SessionError> {
        let deadline = Instant::now() + wait_max;
        loop {
            let reply = match self.replies.recv_deadline(deadline) {
                Ok(None) => return Ok(None),
                Ok(reply) => reply,
                Err(_) => None,
            };
            if let Some(answer) = self.read(reply, &read)? {
                return Ok(Some(answer));
            }
        }
    }

    /// What `read` takes of a reply; `None` if there may be another. `reply` is none if there is not.
    fn read<T>(
        &mut self,
        reply: Option<Reply>,
        read: impl Fn(&ZBytes) -> Result<T, CodecError>,
    ) -> Result<Option<T>, SessionError> {
        let key = || self.key.clone();
        let Some(reply) = reply else {
            let none = || SessionError::NoAnswerer { key: key() };
            return Err(self.failed.take().unwrap_or_else(none));
        };
        let failed = match reply.into_result() {
            Ok(sample) => match read(sample.payload()) {
                Ok(answer) => return Ok(Some(answer)),
                Err(why) => SessionError::Unreadable { key: key(), why },
            },
            Err(e) => {
                if let Ok((recovering, _)) = codec::decode(&e.payload().to_bytes(), None) {
                    return Err(SessionError::Recovering(recovering));
                }
                let why = e.payload().try_to_string().unwrap_or_default().into_owned();
                match why.as_str() {
                    TIMED_OUT => SessionError::NoReply {
                        key: key(),
                        within_ms: self.timeout.as_millis(),
                    },
                    _ => SessionError::Zenoh { key: key(), why },
                }
            }
        };
        self.failed = Some(failed);
        Ok(None)
    }
}

/// Asks one question and waits for its one answer: [`send`] and [`PendingBytes::wait`].
///
/// # Errors
/// As [`send`] and [`PendingBytes::wait`].
pub fn ask(
    session: &Session,
    key: &str,
    payload: ZBytes,
    priority: Priority,
    timeout: Duration,
) -> Result<ZBytes, SessionError> {
    send(session, key, payload, priority, timeout)?.wait()
}

/// Answers a question with `payload`; an asker that has gone away is logged and forgotten.
pub fn answer(query: &Query, payload: ZBytes) {
    if let Err(e) = query.reply(query.key_expr().clone(), payload).wait() {
        tracing::debug!("{}: the asker is gone: {e}", query.key_expr());
    }
}

/// Answers a question that cannot be dealt with now by an error, `payload`; its asker asks again.
pub(crate) fn put_off(query: &Query, payload: ZBytes) {
    if let Err(e) = query.reply_err(payload).wait() {
        tracing::debug!("{}: the asker is gone: {e}", query.key_expr());
    }
}
