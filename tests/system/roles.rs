//! What a certificate is good for: its own role and number, and nothing else, whatever its holder sends.
//! Who is let in at all is in `tls`.

use std::{
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use driml_protocol::{
    ActorJoin, AffinityUpdate, Alive, BatchRequest, Chunk, ChunkHeader, Claim, Goodbye, Hello,
    InsertReply, Learned, LearnerJoin, LearnerStatus, ReplayStatus, RequestId, WeightsHeader,
    WeightsRequest, WeightsUpload, WeightsVersion, codec, session, tls::Role,
};
use driml_tests::{Client, Process, new_learner};
use zenoh::{Wait, qos::Priority, query::Query, sample::Locality};

use crate::{LONG, tls::TlsSystem};

/// How long an answer is waited for that does not come.
const NO_ANSWER: Duration = Duration::from_millis(700);

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

    /// A question at `key` gets no answer.
    fn denied(&self, who: Role, client: &Client, key: &str, bytes: Vec<u8>) {
        let asked = session::ask(
            &client.session,
            key,
            bytes.into(),
            Priority::Data,
            NO_ANSWER,
        );
        assert!(asked.is_err(), "{who} at {key}: {asked:?}");
    }

    /// The run goes on as if nothing had been.
    fn goes_on(&self) {
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
    let (one, role) = (run.tls.client(Role::Actor(1)), Role::Actor(1));
    let (keys, hash) = (one.keys.clone(), one.spec.hash());
    let weights = WeightsHeader::new(1 << 19, 0, b"w");
    let (other, life) = (0, 9);
    let goodbye = Goodbye {
        actor: other,
        incarnation: life,
        produced: 0,
    };
    let join = ActorJoin {
        actor: other,
        incarnation: life,
    };
    let claim = Claim {
        actor: other,
        incarnation: life,
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
    let learner = new_learner(1);
    let upload = WeightsUpload {
        learner: 1,
        weights,
    };
    let encoded = |bytes: Result<Vec<u8>, driml_protocol::CodecError>| bytes.unwrap();
    for (key, bytes) in [
        (
            keys.of::<BatchRequest>(),
            encoded(codec::encode(hash, &batch, &[])),
        ),
        (
            keys.of::<AffinityUpdate>(),
            encoded(codec::encode(hash, &affinity, &[])),
        ),
        (
            keys.of::<LearnerJoin>(),
            encoded(codec::encode(hash, &learner, &[])),
        ),
        (
            keys.of::<WeightsUpload>(),
            encoded(codec::encode(hash, &upload, b"w")),
        ),
        (
            keys.of_actor::<ActorJoin>(other),
            encoded(codec::encode(hash, &join, &[])),
        ),
        (
            keys.of_actor::<Goodbye>(other),
            encoded(codec::encode(hash, &goodbye, &[])),
        ),
        (
            keys.of_actor::<Claim>(other),
            encoded(codec::encode(hash, &claim, &[])),
        ),
        (keys.of_actor::<ChunkHeader>(other), vec![0; 100]),
        (
            keys.of::<Goodbye>(),
            encoded(codec::encode(hash, &goodbye, &[])),
        ),
        (keys.of::<ReplayStatus>(), Vec::new()),
        (keys.of::<LearnerStatus>(), Vec::new()),
        ("driml/**".into(), Vec::new()),
    ] {
        run.denied(role, &one, &key, bytes);
    }

    // At its own keys, messages that speak for another.
    let before = run.refused();
    let mut chunk = Chunk::zeroed(ChunkHeader {
        actor: other,
        incarnation: life,
        sequence: 0,
        first_transition: 0,
        weights_version: 1,
        leaving: false,
        streams: 1,
        steps: 1,
        frame_bytes: one.spec.frame_bytes() as u32,
    });
    chunk.set(0, 0, 1.0, driml_protocol::End::Running);
    let (mut bytes, payload) = chunk.seal(hash).unwrap();
    bytes.extend_from_slice(payload);
    let reply = one.insert_bytes(1, bytes);
    assert!(
        matches!(&reply, InsertReply::Refused { why } if why.contains("speaks for actor 0 at the key")),
        "{reply:?}"
    );
    for (key, bytes) in [
        (
            keys.of_actor::<Goodbye>(1),
            codec::encode(hash, &goodbye, &[]).unwrap(),
        ),
        (
            keys.of_actor::<ActorJoin>(1),
            codec::encode(hash, &join, &[]).unwrap(),
        ),
        (
            keys.of_actor::<Claim>(1),
            codec::encode(hash, &claim, &[]).unwrap(),
        ),
    ] {
        let asked = session::ask(&one.session, &key, bytes.into(), Priority::Data, NO_ANSWER);
        assert!(asked.is_err(), "{key}: {asked:?}");
    }
    assert_eq!(run.refused(), before + 4);
    run.goes_on();
}

/// Neither answers in the place of others, nor announces, nor hears what is not for it, nor counts as somebody else.
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
    let heard = Arc::<AtomicUsize>::default();
    let counter = heard.clone();
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

    // Somebody who joins now is told the truth.
    let mut two = run.tls.start("actor --id 2", "tls");
    two.wait_for_stderr("actor 2 steps");
    run.observer
        .wait_for_replay("both", |replay| replay.actors == 2);
    two.stop().expect_code(0).expect_said("leaves: ");
    run.observer
        .wait_for_replay("one", |replay| replay.actors == 1);
    run.goes_on();
    assert_eq!(asked.load(Ordering::Relaxed), 0, "nobody asks an actor");
    assert_eq!(
        heard.load(Ordering::Relaxed),
        0,
        "nobody tells it what is not for it"
    );
    drop((declared, everything, other, learner));
}

#[test]
fn an_observer_only_looks() {
    let Some(run) = Guarded::new("an_observer_only_looks") else {
        return;
    };
    let observer = run.tls.client(Role::Observer);
    assert!(observer.replay().is_some() && observer.learner().is_some());
    let (keys, hash) = (observer.keys.clone(), observer.spec.hash());
    let request = codec::encode(hash, &WeightsRequest::NewerThan(0), &[]).unwrap();
    let learner = new_learner(1);
    let learner = codec::encode(hash, &learner, &[]).unwrap();
    let join = ActorJoin {
        actor: 1,
        incarnation: 1,
    };
    let join = codec::encode(hash, &join, &[]).unwrap();
    for (key, bytes) in [
        (keys.of::<WeightsRequest>(), request),
        (keys.of::<LearnerJoin>(), learner),
        (keys.of_actor::<ActorJoin>(1), join),
        (keys.of_actor::<ChunkHeader>(1), vec![0; 100]),
    ] {
        run.denied(Role::Observer, &observer, &key, bytes);
    }
    run.goes_on();
}
