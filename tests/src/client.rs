//! A client of a run over zenoh, as any process is one: asks, and sends whatever a test wants.
//! It takes no part in the run and keeps nothing.

use std::{net::UdpSocket, time::Duration};

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, InsertReply, Keyed, Keys, LearnerJoin, LearnerStatus,
    ReplayStatus, RunClient, RunSpec, Shutdown, codec,
    config::Settings,
    join,
    session::{self, Endpoints, SessionError},
    tls::Credentials,
};
use zenoh::{Session, Wait, qos::Priority};

use crate::waiting::wait_for;

/// The prefix of a run's keys unless a process is told otherwise.
pub(crate) const NAMESPACE: &str = "driml";
const ANSWER_MAX: Duration = Duration::from_secs(20);

/// An open session and what the replay server said of its run.
#[derive(Debug)]
pub struct Client {
    /// The session, for whatever else a test wants to do with it.
    pub session: Session,
    /// The run's keys.
    pub keys: Keys,
    /// What all processes of the run agree on.
    pub spec: RunSpec,
    /// The run's resolved settings.
    pub config_toml: String,
}

/// A session with the process that listens at an endpoint, in one try.
pub fn connect(endpoint: &str) -> Session {
    session::open(&Endpoints::to(vec![endpoint.to_owned()])).unwrap()
}

/// A session that listens at an endpoint, in the place of a replay server.
pub fn listen(endpoint: &str) -> Session {
    session::open(&Endpoints {
        listen: vec![endpoint.to_owned()],
        connect: Vec::new(),
    })
    .unwrap()
}

/// An unused endpoint of this machine for QUIC.
pub fn quic_endpoint() -> String {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    format!("quic/{}", socket.local_addr().unwrap())
}

/// How a learner joins that has learned nothing yet.
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
    /// A client of the run at an endpoint, once its replay server answers.
    pub(crate) fn join(endpoint: &str, credentials: Option<&Credentials>) -> Self {
        let endpoints = Endpoints::to(vec![endpoint.to_owned()]);
        let keys = Keys::new(NAMESPACE).unwrap();
        let bytes_max = session::MESSAGE_BYTES_MAX;
        // One try waits for seconds by itself; on a busy machine a process may need longer to listen.
        let session = wait_for(&format!("a process that listens on {endpoint}"), || {
            session::open_as(&endpoints, &keys, credentials, bytes_max).ok()
        });
        let run_info = join::run_info(&session, &keys, &Shutdown::default())
            .unwrap()
            .expect("this client is not told to stop");
        let spec = Settings::parse(&run_info.config_toml)
            .unwrap()
            .table("run")
            .unwrap();
        Self {
            session,
            keys,
            spec,
            config_toml: run_info.config_toml,
        }
    }

    /// Sends bytes and gives the bytes of the answer.
    ///
    /// # Errors
    /// No process answered.
    pub fn ask(&self, key: &str, payload: Vec<u8>) -> Result<Vec<u8>, SessionError> {
        session::ask(
            &self.session,
            key,
            payload.into(),
            Priority::Data,
            ANSWER_MAX,
        )
        .map(|answer| answer.to_bytes().into_owned())
    }

    /// The session, keys and hash, as the processes of the run have them.
    pub fn run(&self) -> RunClient {
        RunClient::new(self.session.clone(), self.keys.clone(), self.spec.hash())
    }

    /// The replay server's status; none if it did not answer.
    pub fn replay(&self) -> Option<ReplayStatus> {
        self.fetch()
    }

    /// The learner's status; none if it is not there.
    pub fn learner(&self) -> Option<LearnerStatus> {
        self.fetch()
    }

    fn fetch<M: Keyed>(&self) -> Option<M> {
        match self.run().fetch(ANSWER_MAX) {
            Err(e @ SessionError::Unreadable { .. }) => panic!("{e}"),
            fetched => fetched.ok(),
        }
    }

    /// Waits until the replay server's status is as wanted, and gives it.
    pub fn wait_for_replay(
        &self,
        what: &str,
        wanted: impl Fn(&ReplayStatus) -> bool,
    ) -> ReplayStatus {
        wait_for(what, || self.replay().filter(&wanted))
    }

    /// Waits until the replay server has stored more than so many transitions.
    pub fn wait_for_transitions(&self, transitions: u64) -> ReplayStatus {
        let what = format!("more than {transitions} transitions");
        self.wait_for_replay(&what, |replay| replay.transitions_inserted > transitions)
    }

    /// Waits until the learner's status is as wanted, and gives it.
    pub fn wait_for_learner(
        &self,
        what: &str,
        wanted: impl Fn(&LearnerStatus) -> bool,
    ) -> LearnerStatus {
        wait_for(what, || self.learner().filter(&wanted))
    }

    /// Waits until the learner has made more than so many updates.
    pub fn wait_for_updates(&self, updates: u64) -> LearnerStatus {
        let what = format!("more than {updates} updates");
        self.wait_for_learner(&what, |learner| learner.updates > updates)
    }

    /// Waits until the learner has made its last update, and gives its status.
    pub fn wait_for_the_last_update(&self) -> LearnerStatus {
        self.wait_for_learner("the learner's last update", |learner| learner.finished)
    }

    /// The replay server's status, of which [`check_nothing_lost`] holds.
    #[track_caller]
    pub fn check_nothing_lost(&self) -> ReplayStatus {
        let replay = self.replay().unwrap();
        check_nothing_lost(&replay);
        replay
    }

    /// Takes part as an actor; its chunks are of this `incarnation`.
    pub fn join_as_actor(&self, actor: u32, incarnation: u64) {
        let join = ActorJoin { actor, incarnation };
        let never = Shutdown::default();
        join::take_part(&self.run(), &join, &never).unwrap();
    }

    /// Takes part as the learner, which has learned nothing yet.
    pub fn join_as_learner(&self, learner: u64) {
        let never = Shutdown::default();
        join::take_part(&self.run(), &new_learner(learner), &never).unwrap();
    }

    /// A chunk's bytes as a process of the run would send them.
    pub fn seal(&self, chunk: &Chunk) -> Vec<u8> {
        codec::encode(self.spec.hash(), &chunk.header, chunk.payload()).unwrap()
    }

    /// Sends a chunk as an actor would.
    pub fn insert(&self, chunk: &Chunk) -> InsertReply {
        let key = self.keys.of_actor::<ChunkHeader>(chunk.header.actor);
        let reply = self.ask(&key, self.seal(chunk));
        let reply = reply.expect("chunks are always answered");
        codec::decode(&reply, Some(self.spec.hash())).unwrap().0
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        // Its router may be gone already, which is not the test's fault.
        let _ = self.session.close().wait();
    }
}
