//! Messages that a live replay server must refuse: of other runs and versions, damaged, cut off, not ours at all.
//! That no such bytes make the codec panic is its own test; here a whole server lives on and goes on storing.

use driml_protocol::{
    AffinityUpdate, BatchReply, BatchRequest, Chunk, ChunkHeader, End, Goodbye, InsertReply,
    Learned, PROTOCOL_VERSION, RequestId, codec,
};
use driml_tests::{Client, Process, TestSystem};

use crate::{LONG, system};

/// A replay server and a client of it.
struct Served {
    client: Client,
    _server: Process,
    system: TestSystem,
}

/// The life of actor 0 that sends chunks here, and the learner.
const INCARNATION: u64 = 9;
const LEARNER: u64 = 5;

fn served() -> Served {
    let system = system();
    let server = system.start_replay_server(&format!("--agent driml-ada {LONG}"));
    let client = system.connect();
    client.join_as_actor(0, INCARNATION);
    client.join_as_learner(LEARNER);
    Served {
        client,
        _server: server,
        system,
    }
}

fn stored(inserted_total: u64) -> InsertReply {
    InsertReply::Stored {
        inserted_total,
        actors: 0,
        waited: false,
    }
}

impl Served {
    /// The next chunk of actor 0: two streams of three steps, the last one ending an episode.
    fn chunk(&self, sequence: u64) -> Chunk {
        let spec = &self.client.spec;
        let header = ChunkHeader {
            actor: 0,
            incarnation: INCARNATION,
            sequence,
            first_transition: 6 * sequence,
            weights_version: 1,
            leaving: false,
            streams: 2,
            steps: 3,
            frame_bytes: spec.frame_bytes() as u32,
        };
        let mut chunk = Chunk::zeroed(header);
        for row in 0..6 {
            let end = if row % 3 == 2 {
                End::Terminal
            } else {
                End::Running
            };
            chunk.set(row, (row % 3) as u8, 0.5, end);
        }
        chunk
    }

    fn sealed(&self, chunk: &Chunk, spec_hash: u64) -> Vec<u8> {
        let (head, payload) = chunk.seal(spec_hash).unwrap();
        [&head, payload].concat()
    }

    /// Sends bytes to the place of chunks and checks that they are refused for the reason, and counted.
    fn refused(&self, bytes: Vec<u8>, reason: &str) {
        let before = self.client.replay().unwrap();
        match self.client.insert_bytes(0, bytes) {
            InsertReply::Refused { why } => {
                assert!(why.contains(reason), "wanted {reason:?}, got {why:?}")
            }
            other => panic!("wanted {reason:?}, got {other:?}"),
        }
        let after = self.client.replay().unwrap();
        assert_eq!(
            after.messages_refused,
            before.messages_refused + 1,
            "{reason}"
        );
        assert_eq!(
            after.transitions_inserted, before.transitions_inserted,
            "{reason}"
        );
    }

    /// The server still stores: chunk `sequence` arrives, once.
    fn stores(&self, sequence: u64) {
        let inserted_total = 6 * (sequence + 1);
        let retried = self.client.replay().unwrap().chunks_retried;
        for _ in 0..2 {
            let reply = self.client.insert(&self.chunk(sequence));
            assert_eq!(reply, stored(inserted_total));
        }
        let status = self.client.replay().unwrap();
        assert_eq!(status.transitions_inserted, inserted_total);
        assert_eq!(status.chunks_retried, retried + 1, "the second was known");
        assert_eq!(
            (status.transitions_lost, status.transitions_duplicated),
            (0, 0)
        );
    }
}

#[test]
fn chunks_of_other_runs_and_versions() {
    let served = served();
    let hash = served.client.spec.hash();
    let chunk = served.chunk(0);
    served.refused(
        served.sealed(&chunk, hash ^ 1),
        "start every part with the same settings",
    );
    let mut newer = served.sealed(&chunk, hash);
    newer[4..6].copy_from_slice(&(PROTOCOL_VERSION + 1).to_le_bytes());
    served.refused(newer, "run the same build of driml everywhere");
    let goodbye = Goodbye {
        actor: 0,
        incarnation: INCARNATION,
        produced: 0,
    };
    let of_another_kind = codec::encode(hash, &goodbye, &[]).unwrap();
    served.refused(
        of_another_kind,
        "a message of kind 8 came where kind 1 is expected",
    );
    served.stores(0);
}

#[test]
fn damaged_chunks() {
    let served = served();
    let whole = served.sealed(&served.chunk(0), served.client.spec.hash());
    for length in [0, 1, 31, 32, 40, whole.len() / 2, whole.len() - 1] {
        served.refused(whole[..length].to_vec(), "cut off or padded");
    }
    served.refused([&whole[..], &[0]].concat(), "cut off or padded");
    for at in [8, 28, 33, whole.len() / 2, whole.len() - 1] {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x10;
        served.refused(damaged, "checksum is wrong");
    }
    served.refused(
        b"GET / HTTP/1.1\r\nHost: replay\r\nAccept: */*\r\n\r\n".to_vec(),
        "does not start with DRML",
    );
    let mut huge = whole.clone();
    huge[20..28].copy_from_slice(&u64::MAX.to_le_bytes());
    served.refused(huge, "more than the");
    served.stores(0);
}

