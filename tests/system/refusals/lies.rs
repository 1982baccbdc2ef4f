//! Well-formed lies: a second client that knows the run's hash and sends impossible content in each kind of message.
//! Each is rejected, counted, and logged at a bounded rate; the run continues. Malformed messages are in `messages`.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use driml_protocol::{
    ActorJoin, BatchRequest, Chunk, ChunkHeader, ChunkPoll, Leave, Origin, Peer, PriorityPart,
    PriorityUpdate, ProcessName, ReplayStatus, RequestId, ShardCounts, WeightsRequest,
    WeightsUpload, WeightsVersion, session,
};
use driml_tests::{Client, Process, TestSystem, new_learner, wait_until};
use zenoh::{Wait, query::Query};

use super::{
    NO_REPLY, Row, affinity, batch_request, check_continues, check_refused, check_replies,
    chunk_header, encoded, upload,
};
use crate::{PRIORITISED, start_run_with, system};

const INCARNATION: u64 = 77;
const LEARNER: u64 = 78;
const UNUSED_ACTOR: u32 = 500;

/// A launched run, and a second client of it.
struct AttackedRun {
    client: Client,
    process: Process,
    system: TestSystem,
}

impl AttackedRun {
    fn new(flags: &str) -> Self {
        let system = system();
        let process = start_run_with(&system, &format!("--agent driml-ada {flags}"), 20);
        Self {
            client: system.connect(),
            process,
            system,
        }
    }

    /// Sends rows and checks the number of lies that the server counts as refused.
    fn check_lies(&self, rows: impl IntoIterator<Item = Row>, lies: u64) {
        check_refused(&self.client, "all lies", rows, lies);
    }

    /// Checks that the run continues, that its log is short, and that it counted `lies` in all; then stops it.
    fn check_and_stop(self, lies: u64) {
        check_continues(&self.client);
        let status = self.client.replay_status().unwrap();
        assert_eq!(status.messages_refused, lies, "none is counted later");
        let log = self.system.read("run/logs/replay-server.log");
        let lines = log.lines().filter(|line| line.contains("rejected")).count();
        assert!((1..60).contains(&lines), "{lines} lines: {log}");
        drop(self.client);
        self.process.stop(130);
    }
}

#[test]
fn lies_are_counted_and_change_nothing() {
    let run = AttackedRun::new("");
    // This check comes first, because an earlier peak of memory would hide a later one.
    reject_half_a_gigabyte(&run);
    reject_each_kind_of_message(&run);
    reject_public_marks(&run);
    forget_4096_strangers(&run);
    run.check_and_stop(3 + 1028 + 2 + 1);
}

