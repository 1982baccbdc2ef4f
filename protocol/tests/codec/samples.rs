//! A sample message of every kind, and the code that reads it.
//! The only check here is that each sample survives encoding and decoding.

use std::fmt::Debug;

use driml_protocol::{
    Ack, ActorJoin, AffinityUpdate, Batch, BatchHeader, BatchReply, BatchRequest, Buffer, Chunk,
    ChunkHeader, ChunkPoll, CodecError, End, EpisodesReply, EpisodesRequest, InsertReply,
    JoinReply, LearnerJoin, LearnerStatus, Leave, Message, NO_ACTION, Origin, PriorityUpdate,
    ProcessesStatus, Recovering, ReplayStatus, Report, RowScalars, RunInfo, ShardCounts,
    StackedFrames, WeightsHeader, WeightsReply, WeightsRequest, WeightsUpload, WeightsVersion,
    codec,
};

pub(crate) const SPEC: u64 = 0x0123_4567_89ab_cdef;

/// A message of one type, and a check whether some bytes are accepted in its place.
pub(crate) struct Sample {
    pub(crate) name: String,
    pub(crate) kind: u16,
    pub(crate) bytes: Vec<u8>,
    pub(crate) read: fn(&[u8]) -> Result<(), CodecError>,
}

impl Sample {
    /// Encodes `header`, checks that it comes back, and keeps the bytes.
    pub(crate) fn new<M: Message + PartialEq + Debug>(header: &M) -> Self {
        Self::with_payload(header, &[])
    }

    fn with_payload<M: Message + PartialEq + Debug>(header: &M, payload: &[u8]) -> Self {
        let bytes = codec::encode(SPEC, header, payload).unwrap();
        for run in [Some(SPEC), None] {
            let back = codec::decode::<M>(&bytes, run).unwrap();
            assert_eq!((&back.0, back.1), (header, payload));
        }
        Self {
            name: format!("{header:?}"),
            kind: M::KIND,
            bytes,
            read: |bytes| codec::decode::<M>(bytes, Some(SPEC)).map(drop),
        }
    }

    fn batch(batch: Batch) -> Self {
        let (header, payload) = batch.into_payload();
        Self {
            read: |bytes| receive_batch(bytes).map(drop),
            ..Self::with_payload(&BatchReply::Batch(header), &payload)
        }
    }
}

pub(crate) fn read_chunk(bytes: &[u8]) -> Result<(), CodecError> {
    Chunk::decode(bytes, SPEC).map(|_| ())
}

pub(crate) fn receive_batch(bytes: &[u8]) -> Result<Batch, CodecError> {
    match codec::decode(bytes, Some(SPEC))? {
        (BatchReply::Batch(header), payload) => {
            Batch::from_payload(header, payload.to_vec().into())
        }
        (reply, _) => panic!("{reply:?}"),
    }
}

/// The error with which the receiver rejects a message.
pub(crate) fn refusal<M: Message>(message: &M, payload: &[u8]) -> String {
    let bytes = codec::encode(SPEC, message, payload).unwrap();
    let received = codec::decode::<M>(&bytes, Some(SPEC)).map(drop);
    received.unwrap_err().to_string()
}

pub(crate) fn chunk() -> Chunk {
    let mut chunk = Chunk::zeroed(ChunkHeader {
        actor: 3,
        incarnation: u64::MAX,
        sequence: 5,
        first_transition: 60,
        weights_version: 7,
        leaving: true,
        streams: 2,
        steps: 3,
        frame_bytes: 5,
    });
    for row in 0..6 {
        chunk.frame_mut(row).fill(row as u8 + 1);
        let end = End::from_byte(row as u8 % 4).unwrap();
        chunk.set(row, row as u8, -0.5 * row as f32, end);
    }
    chunk
}

pub(crate) fn batch() -> Batch {
    batch_from(None)
}

pub(crate) fn prioritised_batch() -> Batch {
    let mut batch = batch_from(Some(ORIGIN));
    batch.set_draws(&[(1 << 40, 0.5), (7, 1.0), (u64::MAX, 1e-30)]);
    batch
}

pub(crate) const ORIGIN: Origin = Origin {
    shard: 2,
    incarnation: u64::MAX,
};

/// Three rows: the first does not bootstrap, and the second has no positive and ends its episode.
pub(crate) fn rows() -> Vec<RowScalars> {
    let rows = [(4, 0.0, 2), (NO_ACTION, 0.0, 0), (6, 0.5, 300)];
    let scalars = |(row, (next_action, bootstrap_discount, k)): (u8, _)| RowScalars {
        action: row,
        next_action,
        n_step_return: 0.5 + f32::from(row),
        bootstrap_discount,
        positives: u32::from(k > 0),
        k_first: k,
    };
    (0..).zip(rows).map(scalars).collect()
}

/// Memory for a batch, with arbitrary content.
pub(crate) fn used_memory(bytes: usize) -> Buffer {
    Buffer::from(vec![0xAB; bytes])
}

