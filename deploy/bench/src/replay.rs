//! A real replay server, in a process of its own, with real clients over the real wire; and its core without the wire.
//! The clients are the actor's delivery and the learner's batch source, so what is measured is what runs in production.

use std::{
    hint::black_box,
    path::{Path, PathBuf},
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
    remote::batch_source::{BatchSource, Counters, Next, Requests},
};
use driml_protocol::{
    BufferPool, Keys, RunClient, Shutdown, join,
    session::{self, Endpoints, MESSAGE_BYTES_MAX, SessionError},
    tls::{Credentials, Role, TlsError},
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
    for (name, endpoint, shared_memory) in wires {
        let wire = Wire {
            endpoint: &endpoint,
            shared_memory,
            tls_dir: None,
        };
        let run = Run::start(wire, folder.path(), &[])?;
        figures.extend(over_wire(name, run, &recording, effort)?);
    }
    figures.extend(assemble::measure(&recording, effort)?);
    Ok(figures)
}

/// The same over TCP and, with the certificates in `tls_dir`, over QUIC.
///
/// # Errors
/// As [`measure`]; certificates that are missing or not good.
pub(super) fn measure_guarded(effort: &Effort, tls_dir: &Path) -> anyhow::Result<Vec<Measurement>> {
    let recording = Recording::play()?;
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    let mut figures = Vec::new();
    for (name, tls_dir) in [("tcp", None), ("quic", Some(tls_dir))] {
        let endpoint = format!("{name}/{}", free_port()?);
        let wire = Wire {
            endpoint: &endpoint,
            shared_memory: false,
            tls_dir,
        };
        let run = Run::start(wire, folder.path(), &[])?;
        figures.extend(over_wire(name, run, &recording, effort)?);
    }
    Ok(figures)
}

/// Transitions stored a second and batches a second over the wire of this name.
fn over_wire(
    wire: &str,
    mut run: Run,
    recording: &Recording,
    effort: &Effort,
) -> anyhow::Result<Vec<Measurement>> {
    let mut figures = Vec::new();
    run.deliver(recording, CHUNKS[3], |sent, _| sent >= settings::CAPACITY)?;
    for chunk in CHUNKS {
        let transitions = chunk.0 * chunk.1;
        let rate = run.deliver(recording, chunk, |_, started| effort.is_spent(started))?;
        let name = format!("insert, {transitions} transitions a chunk, {wire}");
        figures.push(Measurement::found(name, rate, "transitions/s"));
    }
    let (rate, name) = (run.fetch(effort)?, format!("batch of 3 states, {wire}"));
    figures.push(Measurement::found(name, rate, "batches/s"));
    run.end();
    Ok(figures)
}

/// How clients reach a server.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wire<'a> {
    pub(super) endpoint: &'a str,
    pub(super) shared_memory: bool,
    /// Certificates for all roles, if it is guarded.
    pub(super) tls_dir: Option<&'a Path>,
}

impl Wire<'_> {
    fn endpoints(&self) -> Endpoints {
        Endpoints {
            listen: Vec::new(),
            connect: vec![self.endpoint.to_owned()],
        }
    }

    fn credentials(&self, role: Role) -> Result<Option<Credentials>, TlsError> {
        let read = |folder| Credentials::read(folder, role);
        self.tls_dir.map(read).transpose()
    }
}

/// A free port at the loopback address: the system's choice, given back at once.
fn free_port() -> std::io::Result<std::net::SocketAddr> {
    std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()
}

/// A replay server and a client of its run.
pub(super) struct Run {
    server: ManagedProcess,
    /// The first may do anything where nothing is guarded, else only look; then each role has one of its own.
    sessions: Vec<Session>,
    guarded: Option<(Endpoints, PathBuf)>,
    keys: Keys,
    actor: ActorSettings,
    pub(super) learner: LearnerConfig,
    /// Deliveries so far; each is another actor.
    deliveries: u32,
}

