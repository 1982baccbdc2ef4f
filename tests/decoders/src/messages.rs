//! Messages: as they come, and with a prefix that fits, so that what is behind the checksum is reached.

use std::fmt::Debug;

use driml_protocol::{
    ActorJoin, AffinityUpdate, Batch, BatchHeader, BatchReply, BatchRequest, Buffer, BufferPool,
    Chunk, ChunkHeader, Claim, CodecError, Done, End, EndedEpisode, EpisodesReply, EpisodesRequest,
    Goodbye, Hello, InsertReply, JoinReply, Kind, LearnerJoin, LearnerStatus, Life, LogStatus,
    Message, NO_ACTION, Origin, PROTOCOL_VERSION, PartName, PartStatus, PartsStatus, Played,
    PriorityUpdate, Recovering, RecoveryProgress, ReplayStatus, Report, RequestId, Returns,
    RowScalars, StackedFrames, Tally, Waiting, Warning, WeightsHeader, WeightsReply,
    WeightsRequest, WeightsUpload, WeightsVersion, codec,
};

/// The hash of the run that these messages are of.
const SPEC: u64 = 0x0123_4567_89ab_cdef;
/// Actions of its world.
const ACTIONS: u32 = 15;
/// Bytes before the payload's length in what [`messages`] takes: the kind, and the length of the header.
const FORGED_BYTES: usize = 3;

/// Reads bytes as one type of message.
type Read = fn(&[u8]);

/// Reads a message in one piece and in several; both ways agree, and what is read comes back as it is.
fn read<M: Message + Debug>(bytes: &[u8]) {
    let whole = codec::decode::<M>(bytes, Some(SPEC));
    let (first, second) = bytes.split_at(bytes.len() / 3);
    let pool = BufferPool::new(0);
    let pieces = codec::receive::<M>([first, &[], second], bytes.len(), &pool, None);
    match (whole, pieces) {
        (Ok((message, payload)), Ok((same, copy))) => {
            assert_eq!(payload, &copy[..]);
            let again = codec::encode(SPEC, &message, payload).unwrap();
            let (back, _) = codec::decode::<M>(&again, Some(SPEC)).unwrap();
            // By their text, as a NaN is not equal to itself.
            assert_eq!(format!("{back:?}"), format!("{message:?}"));
            assert_eq!(format!("{same:?}"), format!("{message:?}"));
        }
        (Err(_), Err(_)) | (Err(CodecError::RunSpec { .. }), Ok(_)) => {}
        (whole, pieces) => panic!("{:?} and {:?}", whole.err(), pieces.err()),
    }
}

fn read_chunk(bytes: &[u8]) {
    read::<ChunkHeader>(bytes);
    if let Ok(chunk) = Chunk::decode(bytes, SPEC, ACTIONS) {
        for row in 0..chunk.header.transitions() {
            let _ = (chunk.end(row), chunk.reward(row));
        }
        assert_eq!(
            chunk.frames().len() + 6 * chunk.actions().len(),
            chunk.into_payload().len()
        );
    }
}

fn read_batch(bytes: &[u8]) {
    read::<BatchReply>(bytes);
    let reply = codec::decode::<BatchReply>(bytes, Some(SPEC)).ok();
    if let Some((header, payload)) = reply.and_then(|it| Some((it.0.header()?, it.1))) {
        // Its counts of states may not be those of its rows.
        let Ok(batch) = Batch::from_payload(header, payload.to_vec().into()) else {
            return;
        };
        assert_eq!(batch.n_step_returns().len(), batch.rows());
        let bytes = |states: u32| states as usize * header.state_bytes as usize;
        let planes = [header.rows, header.states_k, header.states_n].map(bytes);
        // Few frames may be many states.
        if planes.iter().sum::<usize>() < 1 << 20 {
            let states = [batch.states_t(), batch.states_k(), batch.states_n()];
            assert_eq!(states.map(|states| states.len()), planes);
        }
        let found = vec![0.5; batch.rows()];
        let update = batch.priority_update(1, 1, &found);
        assert_eq!(update.is_some(), batch.probabilities().is_some());
    }
}

/// Every kind of message and how it is read.
const KINDS: [(Kind, Read); 24] = [
    (Kind::Chunk, read_chunk),
    (Kind::InsertReply, read::<InsertReply>),
    (Kind::BatchRequest, read::<BatchRequest>),
    (Kind::BatchReply, read_batch),
    (Kind::Affinity, read_affinity),
    (Kind::Weights, read::<WeightsReply>),
    (Kind::WeightsVersion, read::<WeightsVersion>),
    (Kind::Goodbye, read::<Goodbye>),
    (Kind::ReplayStatus, read_status),
    (Kind::LearnerStatus, read::<LearnerStatus>),
    (Kind::Hello, read::<Hello>),
    (Kind::Done, read::<Done>),
    (Kind::ActorJoin, read::<ActorJoin>),
    (Kind::LearnerJoin, read::<LearnerJoin>),
    (Kind::JoinReply, read::<JoinReply>),
    (Kind::Claim, read::<Claim>),
    (Kind::WeightsUpload, read::<WeightsUpload>),
    (Kind::WeightsRequest, read::<WeightsRequest>),
    (Kind::Report, read::<Report>),
    (Kind::PartsStatus, read::<PartsStatus>),
    (Kind::EpisodesRequest, read::<EpisodesRequest>),
    (Kind::EpisodesReply, read::<EpisodesReply>),
    (Kind::Priorities, read::<PriorityUpdate>),
    (Kind::Recovering, read::<Recovering>),
];

