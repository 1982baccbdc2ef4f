//! Opens a zenoh session for large, acknowledged messages, over which processes ask and answer.
//! Sessions do not scout, gossip or mesh: one process listens, and the others connect and reconnect.

mod requests;

use std::{sync::Arc, time::Duration};

use serde_json::json;
use zenoh::{Session, Wait};

pub use requests::{PendingReply, SessionError, answer, ask};
pub(crate) use requests::{reply_error, send};

use crate::{
    process::shutdown::Shutdown,
    reach,
    tls::{self, Credentials, Role},
    wire::keys::Keys,
};

/// The endpoints by which a process reaches the others.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoints {
    /// Endpoints to listen on, such as `tcp/127.0.0.1:7447` or `unixsock-stream//tmp/driml.sock`.
    pub listen: Vec<String>,
    /// Endpoints to connect to, and to reconnect to whenever the link breaks.
    pub connect: Vec<String>,
}

/// The part of zenoh's error message that says that it could connect to no endpoint.
const NO_LISTENER_TEXT: &str = "Unable to connect to any of";

/// How long sending one message may take before its link is closed. This is less than the 10 s time-outs of chunks, batches and weights, so
/// a frozen or vanished peer loses its link before others time out. Once the peer recovers, it reconnects and retries. A message must be
/// small enough: 3 MB need 3 Mbit/s.
const SEND_TIMEOUT: Duration = Duration::from_secs(8);
/// How long a client waits for a listener. A replay server first waits for shared memory while other processes allocate theirs.
const LISTENER_WAIT_MAX: Duration = Duration::from_secs(30);
const CONNECT_MAX: Duration = Duration::from_secs(10);
/// How long the first attempt to connect may take. After it, the client checks whether a foreign server listens.
const FIRST_CONNECT_MAX: Duration = Duration::from_millis(2500);
/// Longest message accepted from a peer, bytes, before a process knows the sizes of its run.
pub const MESSAGE_BYTES_MAX: usize = 1 << 29;
/// Longest message accepted by a process that only receives settings, status and pieces of weights, bytes.
pub const SMALL_MESSAGE_BYTES_MAX: usize = 1 << 22;

/// Opens a session. A process that listens is the run's router; one that only connects is a client.
///
/// # Errors
/// An endpoint cannot be listened on, or nothing listens at a client's endpoints within half a minute.
pub fn open(endpoints: &Endpoints) -> Result<Session, SessionError> {
    open_with_settings(endpoints, MESSAGE_BYTES_MAX, &[])
}

/// How a process reaches the others of its run.
#[derive(Clone, Debug)]
pub struct Connection {
    /// The endpoints of the session.
    pub endpoints: Endpoints,
    /// The keys of the run's messages.
    pub keys: Keys,
    /// The certificate and the key of this process; `None` without TLS.
    pub credentials: Option<Arc<Credentials>>,
}

impl Connection {
    /// Like [`open`], with the credentials if there are any: endpoints are then `quic/HOST:PORT` or unix sockets, and a replay server grants
    /// each role of the run only the keys that it needs. Messages of more than `message_bytes_max` bytes, which no peer of this run sends,
    /// are dropped on arrival.
    pub fn open(&self, message_bytes_max: usize) -> Result<Session, SessionError> {
        let Some(credentials) = &self.credentials else {
            return open_with_settings(&self.endpoints, message_bytes_max, &[]);
        };
        let mut settings = vec![
            ("transport/link/tls", credentials.zenoh_settings()),
            (
                "transport/link/protocols",
                "[\"quic\", \"unixsock-stream\"]".into(),
            ),
        ];
        if credentials.role == Role::ReplayServer {
            settings.push(("access_control", tls::access_rules(&self.keys)));
        }
        open_with_settings(&self.endpoints, message_bytes_max, &settings)
    }

    /// Like [`Self::open`], for a process that waits for its replay server; returns `None` if `shutdown` is set first.
    pub fn open_unless(
        &self,
        shutdown: &Shutdown,
        message_bytes_max: usize,
    ) -> Result<Option<Session>, SessionError> {
        let this = self.clone();
        let open = move || this.open(message_bytes_max);
        let opened = shutdown.run_unless_set("connecting", open, || false);
        let failed = |e| format!("starting a thread: {e}");
        let opened = opened.map_err(|e| self.endpoints.open_error(&failed(e)));
        opened?.transpose()
    }

