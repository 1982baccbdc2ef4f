//! Starts the replay server and ends it: settings, session, everything that it answers, and the threads that do.
//! What an answer is, is in the files named for the messages.

use std::{
    collections::{HashMap, VecDeque},
    path::PathBuf,
    sync::{Arc, Condvar, Mutex, OnceLock, mpsc},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use driml_protocol::{
    Alive, BatchHeader, BufferPool, Incoming, Keys, POOL_BATCHES, QueryWorkers, Request, RunClient,
    RunSpec, Sampling, Shutdown,
    config::{Settings, TransportConfig},
    fail_point, join_within,
    session::{self, Endpoints},
    shared_memory,
    tls::Credentials,
};
use zenoh::{Wait, pubsub::Subscriber, query::Queryable, sample::SampleKind};

use super::{
    limits::{HEAD_BYTES_MAX, Limits, number, shared_memory_bytes},
    parked::ParkedChunks,
    participants::Participants,
    server::{Admission, Service, State},
    timings::Timings,
    weights_store::WeightsStore,
};
use crate::{
    config::Config,
    persist::{KeptReplay, PersistArgs, PersistError, Reading, shard_dir},
    replay::Replay,
};

/// Threads that make batches: one assembles while another's reply is being sent.
const BATCH_THREADS: usize = 2;
/// Threads that send weights: an actor that stands still holds one of them until its link is given up.
const WEIGHTS_THREADS: usize = 4;

/// Most that a question about a chunk is held.
const HOLD_MAX: Duration = Duration::from_secs(2);

/// Pieces of memory kept for later chunks and batches.
const SPARE_MAX: usize = 8;

const THREADS_END_MAX: Duration = Duration::from_secs(2);

/// What a replay server is told at its start.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// Endpoints to listen on.
    pub listen: Vec<String>,
    /// Routers to connect to, if any.
    pub connect: Vec<String>,
    /// With which certificate it takes part; none without TLS.
    pub credentials: Option<Arc<Credentials>>,
    /// Prefix of the run's keys.
    pub namespace: String,
    /// Which of the replay's shards this is, from 0.
    pub shard: u32,
    /// Bytes of a version of the weights, of which the replay server itself knows nothing; longer uploads are refused.
    pub weights_bytes_max: usize,
    /// The folder in which the replay is kept, if it is kept on disk. Each of several shards has its own folder in it.
    pub dir: Option<PathBuf>,
    /// Stay when the run is over, to be asked, until `ending` or `shutdown`.
    pub keep_alive: bool,
    /// Raised when this process is to exit once the other processes have delivered what they have and left: its launcher has died,
    /// which ends them too. It waits for them no longer than 10 s. To end it at once, raise this and `shutdown`.
    pub ending: Shutdown,
    /// The run's resolved settings, which it sends to each process that joins.
    pub config_toml: String,
}