fn reject_each_kind_of_message(run: &AttackedRun) {
    let (client, keys) = (&run.client, &run.client.keys);
    let joins = [0, 1 << 60, u64::MAX].map(|rows_sampled| {
        let mut join = new_learner(LEARNER);
        join.counts.rows_sampled = rows_sampled;
        Row::of(client, &join, "Taken {")
    });
    run.check_lies(joins, 0);
    let join = ActorJoin::new(0, INCARNATION);
    run.check_lies([Row::of(client, &join, "Taken {")], 0);
    // The number of the actor differs from that in the key.
    let key = keys.actor_key::<ActorJoin>(UNUSED_ACTOR);
    let bytes = encoded(client, &join);
    run.check_lies((0..4).map(|_| Row::new(&key, &*bytes, NO_REPLY)), 4);

    client.join_as_actor(UNUSED_ACTOR, INCARNATION);
    let row = |leave| Row::of(client, &leave, "Ack");
    let leaves = [
        Leave::new(0, INCARNATION, 0),
        Leave::new(0, INCARNATION, u64::MAX),
        Leave::new(0, u64::MAX, 1000),
        Leave::new(UNUSED_ACTOR, INCARNATION + 1, 1000),
        Leave::new(UNUSED_ACTOR, INCARNATION, 1 << 60),
        Leave::new(UNUSED_ACTOR + 1, INCARNATION, 1 << 60),
    ];
    run.check_lies(leaves.map(row), 6);
    run.check_lies((0..1000).map(|_| row(Leave::new(0, INCARNATION, 1))), 1000);

    let chunk = |change: &dyn Fn(&mut ChunkHeader), expected| {
        let mut header = chunk_header(client, UNUSED_ACTOR, INCARNATION);
        header.leaving = true;
        change(&mut header);
        let key = keys.actor_key::<ChunkHeader>(header.actor);
        Row::new(key, client.encode_chunk(&Chunk::zeroed(header)), expected)
    };
    let (no_run, newest) = ("counts that no run reaches", "acted, and the newest are");
    let poll = ChunkPoll {
        leaving: true,
        ..ChunkPoll::new(0, INCARNATION, u64::MAX)
    };
    run.check_lies(
        [
            chunk(&|it| it.actor = 0, "does not know this incarnation of"),
            chunk(&|it| it.sequence = u64::MAX, no_run),
            chunk(&|it| it.first_transition = 1 << 60, no_run),
            chunk(&|it| it.first_transition = u64::MAX - 1, no_run),
            chunk(&|it| it.weights_version = 1 << 60, newest),
            chunk(&|it| it.weights_version = u64::MAX, newest),
            Row::of(client, &poll, "Refused {"),
        ],
        7,
    );

    let counts = ShardCounts::new(u64::MAX, u64::MAX);
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
    run.check_lies(batches, 4);
    let affinities = [1, 1 << 60, u64::MAX]
        .map(|version| affinity(LEARNER, version, client.spec.num_actions))
        .map(|affinity| Row::of(client, &affinity, NO_REPLY));
    run.check_lies(affinities, 3);
    // This run does not draw by priority, and ignores the message.
    run.check_lies([Row::of(client, &priority(1, 1.0), NO_REPLY)], 0);

    let uploads = [0, 1, 1 << 60, u64::MAX].map(|version| {
        let announced = encoded(client, &WeightsVersion { version });
        let announced = client.session.put(keys.key::<WeightsVersion>(), announced);
        announced.wait().unwrap();
        let bytes = upload(client.spec.hash(), LEARNER, version, b"w");
        Row::new(keys.key::<WeightsUpload>(), bytes, NO_REPLY)
    });
    run.check_lies(uploads, 4);
    let piece = |version, offset| WeightsRequest::Piece { version, offset };
    let requests = [
        (WeightsRequest::NewerThan(u64::MAX), "NoneNewer"),
        (piece(1 << 60, 0), "Gone"),
        (piece(1, u64::MAX), "Gone"),
    ];
    run.check_lies(requests.map(|(it, said)| Row::of(client, &it, said)), 0);
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
    let run = AttackedRun::new("");
    let liar = run.system.connect();
    let queries = Arc::<AtomicUsize>::default();
    let count = queries.clone();
    let answer = move |query: Query| {
        count.fetch_add(1, Ordering::Relaxed);
        session::answer(&query, b"lies".to_vec().into());
    };
    let queryable = liar.session.declare_queryable("driml/**").complete(true);
    let _lies = queryable.callback(answer).wait().unwrap();
    let learned = || run.client.learner_status().expect("it is there").updates;
    let before = learned();
    wait_until("200 lies, and the run beside them", || {
        learned() > before + 200 && queries.load(Ordering::Relaxed) > 200
    });
    let log = run.system.read("run/logs/actor-0.log");
    assert!(!log.contains("retrying chunk"), "{log}");
    run.process.stop(130);
}

