//! Chunks, batches and replies that get lost between a replay server and its actors and learner, which retry: each transition is stored
//! once, and no batch counts twice.
//! The test plays the replay server around the real `Replay`; actors and learner use the real code.

use std::{
    collections::BTreeMap,
    ops::Range,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use driml_actor::DeliveryLimits;
use driml_learner::remote::batch_source::ServedBatch;
use driml_protocol::{
    Ack, BatchReply, BatchRequest, Buffer, Chunk, ChunkHeader, ChunkPoll, Horizon, InsertReply,
    Keyed, Keys, Leave, ReplayStatus, Request, RunSpec, ShardCounts, Shutdown, codec, session,
};
use driml_replay_server::{Config, Replay};
use driml_tests::{TestSystem, check_nothing_lost, listen, wait_until};
use zenoh::{
    Session, Wait,
    query::{Query, Queryable},
};

use crate::{
    synthetic::{SyntheticLearner, deliver_numbered},
    system, tiny_replay,
};

/// The number of actors, and of chunks of each actor.
const ACTORS: u32 = 3;
const CHUNKS: u64 = 32;
/// The number of transitions in a chunk.
const STEPS: u32 = 4;
const TRANSITIONS: u64 = ACTORS as u64 * CHUNKS * STEPS as u64;
/// How often each transition is sampled, on average. The probability that a given one is never drawn is exp(-64).
const SAMPLES_PER_TRANSITION: u64 = 64;
const ROWS: u32 = 16;
/// The transitions in a chunk of an actor of a shard.
const SHARD_STEPS: u32 = 8;
/// One of this many batches, or parts of batches, is lost.
const LOSES: u32 = 4;

/// Returns the run spec of the tests that lose chunks.
fn spec() -> RunSpec {
    tiny_replay::spec("c51", Horizon::None {})
}

/// Returns the run spec of the tests that lose batches; its rows have positives.
fn batches_spec() -> RunSpec {
    tiny_replay::spec("driml-randk", Horizon::Uniform { k_max: 2 })
}

/// The endpoint of a replay server, at which a test replies.
struct Endpoint {
    session: Session,
    queryables: Vec<Queryable<()>>,
    system: TestSystem,
}

impl Endpoint {
    fn open() -> Self {
        let system = system();
        Self {
            session: listen(system.endpoint()),
            queryables: Vec::new(),
            system,
        }
    }

    /// Replies to messages of type `M`.
    fn on_message<M: Keyed>(&mut self, answer: impl Fn(Query) + Send + Sync + 'static) {
        let key = Keys::new("driml").unwrap().key::<M>();
        let queryable = self.session.declare_queryable(key).callback(answer).wait();
        self.queryables.push(queryable.unwrap());
    }
}

/// Decides by the number of a message about chunks whether the message arrives, and whether a reply does. A message that does not arrive
/// but has a reply is declined: an earlier one is expected.
type ArrivalRule = fn(u32) -> [bool; 2];

/// A replay server behind a network that loses messages.
struct Server {
    replay: Mutex<Replay>,
    arrival_rule: ArrivalRule,
    messages: AtomicU32,
    /// How often each actor sent `Leave`.
    leaves: Mutex<BTreeMap<u32, u32>>,
    /// Queries that are never answered. They are kept, because dropping a query would notify the actor at once.
    lost: Mutex<Vec<Query>>,
}

impl Server {
    fn new(arrival_rule: ArrivalRule) -> Arc<Self> {
        let config = Config {
            replay_ratio: SAMPLES_PER_TRANSITION as f64,
            ..tiny_replay::config(2 * TRANSITIONS)
        };
        let mut replay = Replay::new(&spec(), &config, ROWS).unwrap();
        for actor in 0..ACTORS {
            tiny_replay::join_actor(&mut replay, actor);
        }
        Arc::new(Self {
            replay: Mutex::new(replay),
            arrival_rule,
            messages: AtomicU32::new(0),
            leaves: Mutex::default(),
            lost: Mutex::default(),
        })
    }

    /// Replies to chunks, polls and leaves as a replay server does, except for lost messages.
    fn serve(self: &Arc<Self>, endpoint: &mut Endpoint) {
        self.on_message::<ChunkHeader>(endpoint, |server, header, payload| {
            let chunk = Chunk::from_payload(header, payload.to_vec().into()).unwrap();
            server.respond(|replay| replay.insert(&chunk))
        });
        self.on_message::<ChunkPoll>(endpoint, |server, poll, _| {
            server.respond(|replay| replay.answer_poll(&poll).expect("nothing is parked here"))
        });
        self.on_message::<Leave>(endpoint, |server, leave, _| {
            let mut leaves = server.leaves.lock().unwrap();
            let tries = leaves.entry(leave.actor).or_default();
            *tries += 1;
            // The first `Leave` does not arrive, and the reply to the second does not.
            if *tries > 1 {
                let refused = server.replay.lock().unwrap().leave(&leave);
                assert_eq!(refused, None);
            }
            (*tries > 2).then_some(Ack)
        });
    }

    fn on_message<M: Request + 'static>(
        self: &Arc<Self>,
        endpoint: &mut Endpoint,
        answer: fn(&Self, M, &[u8]) -> Option<M::Reply>,
    ) {
        let (server, hash) = (self.clone(), spec().hash());
        endpoint.on_message::<M>(move |query| {
            let bytes = query.payload().unwrap().to_bytes();
            let (message, payload) = codec::decode(&bytes, Some(hash)).unwrap();
            match answer(&server, message, payload) {
                Some(reply) => {
                    let reply = codec::encode(hash, &reply, &[]).unwrap();
                    session::answer(&query, reply.into());
                }
                None => server.lost.lock().unwrap().push(query),
            }
        });
    }

    fn respond(&self, handle: impl FnOnce(&mut Replay) -> InsertReply) -> Option<InsertReply> {
        let message = self.messages.fetch_add(1, Ordering::Relaxed);
        let [arrives, is_answered] = (self.arrival_rule)(message);
        let reply = arrives.then(|| handle(&mut self.replay.lock().unwrap()));
        is_answered.then(|| reply.unwrap_or(InsertReply::OutOfOrder { expected: 0 }))
    }

    /// Checks that each actor sent `Leave` until it got a reply.
    fn check_leaves(&self) {
        let leaves = self.leaves.lock().unwrap();
        assert_eq!(leaves.len(), ACTORS as usize, "{leaves:?}");
        assert!(leaves.values().all(|&tries| tries >= 3), "{leaves:?}");
    }

    /// Checks that the replay holds the numbers 0 to `TRANSITIONS`, each once.
    fn check_numbers(&self) {
        let mut replay = self.replay.lock().unwrap();
        replay.check_valid();
        let status = replay.status();
        assert_eq!(status.transitions_inserted, TRANSITIONS, "{status:#?}");
        check_nothing_lost(&status);
        let batches = TRANSITIONS * SAMPLES_PER_TRANSITION / u64::from(ROWS);
        let numbers = tiny_replay::drawn_returns(&mut replay, batches, ROWS);
        // As many transitions are stored as there are numbers: if each number is present, none is stored twice.
        assert_eq!(numbers, (0..TRANSITIONS).collect());
    }
}

