//! Messages that a live replay server must reject: of other runs, damaged, or not driml's at all.
//! Each is counted once and stores nothing, and the server continues to store. The codec's tests check that no cut and no flip is missed.

use driml_protocol::{
    AffinityUpdate, BatchRequest, Chunk, ChunkHeader, End, InsertReply, Leave, Message,
    Participant, Shutdown, codec, reporter,
};
use driml_tests::Client;

use super::{NO_REPLY, Row, affinity, batch_request, check_refused, chunk_header};
use crate::{LONG, system};

/// The incarnation of actor 0, which sends the chunks here, and the number of the learner.
const INCARNATION: u64 = 9;
const LEARNER: u64 = 5;

/// Returns the next chunk of actor 0: two streams of three steps, the last one ending an episode.
fn chunk(client: &Client, sequence: u64) -> Chunk {
    let mut chunk = Chunk::zeroed(ChunkHeader {
        sequence,
        first_transition: 6 * sequence,
        streams: 2,
        steps: 3,
        ..chunk_header(client, 0, INCARNATION)
    });
    for (row, action) in [0, 1, 2, 0, 1, 2].into_iter().enumerate() {
        let end = [End::Running, End::Running, End::Terminal][usize::from(action)];
        chunk.set(row, action, 0.5, end);
    }
    chunk
}

/// Encodes a message of another run.
fn foreign(client: &Client, message: &impl Message, payload: &[u8]) -> Vec<u8> {
    codec::encode(client.spec.hash() ^ 1, message, payload).unwrap()
}

/// Returns messages that are rejected at the key for chunks, each with words of the reason. The crates test all kinds of them.
fn invalid_chunks(client: &Client) -> [(Vec<u8>, &'static str); 4] {
    let chunk = chunk(client, 0);
    let foreign = foreign(client, &chunk.header, chunk.payload());
    let mut damaged = client.encode_chunk(&chunk);
    damaged[33] ^= 0x10;
    let [mut no_number, mut unknown] = [chunk.clone(), chunk];
    no_number.set(5, 0, f32::NAN, End::Running);
    unknown.header.incarnation = 10;
    let [no_number, unknown] = [no_number, unknown].map(|it| client.encode_chunk(&it));
    [
        (foreign, "start every process with the same settings"),
        (damaged, "checksum is wrong"),
        (no_number, "the reward of row 5 is not finite"),
        (unknown, "does not know this incarnation of actor 0"),
    ]
}

#[test]
fn what_is_refused_is_counted_stores_nothing_and_stops_nothing() {
    let system = system();
    let _server = system.start_replay_server(&format!("--agent driml-ada {LONG}"));
    let client = &system.connect();
    client.join_as_actor(0, INCARNATION);
    client.join_as_learner(LEARNER);
    let keys = &client.keys;
    let check = |row: Row| {
        let why = format!("{}: {}", row.key, row.expected);
        let stored = || client.replay_status().unwrap().transitions_inserted;
        let before = stored();
        check_refused(client, &why, [row], 1);
        assert_eq!(stored(), before, "{why}");
    };
    let check_chunk =
        |(bytes, why): (Vec<u8>, _)| check(Row::new(keys.actor_key::<ChunkHeader>(0), bytes, why));
    invalid_chunks(client).into_iter().for_each(check_chunk);

    let garbage = b"DRML and then nothing that makes sense";
    let batch = |rows| batch_request(LEARNER, rows);
    let (batches, leaves) = (keys.key::<BatchRequest>(), keys.actor_key::<Leave>(0));
    let leave = Leave::new(0, INCARNATION, 1000);
    let others = [
        // The replies to requests contain the reason.
        Row::new(&batches, garbage, "Refused {"),
        Row::new(&batches, foreign(client, &batch(16), &[]), "Refused {"),
        Row::of(client, &batch(0), "a batch of"),
        Row::of(client, &batch(u32::MAX), "a batch of"),
        // Messages that need no reply get none.
        Row::new(&leaves, garbage, NO_REPLY),
        Row::new(&leaves, foreign(client, &leave, &[]), NO_REPLY),
        Row::new(keys.key::<AffinityUpdate>(), garbage, NO_REPLY),
        Row::of(client, &affinity(LEARNER, 1, 2), NO_REPLY),
    ];
    others.into_iter().for_each(check);
    let status = client.replay_status().unwrap();
    assert_eq!((status.affinity_version, status.transitions_lost), (0, 0));

    // The server still stores: the chunk arrives, once.
    let stored = |inserted_total| InsertReply::Stored {
        inserted_total,
        actors: 0,
        waited: false,
    };
    for _ in 0..2 {
        assert_eq!(client.insert(&chunk(client, 0)), stored(6));
    }
    let status = client.check_nothing_lost();
    assert_eq!(status.transitions_inserted, 6);
    assert_eq!(status.chunks_retried, 1, "the second was known");
    client.join_as_actor(0, 10);
    let mut second_life = chunk(client, 0);
    second_life.header.incarnation = 10;
    assert_eq!(client.insert(&second_life), stored(12));
    let late = client.encode_chunk(&chunk(client, 1));
    check_chunk((late, "give each actor another number (--id)"));
    // Once the learner has finished, no transition is wanted.
    let clients = [client.run_client()];
    reporter::report_finished(
        &clients,
        Participant::Learner(LEARNER),
        0,
        &Shutdown::default(),
    );
    let mut next = chunk(client, 1);
    next.header.incarnation = 10;
    let inserted_total = 12;
    assert_eq!(
        client.insert(&next),
        InsertReply::Finished { inserted_total }
    );
    assert_eq!(system.running_processes().len(), 1, "the server");
}
