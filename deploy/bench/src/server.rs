//! A replay server in its own process, with real clients over the real wire.
//! The clients are the actor's delivery and the learner's batch source, so the bench measures the code that runs in production.

use std::{
    hint::black_box,
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use driml_actor::{ActorSettings, Delivery, DeliveryLimits};
use driml_launch::{endpoint::DEFAULT_NAMESPACE, managed_process::ManagedProcess};
use driml_learner::{
    LearnerConfig,
    remote::batch_source::{BatchSource, Counters, NextBatch, Requests},
};
use driml_machine::speed_meter::SpeedMeter;
use driml_protocol::{
    ActorJoin, JoinReply, Keys, LearnerJoin, Peer, Request, RunClient, Shutdown, join,
    session::{Connection, Endpoints, MESSAGE_BYTES_MAX},
    tls::{Credentials, Role},
};
use zenoh::{Session, Wait, liveliness::LivelinessToken};

use crate::{
    recording::{ChunkShape, INCARNATION, Recording},
    settings, subprocess,
};

const LEARNER: u64 = 1;
/// The time-out of a batch, of an insert and of the server's exit.
const ANSWER_MAX: Duration = Duration::from_secs(30);

pub(super) const TLS_DIR: &str = "--tls-dir";
pub(super) const REPLAY_DIR: &str = "--replay-dir";

/// The settings of a server, and how clients reach it.
#[derive(Clone, Debug)]
pub(super) struct Wire {
    pub(super) name: &'static str,
    pub(super) endpoint: String,
    pub(super) shared_memory: bool,
    /// The capacity of the server's replay, in transitions.
    pub(super) capacity: u64,
    /// The flag for a folder of the server, and the folder: certificates of all roles, or a replay on disk.
    pub(super) folder: Option<(&'static str, String)>,
}

pub(super) struct Server {
    process: ManagedProcess,
    pub(super) wire: Wire,
    keys: Keys,
    /// Without TLS the first session serves all roles. With TLS it is the observer's, and each role has its own.
    sessions: Vec<Session>,
    actor: ActorSettings,
    learner: LearnerConfig,
    /// The number of actors so far; each delivery is another actor.
    actors: u32,
}

impl Server {
    /// Starts a server with its log in `folder`, and waits until it answers.
    pub(super) fn start(wire: &Wire, folder: &Path) -> anyhow::Result<Self> {
        let shared_memory = format!("transport.shared_memory={}", wire.shared_memory);
        let held = format!("replay.capacity_transitions={}", wire.capacity);
        let sets = [&settings::REPLAY_SETS[..], &[&*shared_memory, &*held]].concat();
        let mut args = vec!["replay-server", "--keep-alive"];
        if let Some((flag, dir)) = &wire.folder {
            args.extend([*flag, dir]);
        }
        let process = subprocess::start("replay-server", &args, &wire.endpoint, &sets, folder)?;
        let keys = Keys::new(DEFAULT_NAMESPACE).map_err(anyhow::Error::msg)?;
        let session = wire.open(&keys, Role::Observer)?;
        let run_info = join::fetch_run_info(&session, &keys, &Shutdown::default())?
            .context("this client was not told to stop")?;
        Ok(Self {
            process,
            wire: wire.clone(),
            keys,
            sessions: vec![session],
            actor: ActorSettings::from_toml(&run_info.config_toml)?,
            learner: LearnerConfig::from_toml(&run_info.config_toml)?,
            actors: 0,
        })
    }

    /// Delivers chunks until `is_enough` holds for the transitions sent and the start time. Returns the transitions stored per second, from
    /// the making of the first chunk to the acknowledgement of the last.
    pub(super) fn deliver(
        &mut self,
        recording: &Recording,
        shape: ChunkShape,
        is_enough: impl Fn(u64, Instant) -> bool,
    ) -> anyhow::Result<f64> {
        self.actors += 1;
        let (actor, pool) = (self.actors, self.actor.chunk_buffers());
        let join = ActorJoin::new(actor, INCARNATION);
        let who = Peer::actor(actor, INCARNATION);
        let (client, alive) = self.join_run(Role::Actor(actor), who, &join)?;
        let limits = DeliveryLimits::from_config(&self.actor.actor);
        let delivery = Delivery::start(client, join, 0, limits, pool.clone(), Shutdown::default())?;
        let mut next_chunk = recording.chunks(actor, shape, pool);
        let (mut sent, started) = (0, Instant::now());
        while !is_enough(sent, started) {
            sent += u64::from(shape.transitions());
            if !delivery.send(next_chunk()) {
                break;
            }
        }
        let unwanted = delivery.finish(false)?;
        drop(alive);
        let seconds = started.elapsed().as_secs_f64();
        ensure!(
            unwanted == 0,
            "transitions that the replay server did not store: {unwanted}"
        );
        Ok(sent as f64 / seconds)
    }

    /// Measures batches per second, each read as a learner would.
    pub(super) fn fetch(&mut self, meter: &SpeedMeter) -> anyhow::Result<f64> {
        let shutdown = Shutdown::default();
        // A learner that has made no update.
        let join = LearnerJoin {
            learner: LEARNER,
            run: LEARNER,
            ..LearnerJoin::default()
        };
        let (client, _alive) = self.join_run(Role::Learner, Peer::learner(LEARNER), &join)?;
        let (learner, transport) = (&self.learner.learner, &self.learner.transport);
        let requests = Requests {
            learner_id: LEARNER,
            rows: learner.batch_size,
            in_flight: learner.batches_in_flight,
            shared_memory: transport.shared_memory,
            unreachable_max: ANSWER_MAX,
        };
        let clients = std::slice::from_ref(&client);
        let mut source = BatchSource::start(clients, requests, &Counters::at_start(1), &shutdown)?;
        let rate = meter.rate_overall(|| match source.next(ANSWER_MAX)? {
            NextBatch::Ready(served) => {
                // Read one byte of each cache line, so that all states have arrived.
                let batch = &served.batch;
                for plane in [batch.states_t(), batch.states_k(), batch.states_n()] {
                    let bytes = plane.iter().step_by(64);
                    black_box(bytes.map(|&byte| u64::from(byte)).sum::<u64>());
                }
                Ok(())
            }
            NextBatch::NotYet(waiting) => {
                bail!("no batch came within {} s: {waiting}", ANSWER_MAX.as_secs())
            }
            NextBatch::Finished => bail!("the replay server reports that the run is over"),
        });
        // A request in flight must get its reply before the session is closed.
        shutdown.set();
        while matches!(source.next(ANSWER_MAX)?, NextBatch::Ready(_)) {}
        rate
    }

    /// Returns a client that joins the run with `join`, and counts as connected until the token is dropped.
    fn join_run(
        &mut self,
        role: Role,
        who: Peer,
        join: &impl Request<Reply = JoinReply>,
    ) -> anyhow::Result<(RunClient, LivelinessToken)> {
        let mut session = self.sessions[0].clone();
        if matches!(self.wire.folder, Some((TLS_DIR, _))) {
            session = self.wire.open(&self.keys, role)?;
            self.sessions.push(session.clone());
        }
        let client = RunClient::new(session, self.keys.clone(), self.actor.spec.hash());
        let alive = client.declare_alive(who);
        let alive = alive.map_err(|e| anyhow::anyhow!("declaring a client alive: {e}"))?;
        join::join(&client, join, &Shutdown::default())?
            .context("this client was not told to stop")?;
        Ok((client, alive))
    }

    /// Ends the server by `stop` and waits until it exits. Another server can use the returned wire.
    pub(super) fn shut_down(mut self, stop: fn(&mut ManagedProcess)) -> Wire {
        for session in &self.sessions {
            if let Err(e) = session.close().wait() {
                tracing::debug!("closing a session: {e}");
            }
        }
        stop(&mut self.process);
        let deadline = Instant::now() + ANSWER_MAX;
        self.process.wait_until(deadline, || false);
        self.wire
    }
}

impl Wire {
    /// Opens a session in a role, with the role's certificate if the server uses TLS.
    fn open(&self, keys: &Keys, role: Role) -> anyhow::Result<Session> {
        let credentials = match &self.folder {
            Some((TLS_DIR, dir)) => Some(Credentials::read(Path::new(dir), role)?.into()),
            _ => None,
        };
        let connection = Connection {
            endpoints: Endpoints::connect_to(vec![self.endpoint.clone()]),
            keys: keys.clone(),
            credentials,
        };
        Ok(connection.open(MESSAGE_BYTES_MAX)?)
    }
}
