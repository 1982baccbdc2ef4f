//! Starts and stops the replay server: its settings, session, queries and threads.
//! The files named after the messages handle them.

use std::{
    path::PathBuf,
    sync::{Arc, Condvar, Mutex, OnceLock, mpsc},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use driml_protocol::{
    BatchHeader, BufferPool, Incoming, POOL_BATCHES, Peer, Recovering, Request, RunClient, RunSpec,
    Sampling, Shutdown, answer_queries,
    config::{Settings, TransportConfig},
    fail_point, join_within,
    session::Connection,
    shared_memory, spawn,
};
use zenoh::{Wait, pubsub::Subscriber, query::Queryable, sample::SampleKind};

use super::{
    limits::{HEAD_BYTES_MAX, MessageLimits, read_u32, shared_memory_bytes},
    server::{Service, ServiceGate, State},
    weights_store::WeightsStore,
};
use crate::{
    config::Config,
    persist::{PersistArgs, PersistError, RecoveryControl, ReplayFolder, shard_dir},
    replay::Replay,
};

/// Threads that serve batches: one assembles a batch while the other sends its reply.
const BATCH_THREADS: usize = 2;
/// Threads that send weights. An actor that stops reading blocks one of them until its connection is closed.
const WEIGHTS_THREADS: usize = 4;

/// Maximum time that a query about a chunk is held before its reply.
const QUERY_HOLD_MAX: Duration = Duration::from_secs(2);

/// Buffers kept for reuse by later chunks and batches.
const SPARE_BUFFERS_MAX: usize = 8;

/// Maximum connections and disconnections of processes that wait to be tracked. At the limit, the thread that reads the socket waits.
const CHANGES_MAX: usize = 4096;

const THREADS_JOIN_MAX: Duration = Duration::from_secs(2);

/// The arguments of a replay server process.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// The endpoints to listen on, and routers to connect to, if any.
    pub connection: Connection,
    /// The number of this shard of the replay, from 0.
    pub shard: u32,
    /// Bytes of one version of the weights, which the replay server cannot compute. Uploads of more than about twice as many are rejected.
    pub weights_bytes_max: usize,
    /// The folder of a replay that is kept on disk. Each of several shards has a subfolder in it.
    pub dir: Option<PathBuf>,
    /// Whether to keep answering after the run is over, until `drain` or `shutdown`.
    pub keep_alive: bool,
    /// Raised when the launcher has died, which also stops the other processes. This process then waits up to 25 s until they have
    /// delivered their data and left, and exits. To stop at once, raise this and `shutdown`.
    pub drain: Shutdown,
    /// The run's resolved settings, which it sends to each process that joins.
    pub config_toml: String,
}