/// Delivers the chunks of `ACTORS` actors and checks that the server holds all of them. If `leaving`, the actors are told to stop first.
fn deliver_all(arrival_rule: ArrivalRule, ack_timeout: Duration, leaving: bool) -> Arc<Server> {
    let server = Server::new(arrival_rule);
    let mut endpoint = Endpoint::open();
    server.serve(&mut endpoint);
    let limits = DeliveryLimits {
        chunks_in_flight_max: CHUNKS as usize,
        ack_timeout,
        unreachable_max: Duration::from_secs(60),
    };
    std::thread::scope(|scope| {
        for actor in 0..ACTORS {
            let run = endpoint.system.run_client(&spec());
            let first = tiny_replay::header(&spec(), actor, 1, STEPS);
            scope.spawn(move || deliver_numbered(run, first, CHUNKS, limits, leaving));
        }
    });
    server.check_numbers();
    server.check_leaves();
    server
}

#[test]
fn chunks_and_answers_that_get_lost_leave_each_transition_stored_once() {
    let arrival_rule = |message: u32| [message % 5 != 1, ![1, 3].contains(&(message % 5))];
    let server = deliver_all(arrival_rule, Duration::from_millis(100), false);
    let retried = server.replay.lock().unwrap().status().chunks_retried;
    // Some replies were lost. How many chunks are then sent again, and not just polled, depends on the machine.
    assert!(retried > 0, "answers were to get lost");
}

/// An actor that leaves does not spend its time for delivery on one lost message.
#[test]
fn an_actor_that_leaves_does_not_wait_for_long_before_it_sends_again() {
    let arrival_rule = |message: u32| [message >= 3 * ACTORS; 2];
    deliver_all(arrival_rule, Duration::from_secs(15), true);
}

/// One actor is declined 11 times or more. It pauses for 2 s in all, after each time but the first; two lost `Leave`s take another 2 s.
#[test]
fn a_chunk_that_is_declined_again_and_again_is_not_sent_at_once() {
    let started = Instant::now();
    let arrival_rule = |message: u32| [message >= 11 * ACTORS, true];
    deliver_all(arrival_rule, Duration::from_secs(15), false);
    assert!(started.elapsed() >= Duration::from_secs(4));
}

