//! The replay server as a process: zenoh around the core, waiting at the limiter, and the last word to everyone.
//! What is stored, sampled and allowed is the core's; here is only who asks and when the answer goes out.
//!
//! Every kind of question has threads of its own, so that one that waits never holds up another. Compressing and unpacking
//! frames is done by those threads, outside the lock on the core.

use std::{
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_protocol::{
    AffinityUpdate, BatchReply, BatchRequest, Chunk, CodecError, Goodbye, Hello, InsertReply, Keys,
    Kind, PlanesPool, RunSpec, Shutdown,
    answering::Answering,
    codec,
    config::{Settings, TransportConfig},
    session::{self, Endpoints},
    shutdown::join_within,
};
use zenoh::{Session, Wait, bytes::ZBytes, query::Query, query::Queryable, sample::SampleKind};

use crate::{Config, Packer, Replay, Unready};

/// How long a chunk or a request waits at the limiter before it is told to come back: far below every sender's time-out.
const HOLD_MAX: Duration = Duration::from_secs(1);
/// The same for a part of a batch: what another shard counts meanwhile does not wake it.
const SHARD_HOLD_MAX: Duration = Duration::from_millis(50);
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
    /// Updates of the learner after which the run goes on; 0 starts it.
    pub after_updates: u64,
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
    let mut replay = Replay::shard(&spec, &config, batch_rows, args.shard)?;
    if args.after_updates > 0 {
        replay = replay.going_on_after(args.after_updates, args.shard);
    }
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
        after_updates: args.after_updates,
        config_toml: args.config_toml,
        pool,
        packer: replay.packer(),
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
    after_updates: u64,
    config_toml: String,
    /// Memory for chunks that arrive and batches that leave.
    pool: PlanesPool,
    packer: Packer,
    replay: Mutex<Replay>,
    /// Something was stored or sampled: whoever waits at the limiter looks again.
    changed: Condvar,
    shutdown: Shutdown,
}

/// The threads that answer.
type Threads = Vec<JoinHandle<()>>;

/// Declares everything that the replay server answers; dropping the first ends it, and with it the threads.
fn declare(
    session: &Session,
    keys: &Keys,
    service: &Arc<Service>,
) -> zenoh::Result<(Vec<Queryable<()>>, Threads)> {
    type Answer = fn(&Service, &Query);
    let answers: [(String, &str, usize, Answer); 6] = [
        (keys.ingest(), "insert", 1, Service::insert),
        (keys.batch(), "sample", BATCH_THREADS, Service::sample),
        (keys.affinity(), "affinity", 1, Service::affinity),
        (keys.hello(), "hello", 1, Service::hello),
        (keys.goodbye(), "goodbye", 1, Service::goodbye),
        (keys.replay_status(), "status", 1, Service::status),
    ];
    let (mut queryables, mut threads) = (Vec::new(), Vec::new());
    for (key, name, count, answer) in answers {
        let service = service.clone();
        let answering = Answering::start(name, count, move |query| answer(&service, query))?;
        queryables.push(answering.declare(session, key)?);
        threads.extend(answering.into_threads());
    }
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
            after_updates: self.after_updates,
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
        let hold_max = match request.elsewhere {
            Some(elsewhere) => {
                replay.heard(elsewhere);
                self.changed.notify_all();
                SHARD_HOLD_MAX
            }
            None => HOLD_MAX,
        };
        let mut said = false;
        let drawn = loop {
            let memory = |bytes| match request.shared_memory {
                true => self.pool.take(bytes),
                false => self.pool.take_own(bytes),
            };
            match replay.draw_for(request.id, request.rows, memory) {
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