/// Runs the replay server until its run is over, `args.drain` or `shutdown`, and returns whether the run is over.
pub fn run(args: RunArgs, shutdown: &Shutdown) -> anyhow::Result<bool> {
    let settings = Settings::parse(&args.config_toml)?;
    let spec: RunSpec = settings.table("run")?;
    spec.validate()?;
    let config: Config = settings.table("replay")?;
    let batch_size = read_u32(&settings, "learner", "batch_size")?;
    let ack_timeout = Duration::from_millis(read_u32(&settings, "actor", "ack_timeout_ms")?.into());
    let empty = Replay::shard(&spec, &config, batch_size, args.shard)?;
    let kept = args.dir.as_ref().map(|dir| {
        let args = PersistArgs {
            dir: shard_dir(dir, args.shard, config.shards),
            shard: args.shard,
            ..PersistArgs::default()
        };
        ReplayFolder::open(&args, &spec, &config)
    });
    let kept = kept.transpose()?;
    let transport: TransportConfig = settings.table("transport")?;
    let batch = BatchHeader::largest(&spec, batch_size).with_sampling(&config.sampling);
    // Computed for the whole run: if shared memory is too small, all messages go through sockets.
    let needed = shared_memory_bytes(&settings, 1)?;
    let room = || shared_memory::granted(shared_memory::check_room(needed));
    let is_granted = transport.shared_memory && room().is_some();
    let pool = if is_granted {
        BufferPool::shared(SPARE_BUFFERS_MAX, POOL_BATCHES, batch.payload_bytes())
    } else {
        BufferPool::new(SPARE_BUFFERS_MAX)
    };
    let warn_slower =
        |why: &String| tracing::warn!("chunks come through sockets, which is slower: {why}");
    let is_lockable = || shared_memory::check_lockable(needed).inspect_err(warn_slower);
    let reads_shared_memory = is_granted && is_lockable().is_ok();
    let limits = MessageLimits::from_settings(&settings, &spec, args.weights_bytes_max)?;
    let session = args.connection.open(limits.largest_bytes())?;
    let client = RunClient::new(session, args.connection.keys, spec.hash());
    let gate = Arc::new(ServiceGate {
        service: OnceLock::new(),
        recovery: RecoveryControl::new(args.drain.clone()),
        config_toml: args.config_toml.clone(),
    });
    let declared = Queries::declare(&client, &gate, limits, &config.sampling);
    let (queryables, mut threads) =
        declared.map_err(|e| anyhow::anyhow!("declaring what the replay server answers: {e}"))?;
    tracing::info!(
        "replay server listens on {:?}, run {:016x}",
        args.connection.endpoints.listen,
        client.spec_hash()
    );
    let read = match kept {
        Some(kept) => recover_replay(kept, empty, &gate.recovery, spec.hash()),
        None => Ok((empty, WeightsStore::default())),
    };
    let (mut replay, weights) = match read {
        Ok(read) => read,
        Err(e) => {
            // Closes the session, so that clients that wait for the replay notice at once that the server is gone.
            let closed = close(&client, queryables, threads);
            return match e {
                PersistError::Stopped => {
                    tracing::info!("replay server stops: {e}");
                    closed.map(|()| false)
                }
                e => Err(e.into()),
            };
        }
    };
    // Unique to this process, so that priorities of rows that an earlier process drew are not set on other rows.
    replay.origin.incarnation = rand::random();
    let service = Arc::new(Service {
        limits,
        shard: (args.shard, config.shards),
        config_toml: args.config_toml,
        reads_shared_memory,
        hold_max: QUERY_HOLD_MAX.min(ack_timeout / 4),
        pool,
        packer: replay.packer(),
        state: Mutex::new(State::new(replay, Instant::now())),
        changed: Condvar::new(),
        weights: Mutex::new(weights),
        client: client.clone(),
        shutdown: shutdown.clone(),
    });
    let (subscriber, members) = watch_members(&client, &service)
        .map_err(|e| anyhow::anyhow!("watching for actors and learner: {e}"))?;
    let opened = gate.service.set(service.clone());
    assert!(opened.is_ok(), "a replay is read back once");
    threads.extend(service.clone().start_threads()?);
    threads.push(members);
    service.wait_until_over(&args.drain, args.keep_alive);
    shutdown.set();
    // With the lock, as no thread may be between its test of the flag and its wait.
    drop(service.state());
    service.changed.notify_all();
    tracing::info!(
        "replay server stops with {} transitions stored",
        service.state().replay.inserted_total()
    );
    drop(subscriber);
    let closed = close(&client, queryables, threads);
    let mut state = service.state();
    if let Some(journal) = &mut state.replay.journal {
        journal.flush();
    }
    if let Some(counts) = state.replay.priority_counts() {
        tracing::info!(
            "priorities of {} rows were set, {} came too late for their transition, {} came twice",
            counts.set,
            counts.gone,
            counts.repeated
        );
    }
    closed.map(|()| state.participants.is_run_over())
}

/// Stops answering: without the queryables no query comes, without the session no reply to a slow client is sent, and the threads end.
fn close(client: &RunClient, queryables: Queryables, threads: Threads) -> anyhow::Result<()> {
    drop(queryables);
    let closed = client.session().close().wait();
    join_within(threads, THREADS_JOIN_MAX);
    closed.map_err(|e| anyhow::anyhow!("closing the session: {e}"))
}

/// Reads the kept replay into `empty`, and the newest weights kept with it. Logs what was found.
fn recover_replay(
    kept: ReplayFolder,
    empty: Replay,
    control: &RecoveryControl,
    spec_hash: u64,
) -> Result<(Replay, WeightsStore), PersistError> {
    let (started, folder) = (Instant::now(), kept.path.clone());
    let (replay, recovery) = kept.recover(empty, control)?;
    let dir = folder.display();
    for warning in &recovery.warnings {
        tracing::warn!("{dir}: {warning}");
    }
    if recovery.found {
        let status = replay.status();
        tracing::info!(
            "continues with the replay in {dir}: {} transitions stored, {} held, {} rows served; {} MiB read in {:.1} s",
            status.transitions_inserted,
            replay.ring.inserted() - replay.ring.oldest(),
            status.rows_sampled,
            recovery.bytes >> 20,
            started.elapsed().as_secs_f64()
        );
        if replay.priority_counts().is_some() {
            tracing::info!(
                "priorities are those of the newest snapshot: each transition that came later has the highest one"
            );
        }
    } else {
        tracing::info!("keeps the replay in {dir}");
    }
    let weights = WeightsStore::open(&folder, spec_hash, recovery.found);
    Ok((replay, weights))
}

type Queryables = Vec<Queryable<()>>;
type Threads = Vec<JoinHandle<()>>;

/// The queries that the replay server answers. Each kind of message has separate threads.
struct Queries<'a> {
    client: &'a RunClient,
    gate: &'a Arc<ServiceGate>,
    queryables: Queryables,
    threads: Threads,
}