#[test]
fn chunks_that_make_no_sense_in_this_run() {
    let served = served();
    let refused = |why: &str, change: &dyn Fn(&mut Chunk)| {
        let mut chunk = served.chunk(0);
        change(&mut chunk);
        served.refused(served.sealed(&chunk, served.client.spec.hash()), why);
    };
    refused("action 3 of 3", &|chunk| chunk.set(4, 3, 0.0, End::Running));
    refused("the reward of row 5 is not finite", &|chunk| {
        chunk.set(5, 0, f32::NAN, End::Running)
    });
    refused("do not fill", &|chunk| chunk.header.steps = 4);
    refused("do not fill", &|chunk| chunk.header.streams = u32::MAX);
    refused("do not fill", &|chunk| chunk.header.frame_bytes = 1);
    let smaller = ChunkHeader {
        frame_bytes: 1,
        ..served.chunk(0).header
    };
    refused("frames of 1 bytes; this run has 144", &|chunk| {
        *chunk = Chunk::zeroed(smaller)
    });
    refused("counts that no run reaches", &|chunk| {
        chunk.header.sequence = u64::MAX
    });

    // Not refused, but not stored either: what comes before it is missing.
    assert_eq!(
        served.client.insert(&served.chunk(1)),
        InsertReply::OutOfOrder { expected: 0 }
    );
    served.stores(0);
    served.stores(1);
    assert_eq!(
        served.client.insert(&served.chunk(3)),
        InsertReply::OutOfOrder { expected: 2 }
    );
    // Another life of the actor, and then a late message of the first.
    let mut second_life = served.chunk(0);
    second_life.header.incarnation = 10;
    let unknown = served.sealed(&second_life, served.client.spec.hash());
    served.refused(unknown, "does not know this life of actor 0");
    served.client.join_as_actor(0, 10);
    assert_eq!(served.client.insert(&second_life), stored(18));
    let late = served.sealed(&served.chunk(2), served.client.spec.hash());
    served.refused(late, "give each actor a number of its own");
}

#[test]
fn everything_else_that_a_replay_server_takes() {
    let served = served();
    let (client, hash) = (&served.client, served.client.spec.hash());
    let garbage = b"DRML and then nothing that makes sense".to_vec();
    let counted = || client.replay().unwrap().messages_refused;

    // Requests are answered with the reason.
    for bytes in [
        garbage.clone(),
        codec::encode(
            hash ^ 1,
            &BatchRequest {
                learner: LEARNER,
                id: RequestId::first(7),
                rows: 16,
                shared_memory: false,
                learned: Learned::default(),
                other_shards: None,
            },
            &[],
        )
        .unwrap(),
    ] {
        let before = counted();
        let reply = client
            .ask(&client.keys.of::<BatchRequest>(), bytes)
            .unwrap();
        let (reply, _): (BatchReply, _) = codec::decode(&reply, Some(hash)).unwrap();
        assert!(matches!(reply, BatchReply::Refused { .. }), "{reply:?}");
        assert_eq!(counted(), before + 1);
    }
    for rows in [0, u32::MAX] {
        let request = codec::encode(
            hash,
            &BatchRequest {
                learner: LEARNER,
                id: RequestId::first(7),
                rows,
                shared_memory: false,
                learned: Learned::default(),
                other_shards: None,
            },
            &[],
        )
        .unwrap();
        let reply = client
            .ask(&client.keys.of::<BatchRequest>(), request)
            .unwrap();
        let (reply, _): (BatchReply, _) = codec::decode(&reply, Some(hash)).unwrap();
        assert!(
            matches!(&reply, BatchReply::Refused { why } if why.contains("a batch of")),
            "{reply:?}"
        );
    }

    // What needs no answer gets none, and is counted.
    let goodbye = Goodbye {
        actor: 0,
        incarnation: 9,
        produced: 1000,
    };
    let affinity = AffinityUpdate {
        learner: LEARNER,
        version: 1,
        num_actions: 2,
        matrix: vec![0.5; 4],
    };
    for (key, bytes) in [
        (client.keys.of_actor::<Goodbye>(0), garbage.clone()),
        (
            client.keys.of_actor::<Goodbye>(0),
            codec::encode(hash ^ 1, &goodbye, &[]).unwrap(),
        ),
        (client.keys.of::<AffinityUpdate>(), garbage),
        (
            client.keys.of::<AffinityUpdate>(),
            codec::encode(hash, &affinity, &[]).unwrap(),
        ),
    ] {
        let before = counted();
        assert!(
            client.ask(&key, bytes).is_err(),
            "{key}: nothing is promised to whoever sends this"
        );
        assert_eq!(counted(), before + 1, "{key}");
    }
    let status = client.replay().unwrap();
    assert_eq!((status.affinity_version, status.transitions_lost), (0, 0));
    served.stores(0);
    assert_eq!(served.system.survivors().len(), 1, "the server");
}
