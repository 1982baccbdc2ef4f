//! A certificate permits the messages of one role and number, and nothing else, whatever its holder sends.
//! Which clients are admitted at all is in `tls`.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use driml_protocol::{
    ActorJoin, Alive, Chunk, ChunkHeader, ChunkPoll, LearnerStatus, Leave, ReplayStatus, RunInfo,
    WeightsRequest, WeightsUpload, WeightsVersion, session, tls::Role,
};
use driml_tests::{Client, Process, TestSystem, at_once, new_learner, wait_until};
use zenoh::{Wait, query::Query, sample::Locality};

use super::{
    Row, SILENCE, actor_join, affinity, batch_request, chunk_header, continues, leave, sealed,
    send, upload,
};
use crate::{LONG, system};

/// A run over TLS, and an observer.
struct Guarded {
    system: TestSystem,
    observer: Client,
    _server: Process,
    _processes: [Process; 2],
}

impl Guarded {
    fn new() -> Option<Self> {
        let system = system().over_tls()?;
        let server = system.start_replay_server(&format!("--agent driml-ada {LONG}"));
        let processes = [system.start_learner("run"), system.start_actor(0)];
        let observer = system.connect();
        observer.wait_for_updates(10);
        Some(Self {
            system,
            observer,
            _server: server,
            _processes: processes,
        })
    }

    fn refused(&self) -> u64 {
        self.observer.replay().unwrap().messages_refused
    }
}

/// Sends all rows at the same time, because most of them wait for a reply until the time-out.
fn send_at_once(client: &Client, rows: impl IntoIterator<Item = Row>) {
    at_once(rows, |row| send(client, [row]));
}

#[test]
fn a_role_does_nothing_but_its_own() {
    if let Some(run) = Guarded::new() {
        an_actor_asks_for_nothing_but_its_own(&run);
        an_actor_declares_nothing_but_its_own(&run);
        an_observer_only_looks(&run);
        continues(&run.observer);
    }
}

fn an_actor_asks_for_nothing_but_its_own(run: &Guarded) {
    let one = &run.system.connect_as(Role::Actor(1));
    let (keys, hash) = (&one.keys, one.spec.hash());
    let (other, incarnation) = (0, 9);
    let leave = leave(other, incarnation, 0);
    let join = actor_join(other, incarnation);
    let poll = ChunkPoll {
        actor: other,
        incarnation,
        sequence: 0,
        leaving: false,
    };
    let weights = upload(hash, 1, 1 << 19, b"w");
    let before = run.refused();
    send_at_once(
        one,
        [
            Row::of(one, &batch_request(1, 16), SILENCE),
            Row::of(one, &affinity(1, 1, 3), SILENCE),
            Row::of(one, &new_learner(1), SILENCE),
            Row::new(keys.of::<WeightsUpload>(), weights, SILENCE),
            Row::of(one, &join, SILENCE),
            Row::of(one, &leave, SILENCE),
            Row::of(one, &poll, SILENCE),
            Row::new(keys.of_actor::<ChunkHeader>(other), [0; 100], SILENCE),
            Row::new(keys.of::<Leave>(), sealed(one, &leave), SILENCE),
            Row::new(keys.of::<ReplayStatus>(), [], SILENCE),
            Row::new(keys.of::<LearnerStatus>(), [], SILENCE),
            Row::new("driml/**", [], SILENCE),
        ],
    );
    assert_eq!(run.refused(), before, "nothing of it reached the server");

    // At the actor's own keys, send messages that speak for another actor.
    let chunk = Chunk::zeroed(chunk_header(one, other, incarnation));
    let chunks = keys.of_actor::<ChunkHeader>(1);
    let said = "speaks for actor 0 at the key";
    send_at_once(
        one,
        [
            Row::new(chunks, one.seal(&chunk), said),
            Row::new(keys.of_actor::<Leave>(1), sealed(one, &leave), SILENCE),
            Row::new(keys.of_actor::<ActorJoin>(1), sealed(one, &join), SILENCE),
            Row::new(keys.of_actor::<ChunkPoll>(1), sealed(one, &poll), SILENCE),
        ],
    );
    wait_until("four refusals", || run.refused() >= before + 4);
}

/// An actor can neither answer in place of others, nor publish or receive what is not for it, nor count as another process.
fn an_actor_declares_nothing_but_its_own(run: &Guarded) {
    let one = run.system.connect_as(Role::Actor(1));
    let keys = &one.keys;
    let asked = Arc::<AtomicUsize>::default();
    let mut declared = Vec::new();
    for key in [
        keys.of::<RunInfo>(),
        keys.of::<WeightsRequest>(),
        keys.of::<ReplayStatus>(),
        keys.of::<LearnerStatus>(),
        keys.of::<ChunkHeader>(),
    ] {
        let asked = asked.clone();
        let answer = move |query: Query| {
            asked.fetch_add(1, Ordering::Relaxed);
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
    let tokens = [Alive::actor(0, 5), Alive::learner(5)].map(|other| {
        let token = liveliness.declare_token(keys.alive_key(other));
        token.wait().unwrap()
    });
    let lie = WeightsVersion { version: 1 << 60 };
    one.session
        .put(keys.of::<WeightsVersion>(), sealed(&one, &lie))
        .wait()
        .unwrap();

    // A process that joins now gets the right answer.
    let mut two = run.system.start_actor(2);
    two.wait_for_stderr("actor 2 steps");
    run.observer
        .wait_for_replay("both", |replay| replay.actors == 2);
    two.stop_ok().expect_said("leaves: ");
    run.observer
        .wait_for_replay("one", |replay| replay.actors == 1);
    continues(&run.observer);
    assert_eq!(asked.load(Ordering::Relaxed), 0, "queries to an actor");
    assert_eq!(
        received.load(Ordering::Relaxed),
        0,
        "it receives nothing that is not for it"
    );
    drop((declared, everything, tokens));
}

fn an_observer_only_looks(run: &Guarded) {
    let observer = &run.system.connect_as(Role::Observer);
    assert!(observer.replay().is_some() && observer.learner().is_some());
    let keys = &observer.keys;
    send_at_once(
        observer,
        [
            Row::of(observer, &WeightsRequest::NewerThan(0), SILENCE),
            Row::of(observer, &new_learner(1), SILENCE),
            Row::of(observer, &actor_join(1, 1), SILENCE),
            Row::new(keys.of_actor::<ChunkHeader>(1), [0; 100], SILENCE),
        ],
    );
}
