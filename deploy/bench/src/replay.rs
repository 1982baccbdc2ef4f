//! A real replay server, in a process of its own, with real clients over the real wire; and its core without the wire.
//! The clients are the actor's delivery and the learner's batch source, so what is measured is what runs in production.

use std::{
    hint::black_box,
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use driml_actor::{ActorSettings, Delivery, DeliveryLimits};
use driml_launch::{
    console::Screen,
    endpoint::NAMESPACE,
    managed_process::{ManagedProcess, Surroundings},
};
use driml_learner::{
    LearnerConfig,
    remote::batch_source::{BatchSource, Next, Requests},
};
use driml_protocol::{
    BufferPool, Keys, RunClient, Shutdown, join,
    session::{self, Endpoints},
};
use zenoh::{Session, Wait};

use crate::{
    assemble, effort::Effort, measurements::Measurement, recording::Recording, settings,
    taking_part,
};

/// Transitions of a chunk: streams and steps of each. An actor of 16 copies sends the last size.
pub(super) const CHUNKS: [(u32, u32); 4] = [(4, 1), (8, 4), (8, 16), (8, 32)];
/// How long the server may take to listen, and a batch or an insert to come.
pub(super) const ANSWER_MAX: Duration = Duration::from_secs(30);

/// Transitions stored a second and batches a second, over each wire; batches without a wire, and a plain copy.
///
/// # Errors
/// An engine that cannot be had, a server that does not answer.
pub(super) fn measure(effort: &Effort) -> anyhow::Result<Vec<Measurement>> {
    let recording = Recording::play()?;
    let mut figures = Vec::new();
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    let socket = folder.path().join("s").display().to_string();
    let wires = [
        ("shared memory", format!("unixsock-stream/{socket}"), true),
        ("unix socket", format!("unixsock-stream/{socket}"), false),
        ("tcp", format!("tcp/{}", free_port()?), false),
    ];
    for (wire, endpoint, shared_memory) in wires {
        let mut run = Run::start(&endpoint, shared_memory, folder.path(), &[])?;
        run.deliver(&recording, CHUNKS[3], |sent, _| sent >= settings::CAPACITY)?;
        for chunk in CHUNKS {
            let transitions = chunk.0 * chunk.1;
            let rate = run.deliver(&recording, chunk, |_, started| effort.is_spent(started))?;
            let name = format!("insert, {transitions} transitions a chunk, {wire}");
            figures.push(Measurement::found(name, rate, "transitions/s"));
        }
        let (rate, name) = (run.fetch(effort)?, format!("batch of 3 states, {wire}"));
        figures.push(Measurement::found(name, rate, "batches/s"));
        run.end();
    }
    figures.extend(assemble::measure(&recording, effort)?);
    Ok(figures)
}

/// A free port at the loopback address: the system's choice, given back at once.
fn free_port() -> std::io::Result<std::net::SocketAddr> {
    std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()
}

/// A replay server and a client of its run.
pub(super) struct Run {
    server: ManagedProcess,
    session: Session,
    keys: Keys,
    actor: ActorSettings,
    pub(super) learner: LearnerConfig,
    /// Deliveries so far; each is another actor.
    deliveries: u32,
}

impl Run {
    /// Starts a server whose flags are those of every bench and `more`.
    pub(super) fn start(
        endpoint: &str,
        shared_memory: bool,
        folder: &Path,
        more: &[String],
    ) -> anyhow::Result<Self> {
        let words = ["replay-server", "--listen", endpoint];
        let run = ["--env", settings::WORLD, "--agent", settings::AGENT];
        let transport = format!("transport.shared_memory={shared_memory}");
        let sets = settings::REPLAY.into_iter().chain([transport.as_str()]);
        let words = words.into_iter().chain(run);
        let args: Vec<String> = words
            .chain(sets.flat_map(|set| ["--set", set]))
            .map(Into::into)
            .chain(more.iter().cloned())
            .collect();
        let surroundings = Surroundings {
            logs: folder,
            screen: &Screen::plain(),
            meeting: None,
        };
        let mut server = ManagedProcess::start("replay-server", &args, 1, surroundings)?;
        let session = reach(endpoint, &mut server)?;
        let keys = Keys::new(NAMESPACE).map_err(anyhow::Error::msg)?;
        let hello = join::hello(&session, &keys, &Shutdown::default())?
            .context("nobody told this client to stop")?;
        Ok(Self {
            server,
            session,
            keys,
            actor: ActorSettings::from_toml(&hello.config_toml)?,
            learner: LearnerConfig::from_toml(&hello.config_toml)?,
            deliveries: 0,
        })
    }

    /// Delivers chunks until `is_enough` of what was sent and since when, and gives transitions stored a second, from the
    /// first chunk's making to the last one's acknowledgement.
    pub(super) fn deliver(
        &mut self,
        recording: &Recording,
        chunk: (u32, u32),
        is_enough: impl Fn(u64, Instant) -> bool,
    ) -> anyhow::Result<f64> {
        let (client, actor, pool) = self.next_actor();
        let alive = taking_part::join_as_actor(&client, actor)?;
        let delivery = Delivery::start(
            client,
            0,
            DeliveryLimits::of(&self.actor.actor),
            pool.clone(),
            Shutdown::default(),
        )?;
        let mut chunks = recording.chunks(actor, chunk, pool);
        let started = Instant::now();
        while !is_enough(chunks.transitions(), started) {
            let chunk = chunks.next().context("chunks have no end")?;
            if !delivery.send(chunk) {
                break;
            }
        }
        let unwanted = delivery.finish()?;
        drop(alive);
        let seconds = started.elapsed().as_secs_f64();
        ensure!(unwanted == 0, "{unwanted} transitions were not wanted");
        Ok(chunks.transitions() as f64 / seconds)
    }

    /// A client of an actor that has not been there before, its number, and memory for its chunks.
    pub(super) fn next_actor(&mut self) -> (RunClient, u32, BufferPool) {
        self.deliveries += 1;
        let client = self.client(self.actor.spec.hash());
        (client, self.deliveries, self.actor.chunk_memory())
    }

    /// A client of the learner.
    pub(super) fn learner_client(&self) -> RunClient {
        self.client(self.learner.spec.hash())
    }

    /// Ends the server at once, as when its process dies.
    pub(super) fn kill(mut self) {
        if let Err(e) = self.session.close().wait() {
            tracing::debug!("closing the session: {e}");
        }
        self.server.kill();
        self.server
            .wait_until(Instant::now() + ANSWER_MAX, || false);
    }

    fn client(&self, spec_hash: u64) -> RunClient {
        RunClient::new(self.session.clone(), self.keys.clone(), spec_hash)
    }

    /// Batches a second, each read as a learner would.
    fn fetch(&self, effort: &Effort) -> anyhow::Result<f64> {
        let shutdown = Shutdown::default();
        let LearnerConfig {
            learner, transport, ..
        } = &self.learner;
        let client = self.learner_client();
        let _alive = taking_part::join_as_learner(&client)?;
        let mut source = BatchSource::start(
            std::slice::from_ref(&client),
            Requests {
                learner: taking_part::LEARNER,
                rows: learner.batch_size,
                in_flight: learner.batches_in_flight,
                shared_memory: transport.shared_memory,
                unreachable_max: ANSWER_MAX,
            },
            &shutdown,
        )?;
        let rate = effort.rate_overall(|| match source.next(ANSWER_MAX)? {
            Next::Batch(batch) => {
                let planes = [batch.states_t(), batch.states_k(), batch.states_n()];
                black_box(planes.map(touched));
                Ok(())
            }
            Next::NotYet(waiting) => {
                bail!("no batch came within {} s: {waiting}", ANSWER_MAX.as_secs())
            }
            Next::Finished => bail!("the replay server says that the run is over"),
        });
        // A request that is on its way wants its answer before the session is closed.
        shutdown.set();
        while !matches!(source.next(ANSWER_MAX)?, Next::Finished) {}
        rate
    }

    pub(super) fn end(mut self) {
        if let Err(e) = self.session.close().wait() {
            tracing::debug!("closing the session: {e}");
        }
        self.server.ask_to_stop();
        self.server
            .wait_until(Instant::now() + ANSWER_MAX, || false);
    }
}

/// A session to the server as soon as it listens.
pub(super) fn reach(endpoint: &str, server: &mut ManagedProcess) -> anyhow::Result<Session> {
    let endpoints = Endpoints {
        listen: Vec::new(),
        connect: vec![endpoint.to_owned()],
    };
    let deadline = Instant::now() + ANSWER_MAX;
    loop {
        match session::open(&endpoints) {
            Ok(session) => return Ok(session),
            Err(e) if Instant::now() > deadline => return Err(e.into()),
            Err(_) if server.end().is_some() => bail!("{}", server.exit_report()),
            Err(e) => tracing::debug!("the replay server does not listen yet: {e}"),
        }
    }
}

/// A sum over one byte of each cache line, so that all of a plane has come.
pub(super) fn touched(plane: &[u8]) -> u64 {
    plane.iter().step_by(64).map(|&byte| u64::from(byte)).sum()
}