/// Returns the empty shards of a run of `transitions_max` transitions, each with an actor.
fn empty_shards(shards: u32, slack: u64, transitions_max: Option<u64>) -> Vec<Replay> {
    let config = Config {
        shards,
        transitions_max,
        slack_transitions: slack,
        ..tiny_replay::config(1_000)
    };
    let shard = |shard| {
        let mut replay = Replay::shard(&batches_spec(), &config, ROWS, shard).unwrap();
        tiny_replay::join_actor(&mut replay, 0);
        replay
    };
    (0..shards).map(shard).collect()
}

fn insert(replay: &mut Replay, sequence: u64) -> InsertReply {
    let chunk = tiny_replay::chunk(&batches_spec(), 0, sequence, SHARD_STEPS);
    replay.insert(&chunk)
}

/// Stores the chunks with these sequence numbers.
fn fill_shard(replay: &mut Replay, sequences: Range<u64>) {
    for sequence in sequences {
        let stored = insert(replay, sequence);
        assert!(matches!(stored, InsertReply::Stored { .. }), "{stored:?}");
    }
}

/// Stores as many chunks as the rate limiter of each shard allows, until the run is over.
fn play(replays: &[Arc<Mutex<Replay>>], over: &Shutdown) {
    while !over.wait_timeout(Duration::from_millis(1)) {
        for mut replay in replays.iter().map(|it| it.lock().unwrap()) {
            let is_stored = |replay: &mut Replay| {
                let sequence = replay.counts().inserted / u64::from(SHARD_STEPS);
                matches!(insert(replay, sequence), InsertReply::Stored { .. })
            };
            while is_stored(&mut replay) {}
        }
    }
}

/// Replies as a replay server does, but draws some batches without sending them.
fn reply_with_losses(query: &Query, replay: &Mutex<Replay>, drawn: &AtomicU32) {
    let hash = batches_spec().hash();
    let payload = query.payload().unwrap().to_bytes();
    let (request, _): (BatchRequest, _) = codec::decode(&payload, Some(hash)).unwrap();
    let mut replay = replay.lock().unwrap();
    if let Some(other_shards) = request.other_shards {
        replay.set_other_shards(other_shards).unwrap();
    }
    let message = match replay.draw_for(request.id, request.rows, Buffer::zeroed) {
        Ok(_) if drawn.fetch_add(1, Ordering::Relaxed).is_multiple_of(LOSES) => return,
        Ok(draft) => {
            let (header, payload) = draft.unpack().into_payload();
            codec::encode(hash, &BatchReply::Batch(header), &payload).unwrap()
        }
        Err(not_ready) => codec::encode(hash, &BatchReply::NotReady(not_ready), &[]).unwrap(),
    };
    session::answer(query, message.into());
}

/// The replay servers of some shards, which lose some batches, and a learner connected to them.
struct Shards {
    replays: Vec<Arc<Mutex<Replay>>>,
    drawn: Arc<AtomicU32>,
    learner: SyntheticLearner,
    _endpoints: Vec<Endpoint>,
}

fn serve(shards: Vec<Replay>) -> Shards {
    let drawn = Arc::<AtomicU32>::default();
    let (mut replays, mut endpoints, mut clients) = (vec![], vec![], vec![]);
    for replay in shards {
        let mut endpoint = Endpoint::open();
        let replay = Arc::new(Mutex::new(replay));
        let (state, count) = (replay.clone(), drawn.clone());
        endpoint.on_message::<BatchRequest>(move |query| reply_with_losses(&query, &state, &count));
        let state = replay.clone();
        endpoint.on_message::<ReplayStatus>(move |query| {
            let status = state.lock().unwrap().status();
            let bytes = codec::encode(batches_spec().hash(), &status, &[]).unwrap();
            session::answer(&query, bytes.into());
        });
        clients.push(endpoint.system.run_client(&batches_spec()));
        replays.push(replay);
        endpoints.push(endpoint);
    }
    let learner = SyntheticLearner::start(&clients, 1, ROWS, 2);
    Shards {
        replays,
        drawn,
        learner,
        _endpoints: endpoints,
    }
}

