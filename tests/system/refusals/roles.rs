//! What a certificate is good for: its own role and number, and nothing else, whatever its holder sends.
//! Which clients are admitted at all is in `tls`.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use driml_protocol::{
    ActorJoin, AffinityUpdate, Alive, BatchRequest, Chunk, ChunkHeader, Claim, Goodbye, Hello,
    Learned, LearnerJoin, LearnerStatus, ReplayStatus, RequestId, WeightsHeader, WeightsRequest,
    WeightsUpload, WeightsVersion, codec, session, tls::Role,
};
use driml_tests::{Client, Process, new_learner};
use zenoh::{Wait, query::Query, sample::Locality};

use super::{Row, SILENCE, send};
use crate::{LONG, tls::TlsSystem};

/// A run over TLS, and who watches it.
struct Guarded {
    tls: TlsSystem,
    observer: Client,
    _server: Process,
    _parts: [Process; 2],
}

impl Guarded {
    fn new(test: &str) -> Option<Self> {
        let tls = TlsSystem::new(test)?;
        let server = tls.start_server(&format!("--agent driml-ada {LONG}"));
        let parts = [
            tls.start("learner --stay --run-dir run", "tls"),
            tls.start("actor --id 0", "tls"),
        ];
        let observer = tls.client(Role::Observer);
        observer.wait_for_learner("some updates", |learner| learner.updates > 10);
        Some(Self {
            tls,
            observer,
            _server: server,
            _parts: parts,
        })
    }

    fn refused(&self) -> u64 {
        self.observer.replay().unwrap().messages_refused
    }

    /// The run continues unaffected.
    fn continues(&self) {
        let updates = self.observer.learner().unwrap().updates;
        let later = |learner: &LearnerStatus| learner.updates > updates + 10;
        self.observer.wait_for_learner("more updates", later);
        let replay = self.observer.replay().unwrap();
        assert_eq!(
            (replay.transitions_lost, replay.transitions_duplicated),
            (0, 0)
        );
        assert_eq!(replay.actors, 1);
    }
}

#[test]
fn an_actor_asks_for_nothing_but_its_own() {
    let Some(run) = Guarded::new("an_actor_asks_for_nothing_but_its_own") else {
        return;
    };
    let one = &run.tls.client(Role::Actor(1));
    let (keys, hash) = (&one.keys, one.spec.hash());
    let (other, incarnation) = (0, 9);
    let goodbye = Goodbye {
        actor: other,
        incarnation,
        produced: 0,
    };
    let join = ActorJoin {
        actor: other,
        incarnation,
    };
    let claim = Claim {
        actor: other,
        incarnation,
        sequence: 0,
        leaving: false,
    };
    let batch = BatchRequest {
        learner: 1,
        id: RequestId::first(1),
        rows: 16,
        shared_memory: false,
        learned: Learned::default(),
        other_shards: None,
    };
    let affinity = AffinityUpdate {
        learner: 1,
        version: 1,
        num_actions: 3,
        matrix: vec![1.0; 9],
    };
    let upload = WeightsUpload {
        learner: 1,
        weights: WeightsHeader::new(1 << 19, 0, b"w"),
    };
    let upload = codec::encode(hash, &upload, b"w").unwrap();
    let learner = new_learner(1);
    send(
        one,
        [
            Row::of(one, keys.of::<BatchRequest>(), &batch, SILENCE),
            Row::of(one, keys.of::<AffinityUpdate>(), &affinity, SILENCE),
            Row::of(one, keys.of::<LearnerJoin>(), &learner, SILENCE),
            Row::new(keys.of::<WeightsUpload>(), upload, SILENCE),
            Row::of(one, keys.of_actor::<ActorJoin>(other), &join, SILENCE),
            Row::of(one, keys.of_actor::<Goodbye>(other), &goodbye, SILENCE),
            Row::of(one, keys.of_actor::<Claim>(other), &claim, SILENCE),
            Row::new(keys.of_actor::<ChunkHeader>(other), [0; 100], SILENCE),
            Row::of(one, keys.of::<Goodbye>(), &goodbye, SILENCE),
            Row::new(keys.of::<ReplayStatus>(), [], SILENCE),
            Row::new(keys.of::<LearnerStatus>(), [], SILENCE),
            Row::new("driml/**", [], SILENCE),
        ],
    );

    // At its own keys, messages that speak for another.
    let before = run.refused();
    let mut chunk = Chunk::zeroed(ChunkHeader {
        actor: other,
        incarnation,
        sequence: 0,
        first_transition: 0,
        weights_version: 1,
        leaving: false,
        streams: 1,
        steps: 1,
        frame_bytes: one.spec.frame_bytes() as u32,
    });
    chunk.set(0, 0, 1.0, driml_protocol::End::Running);
    let (head, payload) = chunk.seal(hash).unwrap();
    let chunk = [&head, payload].concat();
    let speaks_for = "speaks for actor 0 at the key";
    send(
        one,
        [
            Row::new(keys.of_actor::<ChunkHeader>(1), chunk, speaks_for),
            Row::of(one, keys.of_actor::<Goodbye>(1), &goodbye, SILENCE),
            Row::of(one, keys.of_actor::<ActorJoin>(1), &join, SILENCE),
            Row::of(one, keys.of_actor::<Claim>(1), &claim, SILENCE),
        ],
    );
    assert_eq!(run.refused(), before + 4);
    run.continues();
}

