//! A sample message of every kind, and the code that reads it.
//! The only check here is that each sample survives encoding and decoding.

use std::fmt::Debug;

use driml_protocol::{
    Ack, ActorJoin, AffinityUpdate, Batch, BatchHeader, BatchReply, BatchRequest, Buffer, Chunk,
    ChunkHeader, ChunkPoll, CodecError, End, EndedEpisode, EpisodesReply, EpisodesRequest,
    InsertReply, JoinReply, LearnerJoin, LearnerProgress, LearnerStatus, Leave, LogStatus, Message,
    NO_ACTION, NotReady, Origin, Participant, PriorityPart, PriorityUpdate, ProcessName,
    ProcessStatus, ProcessesStatus, Recovering, RecoveryProgress, ReplayStatus, Report, RequestId,
    Returns, RowScalars, RunInfo, ShardCounts, StackedFrames, Totals, Waiting, Warning,
    WeightsHeader, WeightsReply, WeightsRequest, WeightsUpload, WeightsVersion, Welcome,
    codec::{self},
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

pub(crate) fn processes_status() -> ProcessesStatus {
    ProcessesStatus {
        up_s: 60.0,
        waiting: Waiting::ActorsWaitForLearner,
        waiting_s: 2.5,
        requests_waiting: 1,
        chunks_waiting: 2,
        chunk_bytes_waiting: 1 << 20,
        weights_version: 4,
        weights_age_s: Some(1.0),
        log: Some(LogStatus {
            folder: "replay".into(),
            bytes: 1 << 20,
            bytes_max: Some(1 << 30),
            flushed_s: 0.5,
            refused: Some((2.0, "full".into())),
            unwritten_bytes: 40,
        }),
        last_warning: None,
        processes: vec![ProcessStatus {
            who: ProcessName::Actor(3),
            connected: true,
            since_s: 50.0,
            lives: 2,
            last_seen_s: Some(0.5),
            held_s: None,
            weights_version: Some(3),
            doing: Some(("plays".into(), 5.0, 1.0)),
            last_warning: Some(Warning::new("late", 9.0)),
        }],
    }
}

/// An episode that was received whole, and one of which a part was lost.
pub(crate) fn episodes() -> EpisodesReply {
    let whole = EndedEpisode {
        frames: 1 << 20,
        actor: 3,
        env: 15,
        totals: Some(Totals {
            episode_return: 2.5,
            steps: 99,
        }),
    };
    EpisodesReply {
        ended: 9,
        before: 7,
        episodes: vec![
            whole,
            EndedEpisode {
                totals: None,
                ..whole
            },
        ],
    }
}

pub(crate) fn priority_update() -> PriorityUpdate {
    PriorityUpdate {
        learner: 5,
        number: 9,
        parts: vec![PriorityPart {
            origin: ORIGIN,
            transitions: vec![0, u64::MAX],
            priorities: vec![0.0, 2.5],
        }],
    }
}

/// One or more messages of every kind.
pub(crate) fn samples() -> Vec<Sample> {
    let replies = [
        InsertReply::Stored {
            inserted_total: 1 << 40,
            actors: 64,
            waited: true,
        },
        InsertReply::Wait {
            inserted_total: 0,
            kept: true,
        },
        InsertReply::OutOfOrder { expected: 3 },
        InsertReply::Finished { inserted_total: 7 },
        InsertReply::Refused {
            why: "frames of 7 bytes".into(),
        },
    ];
    let waits = [
        Waiting::Neither,
        Waiting::WarmUp {
            have: 3,
            need: 1000,
        },
        Waiting::LearnerWaitsForActors,
        Waiting::ActorsWaitForLearner,
        Waiting::Finished,
    ];
    let replay = ReplayStatus {
        transitions_inserted: 5,
        returns: Returns {
            known: 120,
            newest: vec![-1.25, 3.0],
        },
        k_histogram: vec![1, 2, 3],
        action_histogram: vec![0; 15],
        waiting: Waiting::WarmUp { have: 5, need: 9 },
        ..ReplayStatus::default()
    };
    let learner = LearnerStatus {
        updates: 3,
        losses: vec![("dim_3t3".into(), 0.5), ("dim_4t4".into(), 1.5)],
        ..LearnerStatus::default()
    };
    let affinity = AffinityUpdate {
        learner: 5,
        version: 2,
        matrix: [0.25, 0.5, 0.25].repeat(3),
    };
    let run_info = RunInfo {
        config_toml: "[run]\nseed = 1\n".into(),
        inserted_total: 12,
        has_learner: true,
        after_updates: 3,
        shard: (1, 2),
        shared_memory: true,
    };
    let recovering = Recovering {
        progress: RecoveryProgress {
            bytes_read: 1,
            bytes: 2,
            since_s: 3.5,
        },
        config_toml: "[run]\nseed = 1\n".into(),
    };
    let mut samples: Vec<Sample> = replies.iter().map(Sample::new).collect();
    let joined = [
        JoinReply::Welcome(Welcome {
            inserted_total: 3,
            weights_version: 4,
            earlier_incarnations: 5,
        }),
        JoinReply::Taken { why: "a".into() },
        JoinReply::Refused { why: "b".into() },
        JoinReply::Wait { why: "c".into() },
    ];
    samples.extend(joined.map(|reply| Sample::new(&reply)));
    samples.extend(waits.map(|wait| Sample::new(&BatchReply::NotReady(NotReady::Wait(wait)))));
    samples.extend([
        Sample::new(&BatchReply::NotReady(NotReady::Finished)),
        Sample::new(&BatchReply::NotReady(NotReady::Refused {
            why: String::new(),
        })),
        Sample::new(&BatchRequest {
            learner: 5,
            id: RequestId::first(u64::MAX).retry(),
            rows: 256,
            shared_memory: true,
            learned: LearnerProgress {
                updates: 4,
                saved_updates: 2,
                rows_received: 64,
            },
            other_shards: Some(ShardCounts::default()),
        }),
        Sample::new(&affinity),
        Sample::new(&priority_update()),
        Sample::new(&WeightsVersion { version: 9 }),
        Sample::new(&Leave::new(1, 2, 3)),
        Sample::new(&ReplayStatus::default()),
        Sample::new(&replay),
        Sample::new(&learner),
        Sample::new(&run_info),
        Sample::new(&recovering),
        Sample::new(&ActorJoin::new(1, 2)),
        Sample::new(&LearnerJoin {
            learner: 5,
            run: 1 << 60,
            updates: 9,
            counts: ShardCounts::new(7, 8),
            other_shards: ShardCounts::default(),
            restart: true,
        }),
        Sample::new(&ChunkPoll {
            leaving: true,
            ..ChunkPoll::new(1, 2, 3)
        }),
        Sample::new(&WeightsRequest::NewerThan(7)),
        Sample::new(&WeightsRequest::Piece {
            version: 8,
            offset: 1 << 18,
        }),
        Sample::new(&WeightsReply::NoneNewer),
        Sample::new(&WeightsReply::Gone),
        Sample::new(&WeightsReply::Piece {
            weights: WeightsHeader::new(8, 9, b"these"),
            bytes: 5,
            offset: 0,
        }),
        Sample::new(&Ack),
        Sample::new(&Report::new(
            Participant::Learner(5),
            "learns",
            1.5,
            Some(Warning::new("a chunk was refused", 3.0)),
        )),
        Sample::new(&processes_status()),
        Sample::new(&EpisodesRequest {
            since: 7,
            is_launcher: true,
        }),
        Sample::new(&episodes()),
    ]);
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
