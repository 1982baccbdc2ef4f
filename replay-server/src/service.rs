//! The replay server as a process: zenoh around the core, waiting at the limiter, and the last word to everyone.
//! What is stored, sampled and allowed is the core's; here is only who asks and when the answer goes out.
//!
//! Chunks and batch requests wait in bounded queues with a thread each, so that a blocked one never holds up the threads on
//! which zenoh receives. Everything small is answered where it arrives.

use std::{
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, mpsc},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_protocol::{
    AffinityUpdate, BatchReply, BatchRequest, Chunk, CodecError, Goodbye, Hello, InsertReply, Keys,
    Kind, PlanesPool, RunSpec, Shutdown, codec,
    config::{Settings, TransportConfig},
    session::{self, Endpoints},
    shutdown::join_within,
};
use zenoh::{Session, Wait, bytes::ZBytes, query::Query, query::Queryable, sample::SampleKind};

use crate::{Config, Replay, Unready};

/// How long a chunk or a request waits at the limiter before it is told to come back: far below every sender's time-out.
const HOLD_MAX: Duration = Duration::from_secs(1);
/// The same for a part of a batch: what another shard counts meanwhile does not wake it.
const SHARD_HOLD_MAX: Duration = Duration::from_millis(50);
/// Chunks, and requests, that wait for their thread; one more is told to come back at once.
const QUEUE_MAX: usize = 4096;
/// Threads that make batches: one assembles while another's reply is being sent.
const BATCH_THREADS: usize = 2;

/// Pieces of memory kept for later chunks and batches.
const SPARE_MAX: usize = 8;
/// Batches in shared memory: those that are assembled, on their way, and being copied by the learner.
const SHARED_BATCHES: usize = 6;

/// How long the threads may take to end.
const THREADS_END_MAX: Duration = Duration::from_secs(2);

/// What a replay server is told at its start.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// Endpoints to listen on.
    pub listen: Vec<String>,
    /// Routers to connect to, if any.
    pub connect: Vec<String>,
    /// Prefix of the run's keys.
    pub namespace: String,
    /// Which of the replay's shards this is, from 0.
    pub shard: u32,
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
    let batch_rows = batch_rows(&settings)?;
    let replay = Replay::shard(&spec, &config, batch_rows, args.shard)?;
    let transport: TransportConfig = settings.table("transport")?;
    let pool = if transport.shared_memory {
        let bytes = replay.batch_header(batch_rows).planes_bytes();
        PlanesPool::shared(SPARE_MAX, SHARED_BATCHES, bytes)
    } else {
        PlanesPool::new(SPARE_MAX)
    };
    let keys = Keys::new(&args.namespace).map_err(anyhow::Error::msg)?;
    let session = session::open(&Endpoints {
        listen: args.listen.clone(),
        connect: args.connect,
    })?;
    let service = Arc::new(Service {
        spec_hash: spec.hash(),
        num_actions: spec.num_actions,
        shard: (args.shard, config.shards),
        config_toml: args.config_toml,
        pool,
        replay: Mutex::new(replay),
        changed: Condvar::new(),
        shutdown: shutdown.clone(),
    });
    let (answering, threads) = declare(&session, &keys, &service)
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
    // Without the queryables no more comes, without the session nobody waits for a slow asker: the threads end.
    drop(answering);
    let closed = session.close().wait();
    join_within(threads, THREADS_END_MAX);
    closed.map_err(|e| anyhow::anyhow!("closing the session: {e}"))
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
    shard: (u32, u32),
    config_toml: String,
    /// Memory for chunks that arrive and batches that leave.
    pool: PlanesPool,
    replay: Mutex<Replay>,
    /// Something was stored or sampled: whoever waits at the limiter looks again.
    changed: Condvar,
    shutdown: Shutdown,
}

/// Declares everything that the replay server answers; dropping the first ends it, and with it the threads.
fn declare(
    session: &Session,
    keys: &Keys,
    service: &Arc<Service>,
) -> zenoh::Result<(Vec<Queryable<()>>, Vec<JoinHandle<()>>)> {
    let (chunks, waiting_chunks) = mpsc::sync_channel::<Query>(QUEUE_MAX);
    let (requests, waiting_requests) = mpsc::sync_channel::<Query>(QUEUE_MAX);
    let waiting_requests = Arc::new(Mutex::new(waiting_requests));
    let inserting = service.clone();
    let insert = std::thread::Builder::new()
        .name("insert".into())
        .spawn(move || {
            for query in waiting_chunks {
                inserting.insert(&query);
            }
        })?;
    let mut threads = vec![insert];
    for i in 0..BATCH_THREADS {
        let (sampling, waiting) = (service.clone(), waiting_requests.clone());
        let sample = std::thread::Builder::new()
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
        threads.push(sample);
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
    let queryables = vec![
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
    ];
    Ok((queryables, threads))
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
            shard: self.shard,
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
        let none = ZBytes::new();
        let payload = query.payload().unwrap_or(&none);
        let (pieces, len) = (payload.slices(), payload.len());
        let chunk = match Chunk::receive(pieces, len, &self.pool, self.spec_hash, self.num_actions)
        {
            Ok(chunk) => chunk,
            Err(e) => {
                self.refuse("a chunk", &e);
                let refused = InsertReply::Refused { why: e.to_string() };
                return self.reply(query, Kind::InsertReply, &refused);
            }
        };
        let arrived = Instant::now();
        let mut replay = self.replay();
        let reply = loop {
            match replay.insert(&chunk) {
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
        let hold_max = match request.elsewhere {
            Some(elsewhere) => {
                replay.heard(elsewhere);
                self.changed.notify_all();
                SHARD_HOLD_MAX
            }
            None => HOLD_MAX,
        };
        let mut said = false;
        let sampled = loop {
            let memory = |bytes| match request.shared_memory {
                true => self.pool.take(bytes),
                false => self.pool.take_own(bytes),
            };
            match replay.sample_in(request.rows, memory) {
                Err(Unready::Wait(waiting)) => {
                    // A chunk that waits may be let in to end this; once, or those who wait would wake each other for ever.
                    if !std::mem::replace(&mut said, true) {
                        self.changed.notify_all();
                    }
                    let left = hold_max.saturating_sub(arrived.elapsed());
                    if left.is_zero() || self.shutdown.is_set() {
                        break Err(Unready::Wait(waiting));
                    }
                    replay = self.wait(replay, left);
                }
                sampled => break sampled,
            }
        };
        replay.note_learner_waited(arrived.elapsed().as_secs_f64());
        drop(replay);
        match sampled {
            Ok(batch) => {
                self.changed.notify_all();
                match batch.seal(self.spec_hash) {
                    Ok((head, planes)) => {
                        session::answer(query, session::join_planes(head, planes.freeze()))
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