    /// The same connection, to this endpoint alone.
    pub fn to_endpoint(&self, endpoint: &str) -> Self {
        Self {
            endpoints: Endpoints::connect_to(vec![endpoint.to_owned()]),
            ..self.clone()
        }
    }
}

impl Endpoints {
    /// Creates endpoints to connect to, and none to listen on.
    pub fn connect_to(connect: Vec<String>) -> Self {
        let listen = Vec::new();
        Self { listen, connect }
    }

    fn open_error(&self, why: &str) -> SessionError {
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

fn open_with_settings(
    endpoints: &Endpoints,
    message_bytes_max: usize,
    more: &[(&str, String)],
) -> Result<Session, SessionError> {
    // zenoh appends the place in its sources where it failed; this cuts it off.
    let fail = |why: String| endpoints.open_error(why.split(" at /").next().unwrap_or_default());
    let router = !endpoints.listen.is_empty();
    let max = message_bytes_max.to_string();
    let send_timeout_us = SEND_TIMEOUT.as_micros().to_string();
    let settings: &[(&str, &str)] = &[
        ("mode", if router { "\"router\"" } else { "\"client\"" }),
        ("listen/endpoints", &json!(endpoints.listen).to_string()),
        ("connect/endpoints", &json!(endpoints.connect).to_string()),
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
        // Long enough for a busy machine, on which a live process may get no processor for a while. The death of a process closes its
        // connections at once; only over QUIC, where the system closes nothing, does detection take this long.
        ("transport/link/tx/lease", "30000"),
        ("transport/link/tx/queue/size/data", "16"),
        (
            "transport/link/tx/queue/congestion_control/block/wait_before_close",
            &send_timeout_us,
        ),
        ("transport/link/rx/max_message_size", &max),
        ("transport/link/rx/buffer_size", "4194304"),
        // Only messages that a process itself puts into shared memory go through it.
        (
            "transport/shared_memory/transport_optimization/enabled",
            "false",
        ),
    ];
    let open_once = |shared_memory: &str, connect_ms: &str| {
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
        open_once("true", connect_ms).or_else(|why| {
            // Without shared memory, there would still be no listener.
            if why.contains(NO_LISTENER_TEXT) {
                return Err(why);
            }
            tracing::debug!("retrying without shared memory: {why}");
            open_once("false", connect_ms)
        })
    };
    if router {
        return open("-1").map_err(fail);
    }
    reach::wait_for_any(&endpoints.connect, LISTENER_WAIT_MAX)?;
    let foreign_server_error = |what: &str| {
        let connect = endpoints.connect.join(", ");
        SessionError::Failed(match endpoints.connect.iter().any(|it| is_quic(it)) {
            // zenoh does not tell a missing listener from a rejected certificate; its log on the rejecting side does.
            true => format!(
                "no replay server accepts this process at {connect}: is it running, with --tls-dir, and is the endpoint right (its port is \
                 one of UDP)? If so, one side rejects the other's certificate: `driml doctor --tls-dir` on both machines and the replay \
                 server's log say why{}",
                endpoints
                    .connect
                    .iter()
                    .find_map(|it| reach::ipv6_hint(it))
                    .unwrap_or_default()
            ),
            false => format!(
                "something listens on {connect} that is not driml ({what}): is the endpoint right? If it is, its process may be suspended"
            ),
        })
    };
    let milliseconds = |it: Duration| it.as_millis().to_string();
    let why = match open(&milliseconds(FIRST_CONNECT_MAX)) {
        Err(why) if why.contains(NO_LISTENER_TEXT) => why,
        opened => return opened.map_err(fail),
    };
    // A process of the run that is slow on a busy machine sends nothing; a foreign server may introduce itself.
    let mut listening = endpoints.connect.iter();
    if let Some(words) = listening.find_map(|it| reach::read_greeting(it)) {
        return Err(foreign_server_error(&format!("it sent {words:?}")));
    }
    tracing::debug!("retrying: {why}");
    open(&milliseconds(CONNECT_MAX.saturating_sub(FIRST_CONNECT_MAX))).map_err(|why| {
        match why.contains(NO_LISTENER_TEXT) {
            true => foreign_server_error("it sent nothing that driml can read"),
            false => fail(why),
        }
    })
}

/// Removes the shared memory of processes that ended without doing so, such as killed ones, and keeps that of running processes. The
/// launcher and processes started by hand call this, so that not each of many processes scans for it at once.
pub fn remove_orphaned_shared_memory() {
    zenoh::shm::cleanup_orphaned_shm_segments();
}
