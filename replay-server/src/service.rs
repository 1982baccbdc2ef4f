//! The replay server as a process: zenoh around the core, waiting at the limiter, and the last word to everyone.
//! What is stored, sampled and allowed is the core's; here is only who asks and when the answer goes out.
//!
//! Chunks and batch requests wait in bounded queues with a thread each, so that a blocked one never holds up the threads on
//! which zenoh receives. Compressing and unpacking frames is done by those threads, outside the lock on the core. Everything small is answered where it arrives.

use std::{
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, mpsc},
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_protocol::{
    AffinityUpdate, BatchReply, BatchRequest, Chunk, CodecError, Goodbye, Hello, InsertReply, Keys,
    Kind, RunSpec, Shutdown, codec,
    config::Settings,
    session::{self, Endpoints},
};
use zenoh::{Session, Wait, query::Query, query::Queryable, sample::SampleKind};

use crate::{Config, Packer, Replay, Unready};

/// How long a chunk or a request waits at the limiter before it is told to come back: far below every sender's time-out.
const HOLD_MAX: Duration = Duration::from_secs(1);
/// Chunks, and requests, that wait for their thread; one more is told to come back at once.
const QUEUE_MAX: usize = 4096;
/// Threads that make batches: one assembles while another's reply is being sent.
const BATCH_THREADS: usize = 2;

/// What a replay server is told at its start.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// Endpoints to listen on.
    pub listen: Vec<String>,
    /// Routers to connect to, if any.
    pub connect: Vec<String>,
    /// Prefix of the run's keys.
    pub namespace: String,
    /// The run's resolved settings, which it hands to whoever joins.
    pub config_toml: String,
}

/// Runs the replay server until `shutdown`.
///
/// # Errors
/// Settings that cannot work, memory that the system does not grant, an endpoint that cannot be listened on.
pub fn run(args: RunArgs, shutdown: &Shutdown) -> anyhow::Result<()> {
    let settings = Settings::parse(&args.config_toml)?;
    let spec: RunSpec = settings.table("run")?;
    spec.validate()?;
    let config: Config = settings.table("replay")?;
    let replay = Replay::new(&spec, &config, batch_rows(&settings)?)?;
    let keys = Keys::new(&args.namespace).map_err(anyhow::Error::msg)?;
    let session = session::open(&Endpoints {
        listen: args.listen.clone(),
        connect: args.connect,
    })?;
    let service = Arc::new(Service {
        spec_hash: spec.hash(),
        num_actions: spec.num_actions,
        config_toml: args.config_toml,
        packer: replay.packer(),
        replay: Mutex::new(replay),
        changed: Condvar::new(),
        shutdown: shutdown.clone(),
    });
    let _answering = declare(&session, &keys, &service)
        .map_err(|e| anyhow::anyhow!("declaring what the replay server answers: {e}"))?;
    let watched = service.clone();
    let _alive = session
        .liveliness()
        .declare_subscriber(keys.actors_alive())
        .history(true)
        .callback(move |sample| {
            let mut replay = watched.replay();
            let actors = replay.status().actors;
            replay.set_actors(match sample.kind() {
                SampleKind::Put => actors + 1,
                SampleKind::Delete => actors.saturating_sub(1),
            });
        })
        .wait()
        .map_err(|e| anyhow::anyhow!("watching for actors: {e}"))?;
    tracing::info!(
        "replay server listens on {:?}, run {:016x}",
        args.listen,
        service.spec_hash
    );
    shutdown.wait();
    service.changed.notify_all();
    tracing::info!(
        "replay server stops with {} transitions stored",
        service.replay().inserted_total()
    );
    session
        .close()
        .wait()
        .map_err(|e| anyhow::anyhow!("closing the session: {e}"))
}

/// The one number of the learner's that the limiter needs.
fn batch_rows(settings: &Settings) -> anyhow::Result<u32> {
    let learner: toml::Table = settings.table("learner")?;
    let rows = learner.get("batch_rows").and_then(toml::Value::as_integer);
    let rows = rows.context("learner.batch_rows is missing or not a whole number")?;
    u32::try_from(rows).with_context(|| format!("learner.batch_rows = {rows} cannot work"))
}

