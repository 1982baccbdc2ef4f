//! Well-formed lies: a second client that knows the run's hash and says of each kind of message what nobody would.
//! Each is refused, counted, and logged at a bounded rate; the run goes on. Malformed messages are in `bad_messages`.

use std::{
    fs,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use driml_protocol::{
    ActorJoin, AffinityUpdate, Alive, BatchReply, BatchRequest, Chunk, ChunkHeader, Claim,
    CodecError, Goodbye, InsertReply, JoinReply, Learned, LearnerJoin, Message, Origin,
    PriorityPart, PriorityUpdate, ReplayStatus, RequestId, Tally, WeightsHeader, WeightsReply,
    WeightsRequest, WeightsUpload, WeightsVersion, codec, session,
};
use driml_tests::{Client, Process, TestSystem, new_learner, wait_for};
use zenoh::{Wait, qos::Priority, query::Query};

use crate::{LONG, PRIORITISED, launched, system};

/// Nobody's numbers.
const LIFE: u64 = 77;
const LEARNER: u64 = 78;
/// An actor's number that nobody has.
const STRANGER: u32 = 500;
/// How long an answer is waited for that does not come.
const NO_ANSWER: Duration = Duration::from_millis(700);

/// A launched run, and a second client of it.
struct Lied {
    client: Client,
    run: Process,
    system: TestSystem,
}

fn lied() -> Lied {
    let system = system();
    let run = launched(&system, 20);
    let client = system.connect();
    Lied {
        client,
        run,
        system,
    }
}

fn sealed<M: Message>(client: &Client, message: &M) -> Vec<u8> {
    codec::encode(client.spec.hash(), message, &[]).unwrap()
}

impl Lied {
    fn status(&self) -> ReplayStatus {
        self.client.replay().unwrap()
    }

    /// Sends bytes and reads the reply.
    fn reply<M: Message>(&self, key: &str, bytes: Vec<u8>) -> M {
        let reply = self.client.ask(key, bytes).unwrap();
        codec::decode(&reply, Some(self.client.spec.hash()))
            .unwrap()
            .0
    }

    /// Sends bytes to where nothing is promised to a liar.
    fn unanswered(&self, key: &str, bytes: Vec<u8>) {
        let bytes = bytes.into();
        let asked = session::ask(&self.client.session, key, bytes, Priority::Data, NO_ANSWER);
        assert!(asked.is_err(), "{key}: {asked:?}");
    }

    /// So many more messages were refused since `before`.
    fn counted(&self, before: &ReplayStatus, lies: u64) {
        // The last one may still be on its way through a busy server.
        let status = self.client.wait_for_replay("all lies", |replay| {
            replay.messages_refused >= before.messages_refused + lies
        });
        assert_eq!(status.messages_refused - before.messages_refused, lies);
    }

    /// The run goes on with its own numbers, and its log is short.
    fn goes_on(self) {
        let updates = self.client.learner().unwrap().updates;
        let before = self.status();
        self.client
            .wait_for_learner("more updates", |learner| learner.updates > updates + 20);
        let status = self.client.wait_for_replay("more transitions", |replay| {
            replay.transitions_inserted > before.transitions_inserted + 100
        });
        assert_eq!(
            (status.transitions_lost, status.transitions_duplicated),
            (0, 0)
        );
        assert_eq!((status.actors, status.finished), (1, false));
        assert!(status.affinity_version < 1 << 20, "{status:#?}");
        let learner = self.client.learner().unwrap();
        assert!(learner.weights_version < 1 << 20, "{learner:#?}");
        let log = fs::read_to_string(self.system.path("run/logs/replay-server.log")).unwrap();
        let lines = log.lines().filter(|line| line.contains("refused")).count();
        assert!((1..30).contains(&lines), "{lines} lines: {log}");
        drop(self.client);
        self.run.stop().expect_code(130);
    }
}

#[test]
fn of_joining() {
    let lied = lied();
    let (client, before) = (&lied.client, lied.status());
    for rows_sampled in [0, 1 << 60, u64::MAX] {
        let learner = LearnerJoin {
            tally: Tally {
                inserted: 0,
                rows_sampled,
            },
            ..new_learner(LEARNER)
        };
        let key = client.keys.of::<LearnerJoin>();
        let reply: JoinReply = lied.reply(&key, sealed(client, &learner));
        assert!(matches!(&reply, JoinReply::Taken { .. }), "{reply:?}");
    }
    let actor = ActorJoin {
        actor: 0,
        incarnation: LIFE,
    };
    let key = client.keys.of_actor::<ActorJoin>(0);
    let reply: JoinReply = lied.reply(&key, sealed(client, &actor));
    assert!(matches!(&reply, JoinReply::Taken { .. }), "{reply:?}");
    lied.counted(&before, 0);
    // As another number than its key's.
    let key = client.keys.of_actor::<ActorJoin>(STRANGER);
    for _ in 0..50 {
        lied.unanswered(&key, sealed(client, &actor));
        if lied.status().messages_refused > before.messages_refused + 3 {
            break;
        }
    }
    lied.goes_on();
}

/// Without certificates everybody may offer to answer what is the replay server's to answer.
#[test]
fn of_who_answers() {
    let lied = lied();
    let liar = lied.system.connect();
    let asked = Arc::<AtomicUsize>::default();
    let count = asked.clone();
    let answer = move |query: Query| {
        count.fetch_add(1, Ordering::Relaxed);
        session::answer(&query, b"lies".to_vec().into());
    };
    let queryable = liar.session.declare_queryable("driml/**").complete(true);
    let _lies = queryable.callback(answer).wait().unwrap();
    let learned = || lied.client.learner().expect("it is there").updates;
    let before = learned();
    wait_for("200 lies, and the run beside them", || {
        let is_learning = learned() > before + 200;
        (is_learning && asked.load(Ordering::Relaxed) > 200).then_some(())
    });
    let log = fs::read_to_string(lied.system.path("run/logs/actor-0.log")).unwrap();
    assert!(!log.contains("will be sent again"), "{log}");
    lied.run.stop().expect_code(130);
}

/// More than a run may have, twice over; then one that is no stranger.
#[test]
fn of_4096_strangers() {
    let lied = lied();
    let client = &lied.client;
    let tokens: Vec<_> = (0..300)
        .map(|mark| client.run().declare_alive(Alive::Learner { mark }).unwrap())
        .collect();
    for number in 0..2 * 4096 {
        let actor = STRANGER + number;
        let join = ActorJoin {
            actor,
            incarnation: LIFE,
        };
        let key = client.keys.of_actor::<ActorJoin>(actor);
        let reply: JoinReply = lied.reply(&key, sealed(client, &join));
        assert!(
            matches!(&reply, JoinReply::Welcome { .. }),
            "{number}: {reply:?}"
        );
    }
    drop(tokens);
    assert_eq!(lied.status().actors, 1);
    let mut actor = lied.system.start_actor(7);
    actor.wait_for_stderr("actor 7 steps");
    client.wait_for_replay("two actors", |replay| replay.actors_acting == 2);
    actor.stop().expect_code(0).expect_said("leaves: ");
    client.wait_for_replay("one actor", |replay| replay.actors == 1);
    // Those who were forgotten, and who say what they will.
    let before = lied.status();
    let goodbye = Goodbye {
        actor: STRANGER,
        incarnation: LIFE,
        produced: 1 << 60,
    };
    let key = client.keys.of_actor::<Goodbye>(STRANGER);
    client.ask(&key, sealed(client, &goodbye)).unwrap();
    lied.counted(&before, 1);
    lied.goes_on();
}

#[test]
fn of_goodbyes() {
    let lied = lied();
    let (client, before) = (&lied.client, lied.status());
    client.join_as_actor(STRANGER, LIFE);
    for (actor, incarnation, produced) in [
        (0, LIFE, 0),
        (0, LIFE, u64::MAX),
        (0, u64::MAX, 1000),
        (STRANGER, LIFE + 1, 1000),
        (STRANGER, LIFE, 1 << 60),
        (STRANGER + 1, LIFE, 1 << 60),
    ] {
        let goodbye = Goodbye {
            actor,
            incarnation,
            produced,
        };
        let key = client.keys.of_actor::<Goodbye>(actor);
        client.ask(&key, sealed(client, &goodbye)).unwrap();
    }
    lied.counted(&before, 6);
    for _ in 0..1000 {
        let goodbye = Goodbye {
            actor: 0,
            incarnation: LIFE,
            produced: 1,
        };
        let key = client.keys.of_actor::<Goodbye>(0);
        client.ask(&key, sealed(client, &goodbye)).unwrap();
    }
    lied.counted(&before, 1006);
    lied.goes_on();
}

#[test]
fn of_chunks_and_claims() {
    let lied = lied();
    let (client, before) = (&lied.client, lied.status());
    client.join_as_actor(STRANGER, LIFE);
    let honest = ChunkHeader {
        actor: STRANGER,
        incarnation: LIFE,
        sequence: 0,
        first_transition: 0,
        weights_version: 1,
        leaving: true,
        streams: 1,
        steps: 2,
        frame_bytes: client.spec.frame_bytes() as u32,
    };
    let refused = |header: ChunkHeader, words: &str| {
        let reply = client.insert(&Chunk::zeroed(header));
        assert!(
            matches!(&reply, InsertReply::Refused { why } if why.contains(words)),
            "{words}: {reply:?}"
        );
    };
    refused(
        ChunkHeader { actor: 0, ..honest },
        "does not know this life of actor 0",
    );
    refused(
        ChunkHeader {
            sequence: u64::MAX,
            ..honest
        },
        "counts that no run reaches",
    );
    for first_transition in [1 << 60, u64::MAX - 1] {
        let header = ChunkHeader {
            first_transition,
            ..honest
        };
        refused(header, "counts that no run reaches");
    }
    for weights_version in [1 << 60, u64::MAX] {
        let header = ChunkHeader {
            weights_version,
            ..honest
        };
        refused(header, "acted, and the newest are");
    }
    let claim = Claim {
        actor: 0,
        incarnation: LIFE,
        sequence: u64::MAX,
        leaving: true,
    };
    let key = client.keys.of_actor::<Claim>(0);
    let reply: InsertReply = lied.reply(&key, sealed(client, &claim));
    assert!(matches!(&reply, InsertReply::Refused { .. }), "{reply:?}");
    lied.counted(&before, 7);
    lied.goes_on();
}

#[test]
fn of_batches_and_affinity() {
    let lied = lied();
    let (client, before) = (&lied.client, lied.status());
    let tally = Tally {
        inserted: u64::MAX,
        rows_sampled: u64::MAX,
    };
    for (rows, other_shards) in [(16, None), (u32::MAX, None), (16, Some(tally)), (0, None)] {
        let request = BatchRequest {
            learner: LEARNER,
            id: RequestId::first(u64::MAX),
            rows,
            shared_memory: true,
            learned: Learned::default(),
            other_shards,
        };
        let key = client.keys.of::<BatchRequest>();
        let reply: BatchReply = lied.reply(&key, sealed(client, &request));
        assert!(matches!(&reply, BatchReply::Refused { .. }), "{reply:?}");
    }
    let side = client.spec.num_actions;
    for version in [1, 1 << 60, u64::MAX] {
        let affinity = AffinityUpdate {
            learner: LEARNER,
            version,
            num_actions: side,
            matrix: vec![1.0; (side * side) as usize],
        };
        lied.unanswered(
            &client.keys.of::<AffinityUpdate>(),
            sealed(client, &affinity),
        );
    }
    lied.counted(&before, 7);
    lied.goes_on();
}

/// Of a run that draws by them, and of one that does not and has no place for them.
#[test]
fn of_priorities() {
    let lie = |learner, transition, priority| PriorityUpdate {
        learner,
        number: u64::MAX,
        parts: vec![PriorityPart {
            origin: Origin::default(),
            transitions: vec![transition],
            priorities: vec![priority],
        }],
    };
    let uniform = lied();
    let (client, before) = (&uniform.client, uniform.status());
    let key = client.keys.of::<PriorityUpdate>();
    uniform.unanswered(&key, sealed(client, &lie(LEARNER, 1, 1.0)));
    uniform.counted(&before, 0);
    drop(uniform);

    let system = system();
    let run = system.start(&format!(
        "local --agent driml-ada {LONG} {PRIORITISED} --listen {} --run-dir run",
        system.endpoint()
    ));
    let client = system.connect();
    client.wait_for_learner("some updates", |learner| learner.updates > 20);
    let lied = Lied {
        client,
        run,
        system,
    };
    let (client, before) = (&lied.client, lied.status());
    for priority in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0] {
        lied.unanswered(&key, sealed(client, &lie(LEARNER, 1, priority)));
    }
    driml_tests::wait_for("what the server says of them", || {
        let log = fs::read_to_string(lied.system.path("run/logs/replay-server.log")).unwrap();
        log.contains("which is no number from 0 on").then_some(())
    });
    lied.unanswered(&key, sealed(client, &lie(LEARNER, u64::MAX, 1.0)));
    lied.unanswered(&key, sealed(client, &lie(LEARNER, 1, f32::MAX)));
    let mut long = lie(LEARNER, 1, 1.0);
    long.parts[0].transitions.resize(100_000, 1);
    long.parts[0].priorities.resize(100_000, 1.0);
    lied.unanswered(&key, sealed(client, &long));
    lied.counted(&before, 7);
    lied.goes_on();
}

