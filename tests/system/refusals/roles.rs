//! A certificate permits the messages of one role and number, and nothing else, whatever its holder sends.
//! Which clients are admitted at all is in `tls`.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, ChunkPoll, LearnerStatus, Leave, Peer, ReplayStatus, RunInfo,
    WeightsRequest, WeightsUpload, WeightsVersion, session, tls::Role,
};
use driml_tests::{Client, Process, TestSystem, in_parallel, new_learner, wait_until};
use zenoh::{Wait, query::Query, sample::Locality};

use super::{
    NO_REPLY, Row, affinity, batch_request, check_continues, check_replies, chunk_header, encoded,
    upload,
};
use crate::{LONG, tls_system};

/// A run over TLS, and an observer.
struct TlsRun {
    system: TestSystem,
    observer: Client,
    _processes: [Process; 3],
}

impl TlsRun {
    fn new() -> Option<Self> {
        let system = tls_system()?;
        let server = system.start_replay_server(&format!("--agent driml-ada {LONG}"));
        let processes = [server, system.start_learner("run"), system.start_actor(0)];
        let observer = system.connect();
        observer.wait_for_updates(10);
        Some(Self {
            system,
            observer,
            _processes: processes,
        })
    }

    fn refusals(&self) -> u64 {
        self.observer.replay_status().unwrap().messages_refused
    }
}

/// Sends all rows at the same time, because most of them wait for a reply until the time-out.
fn send_in_parallel(client: &Client, rows: impl IntoIterator<Item = Row>) {
    in_parallel(rows, |row| check_replies(client, [row]));
}

#[test]
fn a_role_does_nothing_but_its_own() {
    if let Some(run) = TlsRun::new() {
        an_actor_asks_for_nothing_but_its_own(&run);
        an_actor_declares_nothing_but_its_own(&run);
        an_observer_only_reads(&run);
        check_continues(&run.observer);
    }
}

fn an_actor_asks_for_nothing_but_its_own(run: &TlsRun) {
    let one = &run.system.connect_as(Role::Actor(1));
    let (keys, hash) = (&one.keys, one.spec.hash());
    let (other, incarnation) = (0, 9);
    let leave = Leave::new(other, incarnation, 0);
    let join = ActorJoin::new(other, incarnation);
    let poll = ChunkPoll::new(other, incarnation, 0);
    let weights = upload(hash, 1, 1 << 19, b"w");
    let before = run.refusals();
    send_in_parallel(
        one,
        [
            Row::of(one, &batch_request(1, 16), NO_REPLY),
            Row::of(one, &affinity(1, 1, 3), NO_REPLY),
            Row::of(one, &new_learner(1), NO_REPLY),
            Row::new(keys.key::<WeightsUpload>(), weights, NO_REPLY),
            Row::of(one, &join, NO_REPLY),
            Row::of(one, &leave, NO_REPLY),
            Row::of(one, &poll, NO_REPLY),
            Row::new(keys.actor_key::<ChunkHeader>(other), [0; 100], NO_REPLY),
            Row::new(keys.key::<Leave>(), encoded(one, &leave), NO_REPLY),
            Row::new(keys.key::<ReplayStatus>(), [], NO_REPLY),
            Row::new(keys.key::<LearnerStatus>(), [], NO_REPLY),
            Row::new("driml/**", [], NO_REPLY),
        ],
    );
    assert_eq!(run.refusals(), before, "nothing of it reached the server");

    // At the actor's own keys, send messages that speak for another actor.
    let chunk = Chunk::zeroed(chunk_header(one, other, incarnation));
    let chunks = keys.actor_key::<ChunkHeader>(1);
    let joins = keys.actor_key::<ActorJoin>(1);
    let polls = keys.actor_key::<ChunkPoll>(1);
    let reason = "in the name of actor 0, but came at the key";
    send_in_parallel(
        one,
        [
            Row::new(chunks, one.encode_chunk(&chunk), reason),
            Row::new(keys.actor_key::<Leave>(1), encoded(one, &leave), NO_REPLY),
            Row::new(joins, encoded(one, &join), NO_REPLY),
            Row::new(polls, encoded(one, &poll), NO_REPLY),
        ],
    );
    wait_until("four refusals", || run.refusals() >= before + 4);
}

/// An actor can neither answer in place of others, nor publish or receive what is not for it, nor count as another process.
fn an_actor_declares_nothing_but_its_own(run: &TlsRun) {
    let one = run.system.connect_as(Role::Actor(1));
    let keys = &one.keys;
    let queries = Arc::<AtomicUsize>::default();
    let mut declared = Vec::new();
    for key in [
        keys.key::<RunInfo>(),
        keys.key::<WeightsRequest>(),
        keys.key::<ReplayStatus>(),
        keys.key::<LearnerStatus>(),
        keys.key::<ChunkHeader>(),
    ] {
        let queries = queries.clone();
        let answer = move |query: Query| {
            queries.fetch_add(1, Ordering::Relaxed);
            session::answer(&query, b"lies".to_vec().into());
        };
        let queryable = one.session.declare_queryable(key).complete(true);
        declared.push(queryable.callback(answer).wait().unwrap());
    }
    let received = Arc::<AtomicUsize>::default();
    let counter = received.clone();
    let count = move |_| {
        counter.fetch_add(1, Ordering::Relaxed);
    };
    let everything = one
        .session
        .declare_subscriber("driml/**")
        .allowed_origin(Locality::Remote)
        .callback(count)
        .wait()
        .unwrap();
    let liveliness = one.session.liveliness();
    let tokens = [Peer::actor(0, 5), Peer::learner(5)].map(|other| {
        let token = liveliness.declare_token(keys.liveliness_key(other));
        token.wait().unwrap()
    });
    let lie = WeightsVersion { version: 1 << 60 };
    one.session
        .put(keys.key::<WeightsVersion>(), encoded(&one, &lie))
        .wait()
        .unwrap();

    // A process that joins now gets the right answer.
    let mut two = run.system.start_actor(2);
    two.wait_for_stderr("actor 2 steps");
    run.observer.wait_for_replay("both", |it| it.actors == 2);
    two.stop(130).expect_stderr("leaves: ");
    run.observer.wait_for_replay("one", |it| it.actors == 1);
    check_continues(&run.observer);
    assert_eq!(queries.load(Ordering::Relaxed), 0, "queries to an actor");
    let received = received.load(Ordering::Relaxed);
    assert_eq!(received, 0, "messages that are not for it");
    drop((declared, everything, tokens));
}

fn an_observer_only_reads(run: &TlsRun) {
    let observer = &run.system.connect_as(Role::Observer);
    assert!(observer.replay_status().is_some() && observer.learner_status().is_some());
    let keys = &observer.keys;
    send_in_parallel(
        observer,
        [
            Row::of(observer, &WeightsRequest::NewerThan(0), NO_REPLY),
            Row::of(observer, &new_learner(1), NO_REPLY),
            Row::of(observer, &ActorJoin::new(1, 1), NO_REPLY),
            Row::new(keys.actor_key::<ChunkHeader>(1), [0; 100], NO_REPLY),
        ],
    );
}
