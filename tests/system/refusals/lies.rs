//! Well-formed lies: a second client that knows the run's hash and sends impossible content in each kind of message.
//! Each is rejected, counted, and logged at a bounded rate; the run continues. Malformed messages are in `messages`.

use std::{
    fs,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use driml_protocol::{
    ActorJoin, AffinityUpdate, Alive, BatchRequest, Chunk, ChunkHeader, Claim, Goodbye, Learned,
    LearnerJoin, Origin, PriorityPart, PriorityUpdate, ReplayStatus, RequestId, Tally,
    WeightsHeader, WeightsRequest, WeightsUpload, WeightsVersion, codec, session,
};
use driml_tests::{Client, Process, TestSystem, new_learner, wait_for};
use zenoh::{Wait, query::Query};

use super::{Row, SILENCE, sealed, send};
use crate::{LONG, PRIORITISED, launched, system};

const LIFE: u64 = 77;
const LEARNER: u64 = 78;
/// An unused actor number.
const STRANGER: u32 = 500;

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

impl Lied {
    fn status(&self) -> ReplayStatus {
        self.client.replay().unwrap()
    }

    /// Sends rows, of which so many are counted as refused.
    fn sends(&self, rows: impl IntoIterator<Item = Row>, lies: u64) {
        let before = self.status();
        send(&self.client, rows);
        self.counted(&before, lies);
    }

    /// So many more messages were refused since `before`.
    fn counted(&self, before: &ReplayStatus, lies: u64) {
        // The last one may still be on its way through a busy server.
        let status = self.client.wait_for_replay("all lies", |replay| {
            replay.messages_refused >= before.messages_refused + lies
        });
        assert_eq!(status.messages_refused - before.messages_refused, lies);
    }

    /// The run continues with its own numbers, and its log is short.
    fn continues(self) {
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
fn of_each_kind_of_message() {
    let lied = lied();
    let (client, keys) = (&lied.client, &lied.client.keys);
    let joins = [0, 1 << 60, u64::MAX].map(|rows_sampled| {
        let tally = Tally {
            inserted: 0,
            rows_sampled,
        };
        let join = LearnerJoin {
            tally,
            ..new_learner(LEARNER)
        };
        Row::of(client, keys.of::<LearnerJoin>(), &join, "Taken {")
    });
    lied.sends(joins, 0);
    let actor = ActorJoin {
        actor: 0,
        incarnation: LIFE,
    };
    let join =
        |number, expected| Row::of(client, keys.of_actor::<ActorJoin>(number), &actor, expected);
    lied.sends([join(0, "Taken {")], 0);
    // As another number than its key's.
    lied.sends((0..4).map(|_| join(STRANGER, SILENCE)), 4);

    client.join_as_actor(STRANGER, LIFE);
    let goodbye = |(actor, incarnation, produced)| {
        let goodbye = Goodbye {
            actor,
            incarnation,
            produced,
        };
        Row::of(client, keys.of_actor::<Goodbye>(actor), &goodbye, "Done")
    };
    let goodbyes = [
        (0, LIFE, 0),
        (0, LIFE, u64::MAX),
        (0, u64::MAX, 1000),
        (STRANGER, LIFE + 1, 1000),
        (STRANGER, LIFE, 1 << 60),
        (STRANGER + 1, LIFE, 1 << 60),
    ];
    lied.sends(goodbyes.map(goodbye), 6);
    lied.sends((0..1000).map(|_| goodbye((0, LIFE, 1))), 1000);

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
    let chunk = |change: &dyn Fn(&mut ChunkHeader), expected| {
        let mut header = honest;
        change(&mut header);
        let chunk = Chunk::zeroed(header);
        let (head, payload) = chunk.seal(client.spec.hash()).unwrap();
        let key = keys.of_actor::<ChunkHeader>(header.actor);
        Row::new(key, [&head, payload].concat(), expected)
    };
    let (no_run, newest) = ("counts that no run reaches", "acted, and the newest are");
    let claim = Claim {
        actor: 0,
        incarnation: LIFE,
        sequence: u64::MAX,
        leaving: true,
    };
    lied.sends(
        [
            chunk(&|it| it.actor = 0, "does not know this life of actor 0"),
            chunk(&|it| it.sequence = u64::MAX, no_run),
            chunk(&|it| it.first_transition = 1 << 60, no_run),
            chunk(&|it| it.first_transition = u64::MAX - 1, no_run),
            chunk(&|it| it.weights_version = 1 << 60, newest),
            chunk(&|it| it.weights_version = u64::MAX, newest),
            Row::of(client, keys.of_actor::<Claim>(0), &claim, "Refused {"),
        ],
        7,
    );

    let tally = Tally {
        inserted: u64::MAX,
        rows_sampled: u64::MAX,
    };
    let batches = [(16, None), (u32::MAX, None), (16, Some(tally)), (0, None)];
    let batches = batches.map(|(rows, other_shards)| {
        let request = BatchRequest {
            learner: LEARNER,
            id: RequestId::first(u64::MAX),
            rows,
            shared_memory: true,
            learned: Learned::default(),
            other_shards,
        };
        Row::of(client, keys.of::<BatchRequest>(), &request, "Refused {")
    });
    lied.sends(batches, 4);
    let num_actions = client.spec.num_actions;
    let affinities = [1, 1 << 60, u64::MAX].map(|version| {
        let affinity = AffinityUpdate {
            learner: LEARNER,
            version,
            num_actions,
            matrix: vec![1.0; (num_actions * num_actions) as usize],
        };
        Row::of(client, keys.of::<AffinityUpdate>(), &affinity, SILENCE)
    });
    lied.sends(affinities, 3);
    // This run does not draw by priorities, and has no place for them.
    let update = priority(LEARNER, 1, 1.0);
    lied.sends(
        [Row::of(
            client,
            keys.of::<PriorityUpdate>(),
            &update,
            SILENCE,
        )],
        0,
    );

    let uploads = [0, 1, 1 << 60, u64::MAX].map(|version| {
        let announced = sealed(client, &WeightsVersion { version });
        let announced = client.session.put(keys.of::<WeightsVersion>(), announced);
        announced.wait().unwrap();
        Row::new(
            keys.of::<WeightsUpload>(),
            upload(client, LEARNER, version),
            SILENCE,
        )
    });
    lied.sends(uploads, 4);
    let piece = |version, offset| WeightsRequest::Piece { version, offset };
    let requests = [
        (WeightsRequest::NewerThan(u64::MAX), "NoneNewer"),
        (piece(1 << 60, 0), "Gone"),
        (piece(1, u64::MAX), "Gone"),
    ];
    let key = keys.of::<WeightsRequest>();
    let requests = requests.map(|(it, expected)| Row::of(client, key.clone(), &it, expected));
    lied.sends(requests, 0);
    lied.continues();
}

fn upload(client: &Client, learner: u64, version: u64) -> Vec<u8> {
    let weights = WeightsHeader::new(version, version, b"w");
    let upload = WeightsUpload { learner, weights };
    codec::encode(client.spec.hash(), &upload, b"w").unwrap()
}

fn priority(learner: u64, transition: u64, priority: f32) -> PriorityUpdate {
    PriorityUpdate {
        learner,
        number: u64::MAX,
        parts: vec![PriorityPart {
            origin: Origin::default(),
            transitions: vec![transition],
            priorities: vec![priority],
        }],
    }
}

/// Without certificates every client may offer to answer in the replay server's place.
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

/// More than a run may have, twice over; then one that belongs to the run.
#[test]
fn of_4096_strangers() {
    let lied = lied();
    let client = &lied.client;
    let tokens: Vec<_> = (0..300)
        .map(|mark| client.run().declare_alive(Alive::Learner { mark }).unwrap())
        .collect();
    let joins = (0..2 * 4096).map(|number| {
        let join = ActorJoin {
            actor: STRANGER + number,
            incarnation: LIFE,
        };
        let key = client.keys.of_actor::<ActorJoin>(join.actor);
        Row::of(client, key, &join, "Welcome {")
    });
    send(client, joins);
    drop(tokens);
    assert_eq!(lied.status().actors, 1);
    let mut actor = lied.system.start_actor(7);
    actor.wait_for_stderr("actor 7 steps");
    client.wait_for_replay("two actors", |replay| replay.actors_acting == 2);
    actor.stop().expect_code(0).expect_said("leaves: ");
    client.wait_for_replay("one actor", |replay| replay.actors == 1);
    // Those who were forgotten, and who say what they will.
    let goodbye = Goodbye {
        actor: STRANGER,
        incarnation: LIFE,
        produced: 1 << 60,
    };
    let key = client.keys.of_actor::<Goodbye>(STRANGER);
    lied.sends([Row::of(client, key, &goodbye, "Done")], 1);
    lied.continues();
}

/// Of a run that draws by them.
#[test]
fn of_priorities() {
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
    let client = &lied.client;
    let row =
        |lie: &PriorityUpdate| Row::of(client, client.keys.of::<PriorityUpdate>(), lie, SILENCE);
    let no_numbers = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0];
    lied.sends(no_numbers.map(|it| row(&priority(LEARNER, 1, it))), 4);
    wait_for("what the server says of them", || {
        let log = fs::read_to_string(lied.system.path("run/logs/replay-server.log")).unwrap();
        log.contains("is not a number from 0 on").then_some(())
    });
    let mut long = priority(LEARNER, 1, 1.0);
    long.parts[0].transitions.resize(100_000, 1);
    long.parts[0].priorities.resize(100_000, 1.0);
    let others = [
        priority(LEARNER, u64::MAX, 1.0),
        priority(LEARNER, 1, f32::MAX),
        long,
    ];
    lied.sends(others.map(|it| row(&it)), 3);
    lied.continues();
}

/// 512 MB of zeros are never held; what is too long by less is refused and counted before it is copied.
#[test]
fn of_half_a_gigabyte() {
    let lied = lied();
    let client = &lied.client;
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
    let rows = long[1..].iter();
    lied.sends(rows.map(|key| Row::new(key, vec![0; 600_000], SILENCE)), 3);
    send(client, [Row::new(&long[0], vec![0; 1 << 29], SILENCE)]);
    let peak = peak_mib();
    assert!(
        peak < peak_before + 100,
        "{peak_before} MiB before, then {peak}"
    );
    lied.continues();
}

/// What a liar would need is not to be seen: the numbers by which the replay server knows its learner and its actors.
#[test]
fn of_processes_whose_number_can_be_read() {
    let lied = lied();
    let client = &lied.client;
    let tokens = client
        .session
        .liveliness()
        .get(client.keys.all_alive())
        .wait()
        .unwrap();
    let mut rows = Vec::new();
    while let Ok(reply) = tokens.recv() {
        let token = reply.into_result().unwrap();
        let shown = client.keys.alive(token.key_expr().as_str()).unwrap();
        // The mark is of no use in the place of the number.
        rows.push(match shown {
            Alive::Actor { actor, mark } => {
                let goodbye = Goodbye {
                    actor,
                    incarnation: mark,
                    produced: 0,
                };
                Row::of(
                    client,
                    client.keys.of_actor::<Goodbye>(actor),
                    &goodbye,
                    "Done",
                )
            }
            Alive::Learner { mark } => {
                let key = client.keys.of::<WeightsUpload>();
                Row::new(key, upload(client, mark, 1 << 19), SILENCE)
            }
        });
    }
    assert_eq!(rows.len(), 2, "the actor and the learner");
    lied.sends(rows, 2);
    lied.continues();
}