struct Service {
    spec_hash: u64,
    num_actions: u32,
    config_toml: String,
    packer: Packer,
    replay: Mutex<Replay>,
    /// Something was stored or sampled: whoever waits at the limiter looks again.
    changed: Condvar,
    shutdown: Shutdown,
}

/// Declares everything that the replay server answers; dropping the result ends it.
fn declare(
    session: &Session,
    keys: &Keys,
    service: &Arc<Service>,
) -> zenoh::Result<Vec<Queryable<()>>> {
    let (chunks, waiting_chunks) = mpsc::sync_channel::<Query>(QUEUE_MAX);
    let (requests, waiting_requests) = mpsc::sync_channel::<Query>(QUEUE_MAX);
    let waiting_requests = Arc::new(Mutex::new(waiting_requests));
    let inserting = service.clone();
    std::thread::Builder::new()
        .name("insert".into())
        .spawn(move || {
            for query in waiting_chunks {
                inserting.insert(&query);
            }
        })?;
    for i in 0..BATCH_THREADS {
        let (sampling, waiting) = (service.clone(), waiting_requests.clone());
        std::thread::Builder::new()
            .name(format!("sample-{i}"))
            .spawn(move || {
                loop {
                    let next = waiting
                        .lock()
                        .unwrap_or_else(PoisonError::into_inner)
                        .recv();
                    let Ok(query) = next else { return };
                    sampling.sample(&query);
                }
            })?;
    }
    let answering = |key: String, answer: fn(&Service, &Query)| {
        let service = service.clone();
        session
            .declare_queryable(key)
            .callback(move |query| answer(&service, &query))
            .wait()
    };
    let overflow = service.clone();
    let ingest = move |query: Query| {
        if let Err(mpsc::TrySendError::Full(query)) = chunks.try_send(query) {
            let inserted_total = overflow.replay().inserted_total();
            overflow.reply(
                &query,
                Kind::InsertReply,
                &InsertReply::Wait { inserted_total },
            );
        }
    };
    let overflow = service.clone();
    let batch = move |query: Query| {
        if let Err(mpsc::TrySendError::Full(query)) = requests.try_send(query) {
            let waiting = overflow.replay().waiting();
            overflow.reply(&query, Kind::BatchReply, &BatchReply::Wait(waiting));
        }
    };
    Ok(vec![
        answering(keys.hello(), Service::hello)?,
        answering(keys.goodbye(), Service::goodbye)?,
        answering(keys.affinity(), Service::affinity)?,
        answering(keys.replay_status(), Service::status)?,
        session
            .declare_queryable(keys.ingest())
            .callback(ingest)
            .wait()?,
        session
            .declare_queryable(keys.batch())
            .callback(batch)
            .wait()?,
    ])
}

impl Service {
    fn replay(&self) -> MutexGuard<'_, Replay> {
        self.replay.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn reply<H: serde::Serialize>(&self, query: &Query, kind: Kind, header: &H) {
        match codec::encode(kind, self.spec_hash, header, &[]) {
            Ok(bytes) => session::answer(query, bytes.into()),
            Err(e) => tracing::error!("a reply of kind {kind:?} was not sent: {e}"),
        }
    }

    /// Counts and logs a message that cannot be read.
    fn refuse(&self, what: &str, e: &CodecError) {
        tracing::warn!("{what} was refused: {e}");
        self.replay().note_refused_message();
    }

    /// Decodes a small message, or counts it as refused.
    fn read<H: serde::de::DeserializeOwned>(&self, query: &Query, kind: Kind) -> Option<H> {
        let payload = query
            .payload()
            .map(|payload| payload.to_bytes())
            .unwrap_or_default();
        match codec::decode(&payload, kind, Some(self.spec_hash)) {
            Ok((header, _)) => Some(header),
            Err(e) => {
                self.refuse(&format!("a message of kind {kind:?}"), &e);
                None
            }
        }
    }