impl<'a> Queries<'a> {
    /// Declares all queries; `sampling` decides whether priorities are among them. Before `gate` has its service, every query is
    /// answered with "retry". Dropping the queryables ends the threads.
    fn declare(
        client: &'a RunClient,
        gate: &'a Arc<ServiceGate>,
        limits: MessageLimits,
        sampling: &Sampling,
    ) -> zenoh::Result<(Queryables, Threads)> {
        let mut this = Self {
            client,
            gate,
            queryables: Vec::new(),
            threads: Threads::new(),
        };
        let small = HEAD_BYTES_MAX;
        this.answer("insert", 1, limits.chunk, Service::insert)?;
        this.answer("poll", 1, small, Service::poll)?;
        this.answer("request", 1, small, Service::request)?;
        this.answer("affinity", 1, limits.affinity, Service::affinity)?;
        if sampling.is_prioritised() {
            this.answer("priorities", 1, limits.priorities, Service::priorities)?;
        }
        this.answer("run-info", 1, small, Service::run_info)?;
        this.answer("join-actor", 1, small, |it, join| {
            it.join(join, State::join_actor)
        })?;
        this.answer("join-learner", 1, small, |it, join| {
            it.join(join, State::join_learner)
        })?;
        this.answer("leave", 1, small, Service::leave)?;
        this.answer("weights-upload", 1, limits.weights, Service::store_weights)?;
        this.answer("weights", WEIGHTS_THREADS, small, Service::send_weights)?;
        this.answer("report", 1, small, Service::report)?;
        this.answer("status", 1, small, Service::status)?;
        this.answer("processes", 1, small, Service::processes)?;
        this.answer("episodes", 1, small, Service::episodes)?;
        Ok((this.queryables, this.threads))
    }

    /// Answers requests `R` of at most `bytes_max` bytes with `answer`, on `threads` threads named `name`.
    fn answer<R: Request + 'static>(
        &mut self,
        name: &'static str,
        threads: usize,
        bytes_max: usize,
        answer: fn(&Service, Incoming<R>),
    ) -> zenoh::Result<()> {
        let gate = self.gate.clone();
        let answer = move |incoming: Incoming<R>| match gate.service.get() {
            Some(service) => answer(service, incoming),
            None => incoming.into_responder().retry_later(&Recovering {
                progress: gate.recovery.progress(),
                config_toml: gate.config_toml.clone(),
            }),
        };
        let gate = self.gate.clone();
        let reject_long = move |bytes| match gate.service.get() {
            Some(service) => {
                let why = format!("it has {bytes} bytes, and in this run at most {bytes_max}");
                service.state().reject(name, &why);
            }
            None => tracing::debug!("a message of {bytes} bytes to {name:?} is too long"),
        };
        let (queryable, workers) =
            answer_queries(self.client, name, threads, bytes_max, answer, reject_long)?;
        self.queryables.push(queryable);
        self.threads.extend(workers);
        Ok(())
    }
}

/// Tracks the connected processes on a separate thread, as the thread that reads the socket must not wait for the replay. The reading
/// thread waits only if [`CHANGES_MAX`] changes are not tracked yet. The separate thread ends when the subscriber is dropped.
fn watch_members(
    client: &RunClient,
    service: &Arc<Service>,
) -> zenoh::Result<(Subscriber<()>, JoinHandle<()>)> {
    let (service, keys) = (service.clone(), client.keys().clone());
    let (sender, receiver) = mpsc::sync_channel::<(Peer, SampleKind)>(CHANGES_MAX);
    let next = move || {
        fail_point::reach("members");
        receiver.recv()
    };
    let thread = spawn("members", move || {
        while let Ok((who, kind)) = next() {
            service.update_connection(who, kind);
        }
    })?;
    let subscriber = client
        .session()
        .liveliness()
        .declare_subscriber(keys.all_liveliness_keys())
        .history(true)
        .callback(move |sample| {
            if let Some(who) = keys.peer(sample.key_expr().as_str()) {
                // The receiving thread ends only after this callback is dropped.
                let _ = sender.send((who, sample.kind()));
            }
        })
        .wait()?;
    Ok((subscriber, thread))
}

impl Service {
    fn start_threads(self: Arc<Self>) -> std::io::Result<Threads> {
        let start = |name: &str, work: fn(&Self)| {
            let service = self.clone();
            spawn(name, move || work(&service))
        };
        let mut threads = vec![
            start("admit", Self::store_parked_chunks)?,
            start("missing", Self::log_missing_processes)?,
        ];
        for i in 0..BATCH_THREADS {
            threads.push(start(&format!("sample-{i}"), Self::serve_parked_requests)?);
        }
        Ok(threads)
    }
}