/// Runs the replay server until its run is over, `args.ending` or `shutdown`, and returns whether the run is over.
pub fn run(args: RunArgs, shutdown: &Shutdown) -> anyhow::Result<bool> {
    let settings = Settings::parse(&args.config_toml)?;
    let spec: RunSpec = settings.table("run")?;
    spec.validate()?;
    let config: Config = settings.table("replay")?;
    let batch_size = number(&settings, "learner", "batch_size")?;
    let ack_timeout = Duration::from_millis(number(&settings, "actor", "ack_timeout_ms")?.into());
    let empty = Replay::shard(&spec, &config, batch_size, args.shard)?;
    let kept = args.dir.as_ref().map(|dir| {
        let args = PersistArgs {
            dir: shard_dir(dir, args.shard, config.shards),
            shard: args.shard,
            segment_bytes: None,
            mark: None,
        };
        KeptReplay::find(&args, &spec, &config)
    });
    let kept = kept.transpose()?;
    let transport: TransportConfig = settings.table("transport")?;
    let batch = BatchHeader::of(&spec, batch_size).sampled_by(&config.sampling);
    // Of the whole run: where it does not fit, all go through sockets.
    let needed = shared_memory_bytes(&settings, 1)?;
    let is_granted =
        transport.shared_memory && shared_memory::is_granted(shared_memory::check_room(needed));
    let pool = if is_granted {
        BufferPool::shared(SPARE_MAX, POOL_BATCHES, batch.payload_bytes())
    } else {
        BufferPool::new(SPARE_MAX)
    };
    let slower =
        |why: &String| tracing::warn!("chunks come through sockets, which is slower: {why}");
    let is_lockable = || shared_memory::check_lockable(needed).inspect_err(slower);
    let reads_shared_memory = is_granted && is_lockable().is_ok();
    let limits = Limits::of(&settings, &spec, args.weights_bytes_max)?;
    let keys = Keys::new(&args.namespace).map_err(anyhow::Error::msg)?;
    let endpoints = Endpoints {
        listen: args.listen.clone(),
        connect: args.connect,
    };
    let session = session::open_as(
        &endpoints,
        &keys,
        args.credentials.as_deref(),
        limits.largest(),
    )?;
    let client = RunClient::new(session, keys, spec.hash());
    let declaring =
        |e: zenoh::Error| anyhow::anyhow!("declaring what the replay server answers: {e}");
    let admission = Arc::new(Admission {
        service: OnceLock::new(),
        reading: Reading::begin(args.ending.clone()),
        config_toml: args.config_toml.clone(),
    });
    let answers = Queries::declare(&client, &admission, limits, &config.sampling);
    let (queryables, mut threads) = answers.map_err(declaring)?;
    tracing::info!(
        "replay server listens on {:?}, run {:016x}",
        args.listen,
        client.spec_hash()
    );
    let read = match kept {
        Some(kept) => read(kept, empty, &admission.reading, spec.hash()),
        None => Ok((empty, WeightsStore::default())),
    };
    let (mut replay, weights) = match read {
        Ok(read) => read,
        Err(e) => {
            // So that those who wait for the replay notice at once that the server is gone.
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
    // Of this process alone, so that priorities of rows that an earlier one drew do not count for other rows.
    replay.origin.incarnation = rand::random();
    let service = Arc::new(Service {
        limits,
        shard: (args.shard, config.shards),
        config_toml: args.config_toml,
        shared_memory: reads_shared_memory,
        hold_max: HOLD_MAX.min(ack_timeout / 4),
        pool,
        packer: replay.packer(),
        state: Mutex::new(State {
            replay,
            participants: Participants::new(Instant::now()),
            chunks: ParkedChunks::new(),
            requests: VecDeque::new(),
            timings: Timings::default(),
            said: HashMap::new(),
        }),
        changed: Condvar::new(),
        weights: Mutex::new(weights),
        announcements: client.announce().map_err(declaring)?,
        shutdown: shutdown.clone(),
    });
    let (alive, members) = watch_members(&client, &service)
        .map_err(|e| anyhow::anyhow!("watching for actors and learner: {e}"))?;
    let opened = admission.service.set(service.clone());
    assert!(opened.is_ok(), "a replay is read back once");
    threads.extend(service.clone().start_working()?);
    threads.push(members);
    service.wait_until_over(&args.ending, args.keep_alive);
    // Its threads wait for that.
    shutdown.set();
    service.changed.notify_all();
    tracing::info!(
        "replay server stops with {} transitions stored",
        service.state().replay.inserted_total()
    );
    drop(alive);
    let closed = close(&client, queryables, threads);
    let mut state = service.state();
    if let Some(log) = &mut state.replay.log {
        log.flush();
    }
    if let Some(counts) = state.replay.priority_counts() {
        tracing::info!(
            "priorities of {} rows were set, {} came too late for their transition, {} came twice",
            counts.set,
            counts.gone,
            counts.repeated
        );
    }
    closed.map(|()| state.participants.is_over())
}

/// Ends the answers: without the queryables no more comes, without the session none is sent to a slow client, and the threads end.
fn close(client: &RunClient, queryables: Queryables, threads: Threads) -> anyhow::Result<()> {
    drop(queryables);
    let closed = client.session().close().wait();
    join_within(threads, THREADS_END_MAX);
    closed.map_err(|e| anyhow::anyhow!("closing the session: {e}"))
}

/// Reads what is kept into `empty`, with the newest weights that were handed over to that replay, and logs what was found.
fn read(
    kept: KeptReplay,
    empty: Replay,
    reading: &Reading,
    spec_hash: u64,
) -> Result<(Replay, WeightsStore), PersistError> {
    let (started, folder) = (Instant::now(), kept.dir().to_owned());
    let (replay, recovery) = kept.read(empty, reading)?;
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
                "priorities are those of the last checkpoint: each transition that came later has the highest one"
            );
        }
    } else {
        tracing::info!("keeps the replay in {dir}");
    }
    let weights = WeightsStore::kept_in(&folder, spec_hash, recovery.found);
    Ok((replay, weights))
}