#[test]
fn of_weights() {
    let lied = lied();
    let (client, before) = (&lied.client, lied.status());
    for version in [0, 1, 1 << 60, u64::MAX] {
        let weights = WeightsHeader::new(version, version, b"w");
        let upload = WeightsUpload {
            learner: LEARNER,
            weights,
        };
        let bytes = codec::encode(client.spec.hash(), &upload, b"w").unwrap();
        lied.unanswered(&client.keys.of::<WeightsUpload>(), bytes);
        let lie = WeightsVersion { version };
        let key = client.keys.of::<WeightsVersion>();
        client
            .session
            .put(key, sealed(client, &lie))
            .wait()
            .unwrap();
    }
    lied.counted(&before, 4);
    let piece = |version, offset| WeightsRequest::Piece { version, offset };
    for request in [
        WeightsRequest::NewerThan(u64::MAX),
        piece(1 << 60, 0),
        piece(1, u64::MAX),
    ] {
        let key = client.keys.of::<WeightsRequest>();
        let reply: WeightsReply = lied.reply(&key, sealed(client, &request));
        let nothing = [WeightsReply::NoneNewer, WeightsReply::Gone];
        assert!(nothing.contains(&reply), "{reply:?}");
    }
    lied.goes_on();
}

/// 512 MB of zeros are never held; what is too long by less is refused and counted before it is copied.
#[test]
fn of_half_a_gigabyte() {
    let lied = lied();
    let (client, before) = (&lied.client, lied.status());
    let server = lied.system.find_part("replay-server").pid;
    let peak_mib = || {
        let status = fs::read_to_string(format!("/proc/{server}/status")).unwrap();
        let line = status
            .lines()
            .find_map(|line| line.strip_prefix("VmHWM:"))
            .unwrap();
        line.split_whitespace()
            .next()
            .unwrap()
            .parse::<u64>()
            .unwrap()
            / 1024
    };
    let (keys, peak_before) = (&client.keys, peak_mib());
    let long: [String; 4] = [
        keys.of_actor::<ChunkHeader>(0),
        keys.of::<WeightsUpload>(),
        keys.of_actor::<Goodbye>(0),
        keys.of::<ReplayStatus>(),
    ];
    for key in &long[1..] {
        lied.unanswered(key, vec![0; 600_000]);
    }
    lied.counted(&before, 3);
    lied.unanswered(&long[0], vec![0; 1 << 29]);
    let peak = peak_mib();
    assert!(
        peak < peak_before + 100,
        "{peak_before} MiB before, then {peak}"
    );
    lied.goes_on();
}