/// Tests a replay of one shard, and a replay of three shards, whose batches have parts. Each shard stores all that its limiter allows, by
/// counts of the others that are as old as the learner's last request, so that the run exceeds its length: by less than the documented bound.
#[test]
fn lost_batches_and_lost_parts_of_batches_do_not_count() {
    let slack = 64;
    for shards in [1, 3] {
        let mut served = serve(empty_shards(shards, slack, Some(TRANSITIONS)));
        let (replays, over) = (served.replays.clone(), Shutdown::default());
        let ended = over.clone();
        let actors = std::thread::spawn(move || play(&replays, &ended));
        let mut batches = 0;
        while let Some(ServedBatch { batch, parts }) = served.learner.next() {
            assert_eq!(batch.rows(), ROWS as usize);
            assert_eq!(parts.iter().map(|it| it.rows).sum::<u32>(), ROWS);
            batches += 1;
        }
        over.set();
        actors.join().unwrap();
        let statuses = served.replays.iter().map(|replay| {
            let replay = replay.lock().unwrap();
            replay.check_valid();
            replay.status()
        });
        let status = ReplayStatus::merged(&statuses.collect::<Vec<_>>());
        assert_eq!(status.rows_sampled, batches * u64::from(ROWS));
        assert!(batches >= TRANSITIONS / u64::from(ROWS), "{status:#?}");
        let excess_max = u64::from(shards) * (slack + u64::from(2 * ROWS + SHARD_STEPS));
        let excess = 0..if shards == 1 { 1 } else { excess_max };
        let found = status.transitions_inserted - TRANSITIONS;
        assert!(excess.contains(&found), "{found} of {excess:?}");
        let lost = served.drawn.load(Ordering::Relaxed).div_ceil(LOSES);
        assert!(lost >= 5, "some were to get lost: {lost}");
        assert_eq!(status.batches_retried, u64::from(lost));
        served.learner.end();
    }
}

/// A shard whose actors started late is drawn from once it holds transitions, although the others never make the learner wait.
#[test]
fn a_shard_that_fills_late_is_asked() {
    let mut shards = empty_shards(2, 1_000, None);
    fill_shard(&mut shards[0], 0..8);
    let mut served = serve(shards);
    for batches in 0..1_000 {
        let parts = served.learner.next().unwrap().parts;
        if parts.iter().any(|part| part.shard == 1) {
            assert!(batches > 3, "it held nothing");
            served.learner.end();
            return;
        }
        let replays: Vec<_> = served.replays.iter().map(|it| it.lock().unwrap()).collect();
        let [mut first, mut second] = <[_; 2]>::try_from(replays).ok().unwrap();
        fill_shard(&mut first, 8 + 2 * batches..10 + 2 * batches);
        if batches == 3 {
            fill_shard(&mut second, 0..8);
        }
    }
    panic!("a shard that holds something is never drawn from");
}

/// The transitions of a shard whose actor has left may all lack later steps. The other shard then sends the rows of all batches.
#[test]
fn a_shard_without_an_anchor_holds_up_no_batch() {
    const CHUNKS: u64 = 32;
    let first_steps = tiny_replay::header(&batches_spec(), 0, 100, 1);
    let stored = u64::from(SHARD_STEPS) * CHUNKS + first_steps.transitions() as u64;
    let mut shards = empty_shards(2, 1_000, Some(stored));
    shards[1].insert(&Chunk::zeroed(first_steps));
    fill_shard(&mut shards[0], 0..CHUNKS / 2);
    let mut served = serve(shards);
    for _ in 0..2 {
        served.learner.next().expect("more transitions will come");
    }
    fill_shard(&mut served.replays[0].lock().unwrap(), CHUNKS / 2..CHUNKS);
    let mut batches = 2;
    while let Some(ServedBatch { parts, .. }) = served.learner.next() {
        assert!(parts.iter().all(|it| it.shard == 0), "{parts:?}");
        batches += 1;
    }
    assert_eq!(batches, stored / u64::from(ROWS));
    served.learner.end();
}

/// A shard's inserts wait while its count of the other shard's rows is old. The next draw request to the shard updates the count.
#[test]
fn a_shard_that_waits_hears_what_the_other_gave() {
    let slack = 1_000;
    let mut shards = empty_shards(2, slack, None);
    // Most batches are drawn from the first shard alone.
    fill_shard(&mut shards[0], 0..slack / 8);
    fill_shard(&mut shards[1], 0..1);
    let mut served = serve(shards);
    let held = slack + 8;
    for _ in 0..held / u64::from(ROWS) {
        served.learner.next().unwrap();
    }
    let insert_second = |others| {
        let mut replay = served.replays[1].lock().unwrap();
        if let Some(others) = others {
            replay.set_other_shards(others).unwrap();
        }
        insert(&mut replay, 1)
    };
    let actors_ahead = ShardCounts::new(2 * slack, 0);
    let reply = insert_second(Some(actors_ahead));
    assert!(matches!(reply, InsertReply::Wait { .. }), "{reply:?}");
    wait_until("the shard's inserts wait no more", || {
        matches!(insert_second(None), InsertReply::Stored { .. })
    });
    served.learner.end();
}