type Queryables = Vec<Queryable<()>>;
type Threads = Vec<JoinHandle<()>>;

/// Everything that the replay server answers: each kind of message by separate threads.
struct Queries<'a> {
    client: &'a RunClient,
    admission: &'a Arc<Admission>,
    queryables: Queryables,
    threads: Threads,
}

impl<'a> Queries<'a> {
    /// Declares all of it, where rows are drawn by `sampling`. Until the admission is open every query is answered with "retry". Dropping
    /// the queryables ends the answers, and with them the threads.
    fn declare(
        client: &'a RunClient,
        admission: &'a Arc<Admission>,
        limits: Limits,
        sampling: &Sampling,
    ) -> zenoh::Result<(Queryables, Threads)> {
        let mut this = Self {
            client,
            admission,
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
        this.answer("join-actor", 1, small, Service::join_actor)?;
        this.answer("join-learner", 1, small, Service::join_learner)?;
        this.answer("leave", 1, small, Service::leave)?;
        this.answer("weights-upload", 1, limits.weights, Service::take_weights)?;
        this.answer("weights", WEIGHTS_THREADS, small, Service::give_weights)?;
        this.answer("report", 1, small, Service::report)?;
        this.answer("status", 1, small, Service::status)?;
        this.answer("processes", 1, small, Service::processes)?;
        this.answer("episodes", 1, small, Service::episodes)?;
        Ok((this.queryables, this.threads))
    }

    /// Answers requests `R` of at most `bytes_max` bytes with `answer`, on so many threads of this name.
    fn answer<R: Request + 'static>(
        &mut self,
        name: &'static str,
        threads: usize,
        bytes_max: usize,
        answer: fn(&Service, Incoming<R>),
    ) -> zenoh::Result<()> {
        let (admission, spec_hash) = (self.admission.clone(), self.client.spec_hash());
        let answer = move |incoming: Incoming<R>| match admission.service.get() {
            Some(service) => answer(service, incoming),
            None => incoming.into_responder().put_off(&admission.put_off()),
        };
        let workers = QueryWorkers::start(name, threads, spec_hash, answer)?;
        let admission = self.admission.clone();
        let refused = move |bytes| match admission.service.get() {
            Some(service) => service.refuse_long(name, bytes, bytes_max),
            None => tracing::debug!("a message of {bytes} bytes to {name:?} is too long"),
        };
        let queryable = workers.declare(self.client, bytes_max, refused)?;
        self.queryables.push(queryable);
        self.threads.extend(workers.into_threads());
        Ok(())
    }
}

/// Keeps track of who is connected, on a thread that ends when the subscriber is dropped: the one that reads the socket must not wait for
/// the replay.
fn watch_members(
    client: &RunClient,
    service: &Arc<Service>,
) -> zenoh::Result<(Subscriber<()>, JoinHandle<()>)> {
    let (service, keys) = (service.clone(), client.keys().clone());
    let (noted, members) = mpsc::channel::<(Alive, SampleKind)>();
    let next = move || {
        fail_point::reach("members");
        members.recv().ok()
    };
    let thread = std::thread::Builder::new()
        .name("members".into())
        .spawn(move || {
            std::iter::from_fn(next).for_each(|(who, kind)| service.note_alive(who, kind));
        })?;
    let subscriber = client
        .session()
        .liveliness()
        .declare_subscriber(keys.all_alive())
        .history(true)
        .callback(move |sample| {
            if let Some(who) = keys.alive(sample.key_expr().as_str()) {
                // It ends after this.
                let _ = noted.send((who, sample.kind()));
            }
        })
        .wait()?;
    Ok((subscriber, thread))
}

impl Service {
    fn start_working(self: Arc<Self>) -> std::io::Result<Threads> {
        let work = |name: &str, work: fn(&Self)| {
            let service = self.clone();
            std::thread::Builder::new()
                .name(name.into())
                .spawn(move || work(&service))
        };
        let mut threads = vec![
            work("admit", Self::admit_parked)?,
            work("missing", Self::say_who_is_missing)?,
        ];
        for i in 0..BATCH_THREADS {
            threads.push(work(&format!("sample-{i}"), Self::serve_parked)?);
        }
        Ok(threads)
    }
}