fn read_affinity(bytes: &[u8]) {
    read::<AffinityUpdate>(bytes);
    if let Ok((update, _)) = codec::decode::<AffinityUpdate>(bytes, Some(SPEC)) {
        let _ = update.validate(update.num_actions.min(255));
    }
}

fn read_status(bytes: &[u8]) {
    read::<ReplayStatus>(bytes);
    if let Ok((status, _)) = codec::decode::<ReplayStatus>(bytes, Some(SPEC)) {
        let _ = (status.replay_ratio(), status.mean_k());
        let _ = ReplayStatus::merged(&[ReplayStatus::default(), status]);
    }
}

/// Bytes as they come, read as each kind of message.
pub(crate) fn wire(bytes: &[u8]) {
    KINDS.iter().for_each(|(_, read)| read(bytes));
}

/// A message with a good prefix: one byte chooses the kind, two are the header's length, the rest is header and payload.
pub(crate) fn messages(bytes: &[u8]) {
    let Some((bytes, read)) = sealed(bytes) else {
        return;
    };
    read(&bytes);
}

fn sealed(bytes: &[u8]) -> Option<(Vec<u8>, Read)> {
    let (&[kind, low, high], rest) = bytes.split_first_chunk::<FORGED_BYTES>()?;
    let (kind, read) = KINDS[usize::from(kind) % KINDS.len()];
    let header = usize::from(u16::from_le_bytes([low, high])).min(rest.len());
    let mut message = Vec::with_capacity(codec::PREFIX_BYTES + rest.len());
    message.extend_from_slice(b"DRML");
    message.extend_from_slice(&PROTOCOL_VERSION.to_le_bytes());
    message.extend_from_slice(&(kind as u16).to_le_bytes());
    message.extend_from_slice(&SPEC.to_le_bytes());
    message.extend_from_slice(&(header as u32).to_le_bytes());
    message.extend_from_slice(&((rest.len() - header) as u64).to_le_bytes());
    let mut sum = crc32fast::Hasher::new();
    sum.update(&message);
    sum.update(rest);
    message.extend_from_slice(&sum.finalize().to_le_bytes());
    message.extend_from_slice(rest);
    Some((message, read))
}

/// What the decoder `messages` takes, of a message's bytes.
pub fn forged(message: &[u8]) -> Vec<u8> {
    let kind = u16::from_le_bytes([message[6], message[7]]);
    let at = KINDS.iter().position(|(known, _)| *known as u16 == kind);
    let header = u16::from_le_bytes([message[16], message[17]]);
    let mut bytes = vec![at.unwrap() as u8];
    bytes.extend_from_slice(&header.to_le_bytes());
    bytes.extend_from_slice(&message[codec::PREFIX_BYTES..]);
    bytes
}