/// It can neither answer in the place of others, nor publish or receive what is not for it, nor count as another process.
#[test]
fn an_actor_declares_nothing_but_its_own() {
    let Some(run) = Guarded::new("an_actor_declares_nothing_but_its_own") else {
        return;
    };
    let one = run.tls.client(Role::Actor(1));
    let keys = &one.keys;
    let asked = Arc::<AtomicUsize>::default();
    let mut declared = Vec::new();
    for key in [
        keys.of::<Hello>(),
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
    let other = liveliness
        .declare_token(keys.alive_key(Alive::actor(0, 5)))
        .wait()
        .unwrap();
    let learner = liveliness
        .declare_token(keys.alive_key(Alive::learner(5)))
        .wait()
        .unwrap();
    let lie = WeightsVersion { version: 1 << 60 };
    let bytes = codec::encode(one.spec.hash(), &lie, &[]).unwrap();
    one.session
        .put(keys.of::<WeightsVersion>(), bytes)
        .wait()
        .unwrap();

    // A process that joins now gets the right answer.
    let mut two = run.tls.start("actor --id 2", "tls");
    two.wait_for_stderr("actor 2 steps");
    run.observer
        .wait_for_replay("both", |replay| replay.actors == 2);
    two.stop().expect_code(0).expect_said("leaves: ");
    run.observer
        .wait_for_replay("one", |replay| replay.actors == 1);
    run.continues();
    assert_eq!(asked.load(Ordering::Relaxed), 0, "queries to an actor");
    assert_eq!(
        received.load(Ordering::Relaxed),
        0,
        "it receives nothing that is not for it"
    );
    drop((declared, everything, other, learner));
}

#[test]
fn an_observer_only_looks() {
    let Some(run) = Guarded::new("an_observer_only_looks") else {
        return;
    };
    let observer = &run.tls.client(Role::Observer);
    assert!(observer.replay().is_some() && observer.learner().is_some());
    let keys = &observer.keys;
    let join = ActorJoin {
        actor: 1,
        incarnation: 1,
    };
    let (newer, learner) = (WeightsRequest::NewerThan(0), new_learner(1));
    send(
        observer,
        [
            Row::of(observer, keys.of::<WeightsRequest>(), &newer, SILENCE),
            Row::of(observer, keys.of::<LearnerJoin>(), &learner, SILENCE),
            Row::of(observer, keys.of_actor::<ActorJoin>(1), &join, SILENCE),
            Row::new(keys.of_actor::<ChunkHeader>(1), [0; 100], SILENCE),
        ],
    );
    run.continues();
}