impl Run {
    /// Starts a server whose flags are those of every bench and `more`.
    pub(super) fn start(wire: Wire<'_>, folder: &Path, more: &[String]) -> anyhow::Result<Self> {
        let Wire {
            endpoint,
            shared_memory,
            tls_dir,
        } = wire;
        let words = ["replay-server", "--stay", "--listen", endpoint];
        let run = ["--env", settings::WORLD, "--agent", settings::AGENT];
        let transport = format!("transport.shared_memory={shared_memory}");
        let sets = settings::REPLAY.into_iter().chain([transport.as_str()]);
        let words = words.into_iter().chain(run);
        let args: Vec<String> = words
            .chain(sets.flat_map(|set| ["--set", set]))
            .map(Into::into)
            .chain(tls_dir.map(|dir| format!("--tls-dir={}", dir.display())))
            .chain(more.iter().cloned())
            .collect();
        let surroundings = Surroundings {
            logs: folder,
            screen: &Screen::plain(),
            meeting: None,
        };
        let mut server = ManagedProcess::start("replay-server", &args, 1, surroundings)?;
        let keys = Keys::new(NAMESPACE).map_err(anyhow::Error::msg)?;
        let credentials = wire.credentials(Role::Observer)?;
        let endpoints = wire.endpoints();
        let session = reach(&mut server, || {
            session::open_as(&endpoints, &keys, credentials.as_ref(), MESSAGE_BYTES_MAX)
        })?;
        let hello = join::hello(&session, &keys, &Shutdown::default())?
            .context("nobody told this client to stop")?;
        Ok(Self {
            server,
            sessions: vec![session],
            guarded: tls_dir.map(|dir| (endpoints, dir.to_owned())),
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
        let (client, actor, pool) = self.next_actor()?;
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
    ///
    /// # Errors
    /// A certificate that is missing, a server that does not answer.
    pub(super) fn next_actor(&mut self) -> anyhow::Result<(RunClient, u32, BufferPool)> {
        self.deliveries += 1;
        let role = Role::Actor(self.deliveries);
        let client = self.client(role, self.actor.spec.hash())?;
        Ok((client, self.deliveries, self.actor.chunk_memory()))
    }

    /// A client of the learner.
    ///
    /// # Errors
    /// As [`Run::next_actor`].
    pub(super) fn learner_client(&mut self) -> anyhow::Result<RunClient> {
        self.client(Role::Learner, self.learner.spec.hash())
    }

    /// Ends the server at once, as when its process dies.
    pub(super) fn kill(mut self) {
        self.close();
        self.server.kill();
        self.server
            .wait_until(Instant::now() + ANSWER_MAX, || false);
    }

    fn client(&mut self, role: Role, spec_hash: u64) -> anyhow::Result<RunClient> {
        let session = match &self.guarded {
            None => self.sessions[0].clone(),
            Some((endpoints, dir)) => {
                let own = Credentials::read(dir, role)?;
                let session =
                    session::open_as(endpoints, &self.keys, Some(&own), MESSAGE_BYTES_MAX)?;
                self.sessions.push(session.clone());
                session
            }
        };
        Ok(RunClient::new(session, self.keys.clone(), spec_hash))
    }

    fn close(&self) {
        for session in &self.sessions {
            if let Err(e) = session.close().wait() {
                tracing::debug!("closing a session: {e}");
            }
        }
    }

    /// Batches a second, each read as a learner would.
    fn fetch(&mut self, effort: &Effort) -> anyhow::Result<f64> {
        let shutdown = Shutdown::default();
        let client = self.learner_client()?;
        let LearnerConfig {
            learner, transport, ..
        } = &self.learner;
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
            &Counters::at_start(1),
            &shutdown,
        )?;
        let rate = effort.rate_overall(|| match source.next(ANSWER_MAX)? {
            Next::Batch(served) => {
                let batch = &served.batch;
                let planes = [batch.states_t(), batch.states_k(), batch.states_n()];
                black_box(planes.map(|plane| touched(&plane)));
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
        self.close();
        self.server.ask_to_stop();
        self.server
            .wait_until(Instant::now() + ANSWER_MAX, || false);
    }
}

/// A session to the server as soon as it listens.
pub(super) fn reach(
    server: &mut ManagedProcess,
    open: impl Fn() -> Result<Session, SessionError>,
) -> anyhow::Result<Session> {
    let deadline = Instant::now() + ANSWER_MAX;
    loop {
        match open() {
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