/// A good message of each kind, and of each variant of those that have several.
pub fn samples() -> Vec<Vec<u8>> {
    fn of<M: Message>(message: M) -> Vec<u8> {
        codec::encode(SPEC, &message, &[]).unwrap()
    }
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
        let end = End::from_byte(row as u8 % 4).unwrap();
        chunk.set(row, row as u8, -0.5 * row as f32, end);
    }
    let (mut sealed_chunk, payload) = chunk.seal(SPEC).unwrap();
    sealed_chunk.extend_from_slice(payload);
    let header = BatchHeader {
        rows: 3,
        positives: 1,
        state_bytes: 4,
        states_k: 2,
        states_n: 1,
        tally: Tally {
            inserted: 99,
            rows_sampled: 12,
        },
        held: 9,
        mean_age: 12.5,
        weights_versions: (8, 2),
        origin: None,
        stacked: None,
    };
    let row = |(action, positives, bootstrap_discount)| RowScalars {
        action,
        next_action: action,
        n_step_return: 0.5,
        bootstrap_discount,
        positives,
        k_first: positives,
    };
    let rows = [(0, 1, 0.0), (NO_ACTION, 0, 0.0), (6, 1, 0.5)].map(row);
    let memory = |bytes| Buffer::from(vec![7; bytes]);
    let mut prioritised = header;
    prioritised.origin = Some(Origin {
        shard: 1,
        incarnation: 1 << 40,
    });
    let mut prioritised = Batch::of_rows(prioritised, &rows, memory);
    prioritised.set_draws([(5, 0.5), (1 << 40, 0.25), (7, 1e-9)].into_iter());
    let priorities = prioritised.priority_update(5, 9, &[0.0, 1.5, 3e38]);
    let (prioritised, draws) = prioritised.into_payload();
    let mut stacked = header;
    stacked.stacked = Some(StackedFrames {
        frames: 5,
        frame_stack: 2,
        frame_channels: 1,
    });
    let mut stacked = Batch::of_rows(stacked, &rows, memory);
    let mut places = stacked.states_mut();
    for state in 0..6 {
        places.set_stack(state, &[state as u32 / 2, 4]);
    }
    let (stacked, frames) = stacked.into_payload();
    let (header, payload) = Batch::of_rows(header, &rows, memory).into_payload();
    let weights = WeightsHeader::new(4, 312, b"weights");
    let upload = WeightsUpload {
        learner: 5,
        weights,
    };
    let piece = WeightsReply::Piece {
        weights,
        bytes: 7,
        offset: 0,
    };
    let why = || "a reason".to_owned();
    let total = 1 << 40;
    let id = RequestId::first(9).next().again();
    let request = BatchRequest {
        learner: 5,
        id,
        rows: 256,
        shared_memory: true,
        other_shards: Some(Tally {
            inserted: 1,
            rows_sampled: 2,
        }),
    };
    let hello = Hello {
        config_toml: "[run]\nworld = \"chain\"\n".into(),
        inserted_total: total,
        tally: Tally::default(),
        after_updates: 7,
        shard: (0, 1),
        shared_memory: true,
    };
    let recovering = Recovering {
        progress: RecoveryProgress {
            bytes_read: 1 << 30,
            bytes: 1 << 33,
            since_s: 12.5,
        },
        config_toml: Some("[run]\nworld = \"chain\"\n".into()),
    };
    let status = ReplayStatus {
        transitions_inserted: 1000,
        returns: Returns {
            known: 2,
            newest: vec![0.5, f64::NAN],
        },
        k_histogram: vec![0, 5, 3],
        action_histogram: vec![1; 15],
        waiting: Waiting::WarmUp { have: 1, need: 2 },
        ..ReplayStatus::default()
    };
    let affinity = AffinityUpdate {
        learner: 5,
        version: 9,
        num_actions: 2,
        matrix: vec![0.5; 4],
    };
    let part = PartStatus {
        who: PartName::Actor(3),
        connected: true,
        since_s: 50.0,
        lives: 2,
        heard_s: Some(0.5),
        held_s: None,
        weights_version: Some(3),
        doing: Some(("plays".into(), 5.0, 1.0)),
        last_warning: Some(Warning::new("late", 9.0)),
    };
    let parts = PartsStatus {
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
        parts: vec![part],
    };
    let episode = EndedEpisode {
        frames: 1 << 20,
        actor: 3,
        copy: 15,
        played: Some(Played {
            episode_return: 2.5,
            steps: 99,
        }),
    };
    vec![
        sealed_chunk,
        of(InsertReply::Stored {
            inserted_total: total,
            actors: 64,
            waited: true,
        }),
        of(InsertReply::Wait {
            inserted_total: 1,
            kept: false,
        }),
        of(InsertReply::OutOfOrder { expected: 3 }),
        of(InsertReply::Finished { inserted_total: 3 }),
        of(InsertReply::Refused { why: why() }),
        of(request),
        codec::encode(SPEC, &BatchReply::Batch(header), &payload).unwrap(),
        of(BatchReply::Wait(Waiting::LearnerWaitsForActors)),
        of(BatchReply::Finished),
        of(BatchReply::Refused { why: why() }),
        of(affinity),
        codec::encode(SPEC, &piece, b"weights").unwrap(),
        of(WeightsReply::NoneNewer),
        of(WeightsReply::Gone),
        of(WeightsVersion { version: 4 }),
        of(Goodbye {
            actor: 3,
            incarnation: 7,
            produced: 4096,
        }),
        of(status),
        of(LearnerStatus::default()),
        of(hello),
        of(recovering),
        of(Done),
        of(ActorJoin {
            actor: 3,
            incarnation: 7,
        }),
        of(LearnerJoin {
            learner: 5,
            rows_sampled: 4096,
        }),
        of(JoinReply::Welcome {
            inserted_total: 1,
            weights_version: 2,
            earlier_incarnations: 3,
        }),
        of(JoinReply::Taken { why: why() }),
        of(JoinReply::Refused { why: why() }),
        of(Claim {
            actor: 3,
            incarnation: 7,
            sequence: 1,
            leaving: true,
        }),
        codec::encode(SPEC, &upload, b"weights").unwrap(),
        of(Report::new(
            Life::Learner(5),
            "learns",
            1.5,
            Some(Warning::new("a chunk was refused", 3.0)),
        )),
        of(parts),
        of(EpisodesRequest { since: 7 }),
        of(EpisodesReply {
            ended: 9,
            before: 7,
            episodes: vec![episode],
        }),
        of(WeightsRequest::NewerThan(3)),
        of(WeightsRequest::Piece {
            version: 3,
            offset: 1 << 18,
        }),
        codec::encode(SPEC, &BatchReply::of(prioritised), &draws).unwrap(),
        codec::encode(SPEC, &BatchReply::of(stacked), &frames).unwrap(),
        of(priorities.unwrap()),
    ]
}
