//! Well-formed lies: a second client that knows the run's hash and sends impossible content in each kind of message.
//! Each is rejected, counted, and logged at a bounded rate; the run continues. Malformed messages are in `messages`.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use driml_protocol::{
    ActorJoin, Alive, BatchRequest, Chunk, ChunkHeader, ChunkPoll, Leave, Origin, PriorityPart,
    PriorityUpdate, ProcessName, ReplayStatus, RequestId, ShardCounts, WeightsRequest,
    WeightsUpload, WeightsVersion, session,
};
use driml_tests::{Client, Process, TestSystem, new_learner, wait_until};
use zenoh::{Wait, query::Query};

use super::{
    Row, SILENCE, actor_join, affinity, batch_request, chunk_header, continues, leave, sealed,
    send, send_refused, upload,
};
use crate::{PRIORITISED, launched_with, system};

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

impl Lied {
    fn new(flags: &str) -> Self {
        let system = system();
        let run = launched_with(&system, &format!("--agent driml-ada {flags}"), 20);
        Self {
            client: system.connect(),
            run,
            system,
        }
    }

    /// Sends rows and checks the number of lies that the server counts as refused.
    fn sends(&self, rows: impl IntoIterator<Item = Row>, lies: u64) {
        send_refused(&self.client, "all lies", rows, lies);
    }

    /// Checks that the run continues, and that its log is short.
    fn continues(self) {
        continues(&self.client);
        let log = self.system.read("run/logs/replay-server.log");
        let lines = log.lines().filter(|line| line.contains("refused")).count();
        assert!((1..60).contains(&lines), "{lines} lines: {log}");
        drop(self.client);
        self.run.stop().expect_code(130);
    }
}

#[test]
fn lies_are_counted_and_change_nothing() {
    let lied = Lied::new("");
    // This check comes first, because an earlier peak of memory would hide a later one.
    of_half_a_gigabyte(&lied);
    of_each_kind_of_message(&lied);
    of_processes_whose_number_can_be_read(&lied);
    of_4096_strangers(&lied);
    lied.continues();
}

fn of_each_kind_of_message(lied: &Lied) {
    let (client, keys) = (&lied.client, &lied.client.keys);
    let joins = [0, 1 << 60, u64::MAX].map(|rows_sampled| {
        let mut join = new_learner(LEARNER);
        join.counts.rows_sampled = rows_sampled;
        Row::of(client, &join, "Taken {")
    });
    lied.sends(joins, 0);
    let join = actor_join(0, LIFE);
    lied.sends([Row::of(client, &join, "Taken {")], 0);
    // The number of the actor differs from that in the key.
    let key = keys.of_actor::<ActorJoin>(STRANGER);
    let bytes = sealed(client, &join);
    lied.sends((0..4).map(|_| Row::new(&key, &*bytes, SILENCE)), 4);

    client.join_as_actor(STRANGER, LIFE);
    let row = |leave| Row::of(client, &leave, "Ack");
    let leaves = [
        leave(0, LIFE, 0),
        leave(0, LIFE, u64::MAX),
        leave(0, u64::MAX, 1000),
        leave(STRANGER, LIFE + 1, 1000),
        leave(STRANGER, LIFE, 1 << 60),
        leave(STRANGER + 1, LIFE, 1 << 60),
    ];
    lied.sends(leaves.map(row), 6);
    lied.sends((0..1000).map(|_| row(leave(0, LIFE, 1))), 1000);

    let chunk = |change: &dyn Fn(&mut ChunkHeader), expected| {
        let mut header = chunk_header(client, STRANGER, LIFE);
        header.leaving = true;
        change(&mut header);
        let key = keys.of_actor::<ChunkHeader>(header.actor);
        Row::new(key, client.seal(&Chunk::zeroed(header)), expected)
    };
    let (no_run, newest) = ("counts that no run reaches", "acted, and the newest are");
    let poll = ChunkPoll {
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
            Row::of(client, &poll, "Refused {"),
        ],
        7,
    );

    let counts = ShardCounts {
        inserted: u64::MAX,
        rows_sampled: u64::MAX,
    };
    let batches = [(16, None), (u32::MAX, None), (16, Some(counts)), (0, None)];
    let batches = batches.map(|(rows, other_shards)| {
        let request = BatchRequest {
            id: RequestId::first(u64::MAX),
            shared_memory: true,
            other_shards,
            ..batch_request(LEARNER, rows)
        };
        Row::of(client, &request, "Refused {")
    });
    lied.sends(batches, 4);
    let affinities = [1, 1 << 60, u64::MAX]
        .map(|version| affinity(LEARNER, version, client.spec.num_actions))
        .map(|affinity| Row::of(client, &affinity, SILENCE));
    lied.sends(affinities, 3);
    // This run does not draw by priority, and ignores the message.
    lied.sends([Row::of(client, &priority(1, 1.0), SILENCE)], 0);

    let uploads = [0, 1, 1 << 60, u64::MAX].map(|version| {
        let announced = sealed(client, &WeightsVersion { version });
        let announced = client.session.put(keys.of::<WeightsVersion>(), announced);
        announced.wait().unwrap();
        let bytes = upload(client.spec.hash(), LEARNER, version, b"w");
        Row::new(keys.of::<WeightsUpload>(), bytes, SILENCE)
    });
    lied.sends(uploads, 4);
    let piece = |version, offset| WeightsRequest::Piece { version, offset };
    let requests = [
        (WeightsRequest::NewerThan(u64::MAX), "NoneNewer"),
        (piece(1 << 60, 0), "Gone"),
        (piece(1, u64::MAX), "Gone"),
    ];
    lied.sends(requests.map(|(it, said)| Row::of(client, &it, said)), 0);
}