/// More strangers join than a run can remember; then an actor joins that belongs to the run.
fn forget_4096_strangers(run: &AttackedRun) {
    let client = &run.client;
    let stranger = client.run_client();
    let tokens: Vec<_> = (0..300)
        .map(|number| stranger.declare_alive(Peer::learner(number)).unwrap())
        .collect();
    let joins = (0..5_000).map(|number| ActorJoin::new(UNUSED_ACTOR + number, INCARNATION));
    let joins = joins.map(|it| Row::of(client, &it, "Welcome(Welcome {"));
    check_replies(client, joins);
    drop(tokens);
    assert_eq!(client.replay_status().unwrap().actors, 1);
    let mut actor = run.system.start_actor(7);
    actor.wait_for_stderr("actor 7 steps");
    client.wait_for_replay("two actors", |replay| replay.actors_acting == 2);
    actor.stop(130).expect_stderr("leaves: ");
    client.wait_for_replay("one actor", |replay| replay.actors == 1);
    // A forgotten actor leaves with a count that no run reaches.
    let leave = Leave::new(UNUSED_ACTOR, INCARNATION, 1 << 60);
    run.check_lies([Row::of(client, &leave, "Ack")], 1);
}

/// Tests a run that draws rows by priority.
#[test]
fn lies_of_priorities_change_nothing() {
    let run = AttackedRun::new(PRIORITISED);
    let client = &run.client;
    let row = |lie: &PriorityUpdate| Row::of(client, lie, NO_REPLY);
    let no_numbers = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0];
    run.check_lies(no_numbers.map(|it| row(&priority(1, it))), 4);
    wait_until("what the server says of them", || {
        let log = run.system.read("run/logs/replay-server.log");
        log.contains("is not a number of at least 0")
    });
    let mut long = priority(1, 1.0);
    long.parts[0].transitions.resize(100_000, 1);
    long.parts[0].priorities.resize(100_000, 1.0);
    let others = [priority(u64::MAX, 1.0), priority(1, f32::MAX), long];
    run.check_lies(others.map(|it| row(&it)), 3);
    run.check_and_stop(4 + 3);
}

/// A message of 512 MB is never held in memory. Shorter messages that are still too long are rejected and counted before they are copied.
fn reject_half_a_gigabyte(run: &AttackedRun) {
    let client = &run.client;
    let server = run.system.find_process("replay-server");
    let peak_mib = || server.status("VmHWM") / 1024;
    let (keys, peak_before) = (&client.keys, peak_mib());
    let zeros = |key: String, bytes| Row::new(key, vec![0; bytes], NO_REPLY);
    let long = [
        keys.key::<WeightsUpload>(),
        keys.actor_key::<Leave>(0),
        keys.key::<ReplayStatus>(),
    ];
    run.check_lies(long.map(|key| zeros(key, 600_000)), 3);
    check_replies(client, [zeros(keys.actor_key::<ChunkHeader>(0), 1 << 29)]);
    let peak = peak_mib();
    assert!(peak < peak_before + 100, "{peak_before}, {peak} MiB");
}

/// The public liveliness tokens do not show the secret numbers by which the replay server knows its learner and its actors.
fn reject_public_marks(run: &AttackedRun) {
    let client = &run.client;
    let tokens = client
        .session
        .liveliness()
        .get(client.keys.all_liveliness_keys())
        .wait()
        .unwrap();
    let mut rows = Vec::new();
    while let Ok(reply) = tokens.recv() {
        let token = reply.into_result().unwrap();
        let Peer { process, hash } = client.keys.peer(token.key_expr().as_str()).unwrap();
        // The public hash does not work in place of the secret number.
        rows.push(match process {
            ProcessName::Actor(actor) => Row::of(client, &Leave::new(actor, hash, 0), "Ack"),
            ProcessName::Learner => {
                let bytes = upload(client.spec.hash(), hash, 1 << 19, b"w");
                Row::new(client.keys.key::<WeightsUpload>(), bytes, NO_REPLY)
            }
        });
    }
    assert_eq!(rows.len(), 2, "the actor and the learner");
    run.check_lies(rows, 2);
}