/// What a liar would need is not to be seen: the numbers by which the replay server knows its learner and its actors.
#[test]
fn of_nobody_whose_number_can_be_read() {
    let lied = lied();
    let client = &lied.client;
    let tokens = client
        .session
        .liveliness()
        .get(client.keys.all_alive())
        .wait()
        .unwrap();
    let mut seen = 0;
    let before = lied.status();
    while let Ok(reply) = tokens.recv() {
        let token = reply.into_result().unwrap();
        let shown = client.keys.alive(token.key_expr().as_str()).unwrap();
        seen += 1;
        // The mark is of no use in the place of the number.
        match shown {
            Alive::Actor { actor, mark } => {
                let goodbye = Goodbye {
                    actor,
                    incarnation: mark,
                    produced: 0,
                };
                let key = client.keys.of_actor::<Goodbye>(actor);
                client.ask(&key, sealed(client, &goodbye)).unwrap();
            }
            Alive::Learner { mark } => {
                let weights = WeightsHeader::new(1 << 19, 0, b"w");
                let upload = WeightsUpload {
                    learner: mark,
                    weights,
                };
                let bytes = codec::encode(client.spec.hash(), &upload, b"w");
                let bytes: Result<_, CodecError> = bytes;
                lied.unanswered(&client.keys.of::<WeightsUpload>(), bytes.unwrap());
            }
        }
    }
    assert_eq!(seen, 2, "the actor and the learner");
    lied.counted(&before, 2);
    lied.goes_on();
}