/// Returns the priority of a transition, sent by a learner that is not the run's.
fn priority(transition: u64, priority: f32) -> PriorityUpdate {
    PriorityUpdate {
        learner: LEARNER,
        number: u64::MAX,
        parts: vec![PriorityPart {
            origin: Origin::default(),
            transitions: vec![transition],
            priorities: vec![priority],
        }],
    }
}

/// Without certificates any client may declare that it answers in place of the replay server.
#[test]
fn lies_of_who_answers_are_not_believed() {
    let lied = Lied::new("");
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
    wait_until("200 lies, and the run beside them", || {
        learned() > before + 200 && asked.load(Ordering::Relaxed) > 200
    });
    let log = lied.system.read("run/logs/actor-0.log");
    assert!(!log.contains("will be sent again"), "{log}");
    lied.run.stop().expect_code(130);
}

/// More strangers join than a run can remember; then an actor joins that belongs to the run.
fn of_4096_strangers(lied: &Lied) {
    let client = &lied.client;
    let tokens: Vec<_> = (0..300)
        .map(|number| client.run().declare_alive(Alive::learner(number)).unwrap())
        .collect();
    let joins = (0..5_000).map(|number| actor_join(STRANGER + number, LIFE));
    send(
        client,
        joins.map(|it| Row::of(client, &it, "Welcome(Welcome {")),
    );
    drop(tokens);
    assert_eq!(client.replay().unwrap().actors, 1);
    let mut actor = lied.system.start_actor(7);
    actor.wait_for_stderr("actor 7 steps");
    client.wait_for_replay("two actors", |replay| replay.actors_acting == 2);
    actor.stop_ok().expect_said("leaves: ");
    client.wait_for_replay("one actor", |replay| replay.actors == 1);
    // A forgotten actor leaves with a count that no run reaches.
    let leave = leave(STRANGER, LIFE, 1 << 60);
    lied.sends([Row::of(client, &leave, "Ack")], 1);
}

/// Tests a run that draws rows by priority.
#[test]
fn lies_of_priorities_change_nothing() {
    let lied = Lied::new(PRIORITISED);
    let client = &lied.client;
    let row = |lie: &PriorityUpdate| Row::of(client, lie, SILENCE);
    let no_numbers = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0];
    lied.sends(no_numbers.map(|it| row(&priority(1, it))), 4);
    wait_until("what the server says of them", || {
        let log = lied.system.read("run/logs/replay-server.log");
        log.contains("is not a number from 0 on")
    });
    let mut long = priority(1, 1.0);
    long.parts[0].transitions.resize(100_000, 1);
    long.parts[0].priorities.resize(100_000, 1.0);
    let others = [priority(u64::MAX, 1.0), priority(1, f32::MAX), long];
    lied.sends(others.map(|it| row(&it)), 3);
    lied.continues();
}

/// A message of 512 MB is never held in memory. Shorter messages that are still too long are rejected and counted before they are copied.
fn of_half_a_gigabyte(lied: &Lied) {
    let client = &lied.client;
    let server = lied.system.find_process("replay-server");
    let peak_mib = || server.status("VmHWM") / 1024;
    let (keys, peak_before) = (&client.keys, peak_mib());
    let zeros = |key: String, bytes| Row::new(key, vec![0; bytes], SILENCE);
    let long = [
        keys.of::<WeightsUpload>(),
        keys.of_actor::<Leave>(0),
        keys.of::<ReplayStatus>(),
    ];
    lied.sends(long.map(|key| zeros(key, 600_000)), 3);
    send(client, [zeros(keys.of_actor::<ChunkHeader>(0), 1 << 29)]);
    let peak = peak_mib();
    assert!(
        peak < peak_before + 100,
        "{peak_before} MiB before, then {peak}"
    );
}

/// The public liveliness tokens do not show the secret numbers by which the replay server knows its learner and its actors.
fn of_processes_whose_number_can_be_read(lied: &Lied) {
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
        let Alive { process, mark } = client.keys.alive(token.key_expr().as_str()).unwrap();
        // The public mark does not work in place of the secret number.
        rows.push(match process {
            ProcessName::Actor(actor) => Row::of(client, &leave(actor, mark, 0), "Ack"),
            ProcessName::Learner => {
                let bytes = upload(client.spec.hash(), mark, 1 << 19, b"w");
                Row::new(client.keys.of::<WeightsUpload>(), bytes, SILENCE)
            }
        });
    }
    assert_eq!(rows.len(), 2, "the actor and the learner");
    lied.sends(rows, 2);
}