    fn hello(&self, query: &Query) {
        let inserted_total = self.replay().inserted_total();
        let hello = Hello {
            config_toml: self.config_toml.clone(),
            inserted_total,
        };
        self.reply(query, Kind::Hello, &hello);
    }

    fn goodbye(&self, query: &Query) {
        if let Some(goodbye) = self.read::<Goodbye>(query, Kind::Goodbye) {
            self.replay().goodbye(&goodbye);
            self.reply(query, Kind::Done, &());
        }
    }

    fn affinity(&self, query: &Query) {
        let Some(update) = self.read::<AffinityUpdate>(query, Kind::Affinity) else {
            return;
        };
        match self.replay().set_affinity(&update) {
            Ok(()) => self.reply(query, Kind::Done, &()),
            Err(e) => tracing::warn!("an affinity matrix was refused: {e}"),
        }
    }

    fn status(&self, query: &Query) {
        let status = self.replay().status();
        self.reply(query, Kind::ReplayStatus, &status);
    }

    fn insert(&self, query: &Query) {
        let payload = query
            .payload()
            .map(|payload| payload.to_bytes())
            .unwrap_or_default();
        let chunk = match Chunk::decode(&payload, self.spec_hash, self.num_actions) {
            Ok(chunk) => chunk,
            Err(e) => {
                self.refuse("a chunk", &e);
                let refused = InsertReply::Refused { why: e.to_string() };
                return self.reply(query, Kind::InsertReply, &refused);
            }
        };
        let packed = self.packer.pack(&chunk);
        let arrived = Instant::now();
        let mut replay = self.replay();
        let reply = loop {
            match replay.insert_packed(&packed) {
                InsertReply::Wait { inserted_total } => {
                    let left = HOLD_MAX.saturating_sub(arrived.elapsed());
                    if left.is_zero() || self.shutdown.is_set() {
                        replay.note_actors_waited(arrived.elapsed().as_secs_f64());
                        break InsertReply::Wait { inserted_total };
                    }
                    replay = self.wait(replay, left);
                }
                stored @ InsertReply::Stored { .. } => {
                    replay.note_actors_waited(arrived.elapsed().as_secs_f64());
                    break stored;
                }
                other => break other,
            }
        };
        drop(replay);
        self.changed.notify_all();
        self.reply(query, Kind::InsertReply, &reply);
    }

    fn sample(&self, query: &Query) {
        let Some(request) = self.read::<BatchRequest>(query, Kind::BatchRequest) else {
            let why = "the request could not be read; the replay server's log says why".into();
            return self.reply(query, Kind::BatchReply, &BatchReply::Refused { why });
        };
        let arrived = Instant::now();
        let mut replay = self.replay();
        let drawn = loop {
            match replay.draw(request.rows) {
                Err(Unready::Wait(waiting)) => {
                    let left = HOLD_MAX.saturating_sub(arrived.elapsed());
                    if left.is_zero() || self.shutdown.is_set() {
                        break Err(Unready::Wait(waiting));
                    }
                    replay = self.wait(replay, left);
                }
                drawn => break drawn,
            }
        };
        replay.note_learner_waited(arrived.elapsed().as_secs_f64());
        drop(replay);
        match drawn {
            Ok(draft) => {
                self.changed.notify_all();
                match draft.unpack().seal(self.spec_hash) {
                    Ok((head, planes)) => {
                        session::answer(query, session::join_pieces([head, planes]))
                    }
                    Err(e) => tracing::error!("a batch was not sent: {e}"),
                }
            }
            Err(unready) => self.reply(query, Kind::BatchReply, &BatchReply::from(unready)),
        }
    }

    fn wait<'a>(
        &'a self,
        replay: MutexGuard<'a, Replay>,
        left: Duration,
    ) -> MutexGuard<'a, Replay> {
        self.changed
            .wait_timeout(replay, left)
            .unwrap_or_else(PoisonError::into_inner)
            .0
    }
}