pub(crate) fn batch_from(origin: Option<Origin>) -> Batch {
    let header = BatchHeader {
        rows: 3,
        positives: 1,
        state_bytes: 4,
        states_k: 2,
        states_n: 1,
        counts: ShardCounts::new(99, 12),
        held: 9,
        mean_age: 12.5,
        weights_versions: (8, 2),
        origin,
        stacked: None,
    };
    let mut batch = Batch::from_rows(header, &rows(), used_memory);
    assert_eq!(batch.header, header);
    for (number, byte) in [10, 11, 12, 30, 32, 22].into_iter().enumerate() {
        batch.frame_mut(number).fill(byte);
    }
    batch
}

pub(crate) const STACKED: StackedFrames = StackedFrames {
    frames: 5,
    frame_stack: 2,
    frame_channels: 1,
};

/// The numbers of the frames of each state: s_t of all rows; s_{t+k} of the first and the last; s_{t+n} of the last.
pub(crate) const STACKS: [u32; 12] = [0, 0, 0, 1, 1, 2, 0, 1, 3, 4, 4, 4];

/// The same rows with states that are stacks of two of five frames.
pub(crate) fn stacked_batch(origin: Option<Origin>) -> Batch {
    let header = BatchHeader {
        stacked: Some(STACKED),
        ..batch_from(origin).header
    };
    let mut batch = Batch::from_rows(header, &rows(), used_memory);
    assert_eq!(batch.header, header);
    for frame in 0..5 {
        batch.frame_mut(frame).fill(50 + frame as u8);
    }
    batch.set_stacks(&STACKS);
    if origin.is_some() {
        batch.set_draws(&[(1, 0.5), (2, 0.5), (3, 0.5)]);
    }
    batch
}

pub(crate) fn encoded_chunk() -> Vec<u8> {
    codec::encode(SPEC, &chunk().header, chunk().payload()).unwrap()
}

pub(crate) fn encoded(batch: Batch) -> Vec<u8> {
    let (header, payload) = batch.into_payload();
    codec::encode(SPEC, &BatchReply::Batch(header), &payload).unwrap()
}

pub(crate) fn weights() -> (WeightsUpload, Vec<u8>) {
    let payload: Vec<u8> = (0..40).collect();
    let upload = WeightsUpload {
        learner: 5,
        weights: WeightsHeader::new(4, 312, &payload),
    };
    (upload, payload)
}

/// Messages without payload: the name of each kind, and its fields as JSON. An entry ends with a semicolon at the end of a line.
const MESSAGES: &str = r#"
InsertReply {"Stored": {"inserted_total": 1099511627776, "actors": 64, "waited": true}};
InsertReply {"Wait": {"inserted_total": 0, "kept": true}};
InsertReply {"OutOfOrder": {"expected": 3}};
InsertReply {"Finished": {"inserted_total": 7}};
InsertReply {"Refused": {"why": "frames of 7 bytes"}};
JoinReply {"Welcome": {"inserted_total": 3, "weights_version": 4, "earlier_incarnations": 5}};
JoinReply {"Taken": {"why": "a"}};
JoinReply {"Refused": {"why": "b"}};
JoinReply {"Wait": {"why": "c"}};
BatchReply {"NotReady": {"Wait": "Neither"}};
BatchReply {"NotReady": {"Wait": {"WarmUp": {"have": 3, "need": 1000}}}};
BatchReply {"NotReady": {"Wait": "LearnerWaitsForActors"}};
BatchReply {"NotReady": {"Wait": "ActorsWaitForLearner"}};
BatchReply {"NotReady": {"Wait": "Finished"}};
BatchReply {"NotReady": "Finished"};
BatchReply {"NotReady": {"Refused": {"why": ""}}};
BatchRequest {"learner": 5, "id": {"client_id": 18446744073709551615, "number": 0, "attempt": 1}, "rows": 256, "shared_memory": true,
    "learned": {"updates": 4, "saved_updates": 2, "rows_received": 64}, "other_shards": {"inserted": 0, "rows_sampled": 0}};
Affinity {"learner": 5, "version": 2, "matrix": [0.25, 0.5, 0.25, 0.25, 0.5, 0.25, 0.25, 0.5, 0.25]};
Priorities {"learner": 5, "number": 9, "parts": [{"origin": {"shard": 2, "incarnation": 18446744073709551615},
    "transitions": [0, 18446744073709551615], "priorities": [0.0, 2.5]}]};
WeightsVersion {"version": 9};
Leave {"actor": 1, "incarnation": 2, "produced": 3};
ReplayStatus {};
ReplayStatus {"transitions_inserted": 5, "returns": {"known": 120, "newest": [-1.25, 3.0]}, "k_histogram": [1, 2, 3],
    "action_histogram": [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], "waiting": {"WarmUp": {"have": 5, "need": 9}}};
