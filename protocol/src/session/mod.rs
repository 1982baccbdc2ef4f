//! Opening a zenoh session that suits large, acknowledged messages, and the two ways to talk over it.
//! It does not scout, gossip or mesh: one process listens, the others connect and redial.

mod questions;

use std::{sync::Arc, time::Duration};

use zenoh::{Session, Wait};

pub(crate) use questions::{PendingBytes, put_off, send};
pub use questions::{SessionError, answer, ask};

use crate::{
    process::shutdown::Shutdown,
    reach,
    tls::{self, Credentials, Role},
    wire::keys::Keys,
};

/// How a process reaches the others.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoints {
    /// Endpoints to listen on, such as `tcp/127.0.0.1:7447` or `unixsock-stream//tmp/driml.sock`.
    pub listen: Vec<String>,
    /// Endpoints to connect to, and to redial whenever the link breaks.
    pub connect: Vec<String>,
}

/// What zenoh says where no endpoint could be connected to.
const NOTHING_LISTENS: &str = "Unable to connect to any of";

/// How long one message may take to go out before its link is given up: below every time-out of a question, so that a peer that
/// was frozen or vanished is gone before others miss an answer. It comes back, and asks again, once it is well. A message must
/// be small enough for this: 3 MB need 3 Mbit/s.
const STALLED_MAX: Duration = Duration::from_secs(8);
/// How long something may take to listen: a replay server waits for shared memory first, while others take theirs.
const START_MAX: Duration = Duration::from_secs(30);
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
/// An endpoint that cannot be listened on; a client with nothing listening on its endpoint after half a minute.
pub fn open(endpoints: &Endpoints) -> Result<Session, SessionError> {
    open_with(endpoints, MESSAGE_BYTES_MAX, &[])
}

/// As [`open`], with certificates where there are any: then endpoints are `quic/HOST:PORT` or unix sockets, and a replay server
/// gives each role of the run with these keys what it needs and no more. Messages of more than `message_bytes_max` bytes, which no
/// peer of this run sends, are dropped while they come in.
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
    if credentials.role == Role::ReplayServer {
        settings.push(("access_control", tls::rules(keys)));
    }
    open_with(endpoints, message_bytes_max, &settings)
}

/// [`open_as`] of a process that has to wait for its replay server; `None` if it is told to stop before.
pub fn open_unless(
    shutdown: &Shutdown,
    endpoints: Endpoints,
    keys: &Keys,
    credentials: Option<&Arc<Credentials>>,
    message_bytes_max: usize,
) -> Result<Option<Session>, SessionError> {
    let (keys, credentials) = (keys.clone(), credentials.cloned());
    let failed = endpoints.clone();
    let open = move || open_as(&endpoints, &keys, credentials.as_deref(), message_bytes_max);
    match shutdown.unless_set("connecting", open) {
        Ok(opened) => opened.transpose(),
        Err(e) => Err(failed.not_opened(&format!("starting a thread: {e}"))),
    }
}

impl Endpoints {
    /// Only to connect.
    pub fn to(connect: Vec<String>) -> Self {
        let listen = Vec::new();
        Self { listen, connect }
    }

    fn not_opened(&self, why: &str) -> SessionError {
        let Self { listen, connect } = self;
        SessionError::Failed(format!(
            "opening a zenoh session (listen {listen:?}, connect {connect:?}): {why}"
        ))
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
    // zenoh adds where in its own sources it failed.
    let fail = |why: String| endpoints.not_opened(why.split(" at /").next().unwrap_or_default());
    let router = !endpoints.listen.is_empty();
    let max = message_bytes_max.to_string();
    let stalled_us = STALLED_MAX.as_micros().to_string();
    let settings: &[(&str, &str)] = &[
        ("mode", if router { "\"router\"" } else { "\"client\"" }),
        ("listen/endpoints", &format!("{:?}", endpoints.listen)),
        ("connect/endpoints", &format!("{:?}", endpoints.connect)),
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
    reach::wait_for_any(&endpoints.connect, START_MAX)?;
    let not_driml = |what: &str| {
        let connect = endpoints.connect.join(", ");
        SessionError::Failed(match endpoints.connect.iter().any(|it| is_quic(it)) {
            // Whether none listens or one side rejects the other's certificate is known to zenoh alone, whose log has it on the side
            // that rejects.
            true => format!(
                "no replay server lets this process in on {connect}: is it running, with --tls-dir, and is the endpoint right (its port is \
                 one of UDP)? If so, one side rejects the other's certificate: `driml doctor --tls-dir` on both machines and the replay \
                 server's log say why"
            ),
            false => format!(
                "something listens on {connect} that is not driml ({what}): is the endpoint right? If it is, its process may be suspended"
            ),
        })
    };
    let milliseconds = |it: Duration| it.as_millis().to_string();
    let why = match open(&milliseconds(UNDERSTOOD_MAX)) {
        Err(why) if why.contains(NOTHING_LISTENS) => why,
        opened => return opened.map_err(fail),
    };
    // A process of the run may be slow on a busy machine, and then sends nothing; a foreign server may introduce itself.
    let mut listening = endpoints.connect.iter();
    if let Some(words) = listening.find_map(|it| reach::what_listens(it)) {
        return Err(not_driml(&format!("it says {words:?}")));
    }
    tracing::debug!("trying again: {why}");
    open(&milliseconds(CONNECT_MAX.saturating_sub(UNDERSTOOD_MAX))).map_err(|why| {
        match why.contains(NOTHING_LISTENS) {
            true => not_driml("it says nothing that could be understood"),
            false => fail(why),
        }
    })
}

/// Removes the shared memory of processes that ended without doing so, as killed ones do; that of living ones stays. For the
/// launcher and for processes started by hand: many processes that start at once need not all look.
pub fn sweep_shared_memory() {
    zenoh::shm::cleanup_orphaned_shm_segments();
}
