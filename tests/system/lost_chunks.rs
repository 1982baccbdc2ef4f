//! Chunks, and answers about chunks, that get lost between the actors and the replay server: each transition is stored once.
//! The replay server is played by the test, around the real replay; the actors' side is the real one.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use driml_actor::DeliveryLimits;
use driml_protocol::{
    Ack, Chunk, ChunkHeader, ChunkPoll, Horizon, InsertReply, Keys, Leave, RunClient, RunSpec,
    Shutdown, codec, session,
};
use driml_replay_server::{Config, Replay};
use driml_tests::{check_nothing_lost, connect, listen};
use zenoh::{
    Session, Wait,
    query::{Query, Queryable},
};

use crate::{synthetic_actor::SyntheticActor, tiny_replay};

/// Actors, and chunks of each.
const ACTORS: u32 = 3;
const CHUNKS: u64 = 32;
/// Transitions of one chunk.
const STEPS: u32 = 4;
const TRANSITIONS: u64 = ACTORS as u64 * CHUNKS * STEPS as u64;
/// How often each transition is sampled, on average: that one is never drawn has a probability of exp(-64).
const SAMPLED: u64 = 64;
const ROWS: u32 = 64;

fn spec() -> RunSpec {
    tiny_replay::spec("c51", Horizon::None {})
}

/// What the network does to messages about chunks.
#[derive(Clone, Copy)]
enum Loses {
    /// Of each five, one does not arrive, and the answer to another one does not.
    TwoOfFive,
    /// The first few do not arrive, the others do.
    First(u32),
}

/// A replay server behind a network that loses messages.
struct Server {
    replay: Mutex<Replay>,
    loses: Loses,
    messages: AtomicU32,
    /// How often each actor sent `Leave`.
    leaves: Mutex<BTreeMap<u32, u32>>,
    /// What is never answered; a query that is dropped would tell the actor so at once.
    lost: Mutex<Vec<Query>>,
}

impl Server {
    fn new(loses: Loses) -> Arc<Self> {
        let config = Config {
            replay_ratio: SAMPLED as f64,
            ..tiny_replay::config(2 * TRANSITIONS)
        };
        let mut replay = Replay::new(&spec(), &config, ROWS).unwrap();
        for actor in 0..ACTORS {
            tiny_replay::join(&mut replay, actor);
        }
        Arc::new(Self {
            replay: Mutex::new(replay),
            loses,
            messages: AtomicU32::new(0),
            leaves: Mutex::default(),
            lost: Mutex::default(),
        })
    }

    /// Answers about chunks and leaves as a replay server does, but for what is lost.
    fn declare(self: &Arc<Self>, session: &Session, keys: &Keys) -> Vec<Queryable<()>> {
        let declare = |key, answer: fn(&Self, &[u8]) -> Option<Vec<u8>>| {
            let server = self.clone();
            let answer = move |query: Query| {
                let payload = query.payload().unwrap().to_bytes();
                match answer(&server, &payload) {
                    Some(reply) => session::answer(&query, reply.into()),
                    None => server.lost.lock().unwrap().push(query),
                }
            };
            session.declare_queryable(key).callback(answer).wait()
        };
        let leave = |server: &Self, payload: &[u8]| {
            let hash = spec().hash();
            let leave = codec::decode::<Leave>(payload, Some(hash)).unwrap().0;
            let tries = server.count_leave(leave.actor);
            // The first does not arrive, and the answer to the second does not.
            if tries > 1 {
                let refused = server.replay.lock().unwrap().leave(&leave);
                assert_eq!(refused, None);
            }
            (tries > 2).then(|| codec::encode(hash, &Ack, &[]).unwrap())
        };
        let insert = |server: &Self, payload: &[u8]| {
            let chunk = Chunk::decode(payload, spec().hash()).unwrap();
            server.lossy(|replay| replay.insert(&chunk))
        };
        let poll = |server: &Self, payload: &[u8]| {
            let poll = codec::decode::<ChunkPoll>(payload, Some(spec().hash()));
            let poll = poll.unwrap().0;
            server.lossy(|replay| replay.poll(&poll).expect("nothing is parked here"))
        };
        [
            declare(keys.of::<ChunkHeader>(), insert),
            declare(keys.of::<ChunkPoll>(), poll),
            declare(keys.of::<Leave>(), leave),
        ]
        .map(Result::unwrap)
        .into()
    }

    /// Counts a `Leave` of this actor; gives how often it has said it.
    fn count_leave(&self, actor: u32) -> u32 {
        let mut leaves = self.leaves.lock().unwrap();
        let tries = leaves.entry(actor).or_default();
        *tries += 1;
        *tries
    }

    fn lossy(&self, judge: impl FnOnce(&mut Replay) -> InsertReply) -> Option<Vec<u8>> {
        let message = self.messages.fetch_add(1, Ordering::Relaxed);
        let (arrives, is_answered) = match self.loses {
            Loses::TwoOfFive => (message % 5 != 1, message % 5 != 3),
            Loses::First(count) => (message >= count, true),
        };
        let reply = arrives.then(|| judge(&mut self.replay.lock().unwrap()))?;
        is_answered.then(|| codec::encode(spec().hash(), &reply, &[]).unwrap())
    }

    /// Checks that each actor sent `Leave` until it was answered.
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
        let batches = TRANSITIONS * SAMPLED / u64::from(ROWS);
        let numbers = tiny_replay::numbers(&mut replay, batches, ROWS);
        // As many are stored as there are numbers: if each number is there, none is there twice.
        assert_eq!(numbers, (0..TRANSITIONS).collect());
    }
}

/// Delivers the chunks of `ACTORS` actors to `server`, which are about to leave or not.
fn deliver_all(server: &Arc<Server>, ack_timeout: Duration, leaving: bool) {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = format!("unixsock-stream/{}/server.sock", folder.path().display());
    let listening = listen(&endpoint);
    let keys = Keys::new("lossy").unwrap();
    let declared = server.declare(&listening, &keys);
    let limits = DeliveryLimits {
        chunks_in_flight_max: CHUNKS as usize,
        ack_timeout,
        unreachable_max: Duration::from_secs(60),
    };
    std::thread::scope(|scope| {
        for actor in 0..ACTORS {
            let run = RunClient::new(connect(&endpoint), keys.clone(), spec().hash());
            scope.spawn(move || {
                let stop = Shutdown::default();
                let first = tiny_replay::chunk(&spec(), actor, 0, STEPS).header;
                let mut synthetic = SyntheticActor::start(run, first, limits, &stop);
                if leaving {
                    stop.set();
                }
                let number = u64::from(actor) * CHUNKS * u64::from(STEPS);
                (0..CHUNKS).for_each(|_| synthetic.send(number));
                synthetic.finish();
            });
        }
    });
    drop(declared);
}

#[test]
fn chunks_and_answers_that_get_lost_leave_each_transition_stored_once() {
    let server = Server::new(Loses::TwoOfFive);
    deliver_all(&server, Duration::from_millis(100), false);
    server.check_numbers();
    server.check_leaves();
    let retried = server.replay.lock().unwrap().status().chunks_retried;
    // Some answers were lost; how many chunks came again for it, and were not just asked about, is the machine's.
    assert!(retried > 0, "answers were to get lost");
}

/// The time in which an actor that leaves must deliver is not spent on one message that was lost.
#[test]
fn an_actor_that_leaves_does_not_wait_for_long_before_it_sends_again() {
    let server = Server::new(Loses::First(3 * ACTORS));
    deliver_all(&server, Duration::from_secs(15), true);
    server.check_numbers();
    server.check_leaves();
}