LearnerStatus {"updates": 3, "c51_kl": 0, "losses": [["dim_3t3", 0.5], ["dim_4t4", 1.5]], "total": 0, "grad_norm": 0, "q_mean": 0,
    "weights_version": 0, "weights_sha256": "", "computing_s": 0, "waiting_s": 0, "finished": false};
RunInfo {"config_toml": "[run]\nseed = 1\n", "inserted_total": 12, "has_learner": true, "after_updates": 3, "shard": [1, 2],
    "shared_memory": true};
Recovering {"progress": {"bytes_read": 1, "bytes": 2, "since_s": 3.5}, "config_toml": "[run]\nseed = 1\n"};
ActorJoin {"actor": 1, "incarnation": 2};
LearnerJoin {"learner": 5, "run": 1152921504606846976, "updates": 9, "counts": {"inserted": 7, "rows_sampled": 8},
    "other_shards": {"inserted": 0, "rows_sampled": 0}, "restart": true};
ChunkPoll {"actor": 1, "incarnation": 2, "sequence": 3, "leaving": true};
WeightsRequest {"NewerThan": 7};
WeightsRequest {"Piece": {"version": 8, "offset": 262144}};
Weights "NoneNewer";
Weights "Gone";
Weights {"Piece": {"weights": {"version": 8, "updates": 9, "sha256": [
    184, 8, 225, 86, 209, 141, 28, 236, 220, 193, 69, 99, 117, 248, 202, 233, 148, 195, 101, 73, 160, 124, 140, 35,
    21, 180, 115, 221, 157, 127, 64, 79]}, "bytes": 5, "offset": 0}};
Ack null;
Report {"who": {"Learner": 5}, "doing": "learns", "since_s": 1.5, "last_warning": {"text": "a chunk was refused", "age_s": 3.0}};
ProcessesStatus {"up_s": 60.0, "waiting": "ActorsWaitForLearner", "waiting_s": 2.5, "requests_waiting": 1, "chunks_waiting": 2,
    "chunk_bytes_waiting": 1048576, "weights_version": 4, "weights_age_s": 1.0,
    "log": {"folder": "replay", "bytes": 1048576, "bytes_max": 1073741824, "flushed_s": 0.5, "refused": [2.0, "full"],
        "unwritten_bytes": 40},
    "processes": [{"who": {"Actor": 3}, "connected": true, "since_s": 50.0, "lives": 2, "last_seen_s": 0.5, "weights_version": 3,
        "doing": ["plays", 5.0, 1.0], "last_warning": {"text": "late", "age_s": 9.0}}]};
EpisodesRequest {"since": 7, "is_launcher": true};
EpisodesReply {"ended": 9, "before": 7, "episodes": [
    {"frames": 1048576, "actor": 3, "env": 15, "totals": {"episode_return": 2.5, "steps": 99}},
    {"frames": 1048576, "actor": 3, "env": 15}]};
"#;

/// Returns the messages of type `M` in [`MESSAGES`].
pub(crate) fn messages<M: Message>() -> Vec<M> {
    let entries = MESSAGES.split(";\n").map(str::trim_start);
    let own = entries.filter_map(|entry| entry.strip_prefix(M::NAME)?.strip_prefix(' '));
    own.map(|json| serde_json::from_str(json).unwrap())
        .collect()
}

fn encoded_messages<M: Message + PartialEq + Debug>() -> Vec<Sample> {
    messages::<M>().iter().map(Sample::new).collect()
}

/// One or more messages of every kind.
pub(crate) fn samples() -> Vec<Sample> {
    let without_payload = [
        encoded_messages::<InsertReply>,
        encoded_messages::<JoinReply>,
        encoded_messages::<BatchReply>,
        encoded_messages::<BatchRequest>,
        encoded_messages::<AffinityUpdate>,
        encoded_messages::<PriorityUpdate>,
        encoded_messages::<WeightsVersion>,
        encoded_messages::<Leave>,
        encoded_messages::<ReplayStatus>,
        encoded_messages::<LearnerStatus>,
        encoded_messages::<RunInfo>,
        encoded_messages::<Recovering>,
        encoded_messages::<ActorJoin>,
        encoded_messages::<LearnerJoin>,
        encoded_messages::<ChunkPoll>,
        encoded_messages::<WeightsRequest>,
        encoded_messages::<WeightsReply>,
        encoded_messages::<Ack>,
        encoded_messages::<Report>,
        encoded_messages::<ProcessesStatus>,
        encoded_messages::<EpisodesRequest>,
        encoded_messages::<EpisodesReply>,
    ];
    let mut samples: Vec<Sample> = without_payload.iter().flat_map(|read| read()).collect();
    let (upload, payload) = weights();
    samples.extend([
        Sample {
            read: read_chunk,
            ..Sample::with_payload(&chunk().header, chunk().payload())
        },
        Sample::batch(batch()),
        Sample::batch(prioritised_batch()),
        Sample::batch(stacked_batch(None)),
        Sample::batch(stacked_batch(Some(ORIGIN))),
        Sample::with_payload(&upload, &payload),
    ]);
    samples
}
