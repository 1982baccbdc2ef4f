//! Messages that a live replay server must refuse: of other runs and versions, damaged, cut off, not ours at all.
//! Each is counted once and stores nothing, and the server continues to store. That no cut and no flip is missed is the codec's test.

use driml_protocol::{
    AffinityUpdate, BatchRequest, Chunk, ChunkHeader, End, InsertReply, Leave, codec,
};
use driml_tests::{Client, Process, TestSystem};

use super::{
    Row, SILENCE, affinity, batch_request, chunk_header, leave, newer, sealed, send_refused,
};
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

impl Served {
    /// The next chunk of actor 0: two streams of three steps, the last one ending an episode.
    fn chunk(&self, sequence: u64) -> Chunk {
        let mut chunk = Chunk::zeroed(ChunkHeader {
            sequence,
            first_transition: 6 * sequence,
            streams: 2,
            steps: 3,
            ..chunk_header(&self.client, 0, INCARNATION)
        });
        for (row, action) in [0, 1, 2, 0, 1, 2].into_iter().enumerate() {
            let end = [End::Running, End::Running, End::Terminal][usize::from(action)];
            chunk.set(row, action, 0.5, end);
        }
        chunk
    }

    /// Sends what is refused: each row is counted, and stores nothing.
    fn refuses(&self, rows: impl IntoIterator<Item = Row>) {
        for row in rows {
            let why = format!("{}: {}", row.key, row.expected);
            let stored = || self.client.replay().unwrap().transitions_inserted;
            let before = stored();
            send_refused(&self.client, &why, [row], 1);
            assert_eq!(stored(), before, "{why}");
        }
    }

    /// Bytes that are refused in the place of chunks, for the reason.
    fn refuses_chunks(&self, rows: impl IntoIterator<Item = (Vec<u8>, &'static str)>) {
        let key = self.client.keys.of_actor::<ChunkHeader>(0);
        self.refuses(
            rows.into_iter()
                .map(|(bytes, why)| Row::new(&key, bytes, why)),
        );
    }

    /// The server still stores: chunk `sequence` arrives, once.
    fn stores(&self, sequence: u64) {
        let inserted_total = 6 * (sequence + 1);
        let stored = InsertReply::Stored {
            inserted_total,
            actors: 0,
            waited: false,
        };
        let retried = self.client.replay().unwrap().chunks_retried;
        for _ in 0..2 {
            assert_eq!(self.client.insert(&self.chunk(sequence)), stored);
        }
        let status = self.client.check_nothing_lost();
        assert_eq!(status.transitions_inserted, inserted_total);
        assert_eq!(status.chunks_retried, retried + 1, "the second was known");
    }
}

#[test]
fn chunks_of_other_runs_and_versions_damaged_ones_and_what_is_not_a_chunk() {
    let served = served();
    let hash = served.client.spec.hash();
    let whole = served.client.seal(&served.chunk(0));
    let chunk = served.chunk(0);
    let foreign = codec::encode(hash ^ 1, &chunk.header, chunk.payload()).unwrap();
    let leave = sealed(&served.client, &leave(0, INCARNATION, 0));
    let mut huge = whole.clone();
    huge[20..28].copy_from_slice(&u64::MAX.to_le_bytes());
    let mut damaged = whole.clone();
    damaged[33] ^= 0x10;
    let web = b"GET / HTTP/1.1\r\nHost: replay\r\nAccept: */*\r\n\r\n";
    served.refuses_chunks([
        (foreign, "start every process with the same settings"),
        (
            newer(whole.clone()),
            "run the same build of driml everywhere",
        ),
        (leave, "a message of kind 8 came where kind 1 is expected"),
        (web.to_vec(), "does not start with DRML"),
        (huge, "more than the"),
        (damaged, "checksum is wrong"),
        (vec![], "cut off or padded"),
        (whole[..40].to_vec(), "cut off or padded"),
        ([&whole[..], &[0]].concat(), "cut off or padded"),
    ]);
    served.stores(0);
}

/// All that makes no sense is tested beside the codec and the replay; here is some of what each of them refuses.
#[test]
fn chunks_that_make_no_sense_in_this_run() {
    let served = served();
    let row = |why, change: &dyn Fn(&mut Chunk)| {
        let mut chunk = served.chunk(0);
        change(&mut chunk);
        (served.client.seal(&chunk), why)
    };
    served.refuses_chunks([
        row("do not fill", &|it| it.header.steps = 4),
        row("the reward of row 5 is not finite", &|it| {
            it.set(5, 0, f32::NAN, End::Running)
        }),
        row("action 3; this run has 3", &|it| {
            it.set(4, 3, 0.0, End::Running)
        }),
        row("does not know this life of actor 0", &|it| {
            it.header.incarnation = 10
        }),
    ]);
    served.stores(0);
    served.client.join_as_actor(0, 10);
    let mut second_life = served.chunk(0);
    second_life.header.incarnation = 10;
    let reply = served.client.insert(&second_life);
    let is_second =
        matches!(reply, InsertReply::Stored { inserted_total, .. } if inserted_total == 12);
    assert!(is_second, "{reply:?}");
    let late = served.client.seal(&served.chunk(1));
    served.refuses_chunks([(late, "give each actor another number (--id)")]);
}

#[test]
fn everything_else_that_a_replay_server_takes() {
    let served = served();
    let (client, hash) = (&served.client, served.client.spec.hash());
    let garbage = b"DRML and then nothing that makes sense".to_vec();
    let batch = |rows| batch_request(LEARNER, rows);
    let leave = leave(0, INCARNATION, 1000);
    let affinity = affinity(LEARNER, 1, 2);
    let batches = client.keys.of::<BatchRequest>();
    let leaves = client.keys.of_actor::<Leave>(0);
    let affinities = client.keys.of::<AffinityUpdate>();
    let foreign_batch = codec::encode(hash ^ 1, &batch(16), &[]).unwrap();
    let foreign_leave = codec::encode(hash ^ 1, &leave, &[]).unwrap();
    served.refuses([
        // Requests are answered with the reason.
        Row::new(&batches, garbage.clone(), "Refused {"),
        Row::new(&batches, foreign_batch, "Refused {"),
        Row::of(client, &batch(0), "a batch of"),
        Row::of(client, &batch(u32::MAX), "a batch of"),
        // What needs no answer gets none.
        Row::new(&leaves, garbage.clone(), SILENCE),
        Row::new(&leaves, foreign_leave, SILENCE),
        Row::new(&affinities, garbage, SILENCE),
        Row::of(client, &affinity, SILENCE),
    ]);
    let status = client.replay().unwrap();
    assert_eq!((status.affinity_version, status.transitions_lost), (0, 0));
    served.stores(0);
    assert_eq!(served.system.survivors().len(), 1, "the server");
}
