//! Weights that an actor must not act with, and greetings that no part must follow: of other runs and versions, damaged.
//! The learner, or the replay server, is played by the test itself.

use std::sync::{Arc, Mutex};

use driml_learner::{Compute, LearnerPart, Learning};
use driml_protocol::{
    Hello, Keys, Kind, PROTOCOL_VERSION, WeightsHeader, WeightsVersion, codec,
    session::{self, Endpoints},
};
use driml_tests::Client;
use zenoh::{Wait, query::Queryable};

use crate::system;

/// A learner that offers what it is told to.
struct FakeLearner<'a> {
    client: &'a Client,
    offered: Arc<Mutex<Vec<u8>>>,
    /// How often the weights were asked for.
    asked: Arc<Mutex<u32>>,
    _queryable: Queryable<()>,
}

impl<'a> FakeLearner<'a> {
    fn new(client: &'a Client) -> Self {
        let (offered, asked) = (
            Arc::<Mutex<Vec<u8>>>::default(),
            Arc::<Mutex<u32>>::default(),
        );
        let (held, count) = (offered.clone(), asked.clone());
        let answer = move |query| {
            *count.lock().unwrap() += 1;
            session::answer(&query, held.lock().unwrap().clone().into());
        };
        let declared = client
            .session
            .declare_queryable(client.keys.weights())
            .callback(answer);
        Self {
            client,
            offered,
            asked,
            _queryable: declared.wait().unwrap(),
        }
    }

    fn asked(&self) -> u32 {
        *self.asked.lock().unwrap()
    }

    /// Offers weights as a learner of the run with hash `spec_hash` would, and announces them.
    fn offer(&self, version: u64, safetensors: &[u8], spec_hash: u64) {
        let header = WeightsHeader::new(version, 0, safetensors);
        self.offer_bytes(
            version,
            codec::encode(Kind::Weights, spec_hash, &header, safetensors).unwrap(),
        );
    }

    fn offer_bytes(&self, version: u64, bytes: Vec<u8>) {
        *self.offered.lock().unwrap() = bytes;
        self.announce(version, self.client.spec.hash());
    }

    fn announce(&self, version: u64, spec_hash: u64) {
        let announced = codec::encode(
            Kind::WeightsVersion,
            spec_hash,
            &WeightsVersion { version },
            &[],
        )
        .unwrap();
        self.client
            .session
            .put(self.client.keys.weights_version(), announced)
            .wait()
            .unwrap();
    }
}

#[test]
fn an_actor_keeps_what_it_has() {
    let system = system();
    // Inserts alone are watched here, so the warm-up is as long as the run.
    let flags = "--env chain --agent c51 --preset smoke --set replay.capacity_transitions=20000000 --frames 20000000";
    let _server =
        system.start_replay_server(&format!("{flags} --set replay.warmup_transitions=19000000"));
    let client = system.connect();
    let hash = client.spec.hash();
    let part = LearnerPart::from_toml(&client.config_toml).unwrap();
    let (_, good) = Learning::new(part, &Compute::CPU)
        .unwrap()
        .next_weights()
        .unwrap();
    let learner = FakeLearner::new(&client);

    // Until there are weights that it may use, an actor asks again and steps nothing.
    learner.offer(1, &good, hash ^ 1);
    let mut actor = system.start_actor(0);
    driml_tests::wait_for("three questions for weights", || {
        (learner.asked() >= 3).then_some(())
    });
    assert_eq!(client.replay().unwrap().transitions_inserted, 0);
    learner.offer(1, &good, hash);
    client.wait_for_replay("transitions", |replay| replay.transitions_inserted > 0);

    // Then it keeps them, whatever comes.
    learner.offer(2, &good, hash ^ 1);
    actor.wait_for_stderr(
        "keeping weights 1, newer ones did not come: the message belongs to run spec",
    );
    let mut newer_protocol =
        codec::encode(Kind::Weights, hash, &WeightsHeader::new(3, 0, &good), &good).unwrap();
    newer_protocol[4..6].copy_from_slice(&(PROTOCOL_VERSION + 1).to_le_bytes());
    learner.offer_bytes(3, newer_protocol);
    actor.wait_for_stderr(
        "keeping weights 1, newer ones did not come: the sender speaks protocol version",
    );
    learner.announce(4, hash ^ 1);
    actor
        .wait_for_stderr("an announcement of weights was dropped: the message belongs to run spec");
    learner.offer_bytes(5, b"not weights".to_vec());
    actor.wait_for_stderr("keeping weights 1, newer ones did not come: the message has 11 bytes");
    // Of the right run, but no network of this shape: seen only when they are to be used.
    learner.offer(6, &good[..good.len() / 2], hash);
    actor.wait_for_stderr("weights 6 were refused, the old ones stay");

    let before = client.replay().unwrap().transitions_inserted;
    client.wait_for_replay("more transitions", |replay| {
        replay.transitions_inserted > before + 1000
    });
    drop(learner);
    actor.stop().expect_code(0);
    let replay = client.replay().unwrap();
    assert_eq!((replay.transitions_lost, replay.messages_refused), (0, 0));
}

#[test]
fn parts_of_another_protocol_version_do_not_join() {
    let system = system();
    let endpoints = Endpoints {
        listen: vec![system.endpoint()],
        connect: Vec::new(),
    };
    let server = session::open(&endpoints).unwrap();
    let hello = Hello {
        config_toml: String::new(),
        inserted_total: 0,
        after_updates: 0,
        shard: (0, 1),
    };
    let mut newer = codec::encode(Kind::Hello, 0, &hello, &[]).unwrap();
    newer[4..6].copy_from_slice(&(PROTOCOL_VERSION + 1).to_le_bytes());
    let greetings = [
        (newer, "run the same build of driml everywhere"),
        (b"hello?".to_vec(), "it was cut off or padded"),
        (
            codec::encode(Kind::Hello, 0, &hello, &[]).unwrap(),
            "the settings that the replay server sent",
        ),
    ];
    let key = Keys::new("driml").unwrap().hello();
    for (bytes, reason) in greetings {
        let answer = move |query| session::answer(&query, bytes.clone().into());
        let queryable = server
            .declare_queryable(&key)
            .callback(answer)
            .wait()
            .unwrap();
        for part in [system.start_actor(0), system.start_learner("run")] {
            part.wait().expect_code(1).expect_said(reason);
        }
        queryable.undeclare().wait().unwrap();
    }
    assert!(
        !system.path("run").exists(),
        "a learner that did not join writes nothing"
    );
    server.close().wait().unwrap();
}
