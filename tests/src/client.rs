//! A zenoh client of a run, like any process of the run: sends requests, and any message that a test needs.
//! The client stores nothing, and has a role in the run only if a test joins it as an actor or the learner.

use std::{net::UdpSocket, sync::Arc, time::Duration};

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, InsertReply, Keyed, Keys, LearnerJoin, LearnerStatus,
    ReplayStatus, RunClient, RunSpec, Shutdown, codec,
    config::Settings,
    join,
    session::{self, Connection, Endpoints, MESSAGE_BYTES_MAX, SessionError},
    tls::Credentials,
};
use zenoh::{Session, Wait, qos::Priority};

use crate::waiting::wait_for;

/// The default prefix of a run's keys.
pub(crate) const NAMESPACE: &str = "driml";
const REPLY_TIMEOUT: Duration = Duration::from_secs(20);

/// An open session, and the run's settings as the replay server sent them.
#[derive(Debug)]
pub struct Client {
    /// The zenoh session, for any other use in a test.
    pub session: Session,
    /// The run's keys.
    pub keys: Keys,
    /// The run spec, on which all processes of the run agree.
    pub spec: RunSpec,
    /// The run's resolved settings.
    pub config_toml: String,
}

/// Opens a session with the process that listens at an endpoint, without retries.
pub fn connect(endpoint: &str) -> Session {
    session::open(&Endpoints::connect_to(vec![endpoint.to_owned()])).unwrap()
}

/// Opens a session that listens at an endpoint, in place of a replay server.
pub fn listen(endpoint: &str) -> Session {
    session::open(&Endpoints {
        listen: vec![endpoint.to_owned()],
        connect: Vec::new(),
    })
    .unwrap()
}

/// Returns an unused QUIC endpoint on this machine.
pub fn quic_endpoint() -> String {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    format!("quic/{}", socket.local_addr().unwrap())
}

/// Returns the join message of a learner that has made no update yet.
pub fn new_learner(learner: u64) -> LearnerJoin {
    LearnerJoin {
        learner,
        run: learner,
        ..LearnerJoin::default()
    }
}

/// Checks that no transition was lost or stored twice.
#[track_caller]
pub fn check_nothing_lost(replay: &ReplayStatus) {
    let wrong = (replay.transitions_lost, replay.transitions_duplicated);
    assert_eq!(wrong, (0, 0), "{replay:#?}");
}

impl Client {
    /// Connects to the run at an endpoint once its replay server answers.
    pub(crate) fn join(endpoint: &str, credentials: Option<Credentials>) -> Self {
        let connection = Connection {
            endpoints: Endpoints::connect_to(vec![endpoint.to_owned()]),
            keys: Keys::new(NAMESPACE).unwrap(),
            credentials: credentials.map(Arc::new),
        };
        // One attempt waits for some seconds; on a busy machine a process may need longer to start listening.
        let session = wait_for(&format!("a process that listens on {endpoint}"), || {
            connection.open(MESSAGE_BYTES_MAX).ok()
        });
        let keys = connection.keys;
        let run_info = join::fetch_run_info(&session, &keys, &Shutdown::default())
            .unwrap()
            .expect("this client is not told to stop");
        let settings = Settings::parse(&run_info.config_toml).unwrap();
        Self {
            session,
            keys,
            spec: settings.table("run").unwrap(),
            config_toml: run_info.config_toml,
        }
    }

    /// Sends a request and returns the bytes of the reply.
    ///
    /// # Errors
    /// No process answered.
    pub fn request(&self, key: &str, payload: Vec<u8>) -> Result<Vec<u8>, SessionError> {
        let (payload, priority) = (payload.into(), Priority::Data);
        let reply = session::ask(&self.session, key, payload, priority, REPLY_TIMEOUT)?;
        Ok(reply.to_bytes().into_owned())
    }

    /// Returns the session, the keys and the spec's hash, as a process of the run holds them.
    pub fn run_client(&self) -> RunClient {
        RunClient::new(self.session.clone(), self.keys.clone(), self.spec.hash())
    }

    /// Requests the replay server's status; `None` if the server does not answer.
    pub fn replay_status(&self) -> Option<ReplayStatus> {
        self.fetch_status()
    }

    /// Requests the learner's status; `None` if no learner answers.
    pub fn learner_status(&self) -> Option<LearnerStatus> {
        self.fetch_status()
    }

    fn fetch_status<M: Keyed>(&self) -> Option<M> {
        match self.run_client().fetch(REPLY_TIMEOUT) {
            Err(e @ SessionError::Unreadable { .. }) => panic!("{e}"),
            fetched => fetched.ok(),
        }
    }

    /// Waits until the replay server's status satisfies `wanted`, and returns the status.
    pub fn wait_for_replay(
        &self,
        what: &str,
        wanted: impl Fn(&ReplayStatus) -> bool,
    ) -> ReplayStatus {
        wait_for(what, || self.replay_status().filter(&wanted))
    }

    /// Waits until the replay server has stored more than `transitions` transitions.
    pub fn wait_for_transitions(&self, transitions: u64) -> ReplayStatus {
        let what = format!("more than {transitions} transitions");
        self.wait_for_replay(&what, |replay| replay.transitions_inserted > transitions)
    }

    /// Waits until the learner's status satisfies `wanted`, and returns the status.
    pub fn wait_for_learner(
        &self,
        what: &str,
        wanted: impl Fn(&LearnerStatus) -> bool,
    ) -> LearnerStatus {
        wait_for(what, || self.learner_status().filter(&wanted))
    }

    /// Waits until the learner has made more than `updates` updates.
    pub fn wait_for_updates(&self, updates: u64) -> LearnerStatus {
        let what = format!("more than {updates} updates");
        self.wait_for_learner(&what, |learner| learner.updates > updates)
    }

    /// Waits until the learner has made its last update, and returns its status.
    pub fn wait_for_the_last_update(&self) -> LearnerStatus {
        self.wait_for_learner("the learner's last update", |learner| learner.finished)
    }

    /// Requests the replay server's status, checks it with [`check_nothing_lost`], and returns it.
    #[track_caller]
    pub fn check_nothing_lost(&self) -> ReplayStatus {
        let replay = self.replay_status().unwrap();
        check_nothing_lost(&replay);
        replay
    }

    /// Joins the run as an actor whose chunks carry this `incarnation`.
    pub fn join_as_actor(&self, actor: u32, incarnation: u64) {
        let join = ActorJoin { actor, incarnation };
        let never = Shutdown::default();
        join::join(&self.run_client(), &join, &never).unwrap();
    }

    /// Joins the run as a learner that has made no update yet.
    pub fn join_as_learner(&self, learner: u64) {
        let never = Shutdown::default();
        join::join(&self.run_client(), &new_learner(learner), &never).unwrap();
    }

    /// Encodes a chunk as a process of the run would send it.
    pub fn encode_chunk(&self, chunk: &Chunk) -> Vec<u8> {
        codec::encode(self.spec.hash(), &chunk.header, chunk.payload()).unwrap()
    }

    /// Sends a chunk as an actor would, and returns the reply.
    pub fn insert(&self, chunk: &Chunk) -> InsertReply {
        let key = self.keys.actor_key::<ChunkHeader>(chunk.header.actor);
        let reply = self.request(&key, self.encode_chunk(chunk));
        let reply = reply.expect("chunks are always answered");
        codec::decode(&reply, Some(self.spec.hash())).unwrap().0
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        // The process at the other end may have exited already, which is not a fault of the test.
        let _ = self.session.close().wait();
    }
}
