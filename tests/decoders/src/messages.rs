//! Messages: arbitrary bytes, and the same bytes with a valid prefix, so that the code behind the checksum is reached.

use std::{fmt::Debug, io::Read as _};

use driml_protocol::{
    Ack, ActorJoin, AffinityUpdate, Batch, BatchReply, BatchRequest, BufferPool, Chunk,
    ChunkHeader, ChunkPoll, CodecError, EpisodesReply, EpisodesRequest, InsertReply, JoinReply,
    Kind, LearnerJoin, LearnerStatus, Leave, Message, PROTOCOL_VERSION, PriorityUpdate,
    ProcessesStatus, Recovering, ReplayStatus, Report, RunInfo, WeightsReply, WeightsRequest,
    WeightsUpload, WeightsVersion, codec,
};

use crate::segments::repair_message;

/// The hash of the run spec in these messages.
const SPEC_HASH: u64 = 0x0123_4567_89ab_cdef;

type ReadFn = fn(&[u8]);

/// Reads a message in one piece and in several. Both ways must agree, and the message must be written back unchanged.
fn read<M: Message + Debug>(bytes: &[u8]) {
    let whole = codec::decode::<M>(bytes, Some(SPEC_HASH));
    let (first, second) = bytes.split_at(bytes.len() / 3);
    let pool = BufferPool::new(0);
    let pieces = codec::decode_from::<M>(first.chain(second), bytes.len(), &pool, None);
    match (whole, pieces) {
        (Ok((message, payload)), Ok((same, copy))) => {
            assert_eq!(payload, &copy[..]);
            let again = codec::encode(SPEC_HASH, &message, payload).unwrap();
            let (back, _) = codec::decode::<M>(&again, Some(SPEC_HASH)).unwrap();
            // Compare the texts, because a NaN does not equal itself.
            assert_eq!(format!("{back:?}"), format!("{message:?}"));
            assert_eq!(format!("{same:?}"), format!("{message:?}"));
        }
        (Err(_), Err(_)) | (Err(CodecError::RunSpec { .. }), Ok(_)) => {}
        (whole, pieces) => panic!("{:?} and {:?}", whole.err(), pieces.err()),
    }
}

fn read_chunk(bytes: &[u8]) {
    read::<ChunkHeader>(bytes);
    if let Ok(chunk) = Chunk::decode(bytes, SPEC_HASH) {
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
    let reply = codec::decode::<BatchReply>(bytes, Some(SPEC_HASH)).ok();
    if let Some((BatchReply::Batch(header), payload)) = reply {
        // The counts of states in the header may contradict the rows.
        let Ok(batch) = Batch::from_payload(header, payload.to_vec().into()) else {
            return;
        };
        assert_eq!(batch.n_step_returns().len(), batch.rows());
        let bytes = |states: u32| states as usize * header.state_bytes as usize;
        let planes = [header.rows, header.states_k, header.states_n].map(bytes);
        // A few frames can make many states.
        if planes.iter().sum::<usize>() < 1 << 20 {
            let states = [batch.states_t(), batch.states_k(), batch.states_n()];
            assert_eq!(states.map(|states| states.len()), planes);
        }
        let found = vec![0.5; batch.rows()];
        let update = batch.priority_update(1, 1, &found);
        assert_eq!(update.is_some(), batch.probabilities().is_some());
    }
}

/// Every kind of message and how it is read, in the order of their numbers.
const KINDS: [(Kind, ReadFn); Kind::ALL.len()] = [
    (Kind::Chunk, read_chunk),
    (Kind::InsertReply, read::<InsertReply>),
    (Kind::BatchRequest, read::<BatchRequest>),
    (Kind::BatchReply, read_batch),
    (Kind::Affinity, read_affinity),
    (Kind::Weights, read::<WeightsReply>),
    (Kind::WeightsVersion, read::<WeightsVersion>),
    (Kind::Leave, read::<Leave>),
    (Kind::ReplayStatus, read_status),
    (Kind::LearnerStatus, read::<LearnerStatus>),
    (Kind::RunInfo, read::<RunInfo>),
    (Kind::Ack, read::<Ack>),
    (Kind::ActorJoin, read::<ActorJoin>),
    (Kind::LearnerJoin, read::<LearnerJoin>),
    (Kind::JoinReply, read::<JoinReply>),
    (Kind::ChunkPoll, read::<ChunkPoll>),
    (Kind::WeightsUpload, read::<WeightsUpload>),
    (Kind::WeightsRequest, read::<WeightsRequest>),
    (Kind::Report, read::<Report>),
    (Kind::ProcessesStatus, read::<ProcessesStatus>),
    (Kind::Priorities, read::<PriorityUpdate>),
    (Kind::EpisodesRequest, read::<EpisodesRequest>),
    (Kind::EpisodesReply, read::<EpisodesReply>),
    (Kind::Recovering, read::<Recovering>),
];

fn read_affinity(bytes: &[u8]) {
    read::<AffinityUpdate>(bytes);
    if let Ok((update, _)) = codec::decode::<AffinityUpdate>(bytes, Some(SPEC_HASH)) {
        let _ = update.validate(update.matrix.len().isqrt() as u32);
    }
}

fn read_status(bytes: &[u8]) {
    read::<ReplayStatus>(bytes);
    if let Ok((status, _)) = codec::decode::<ReplayStatus>(bytes, Some(SPEC_HASH)) {
        let _ = (status.replay_ratio(), status.mean_k());
        let _ = ReplayStatus::merged(&[ReplayStatus::default(), status]);
    }
}

/// Reads arbitrary bytes as each kind of message. Then reads them with a valid prefix, as the kind that the prefix names.
pub(crate) fn messages(bytes: &[u8]) {
    KINDS.iter().for_each(|(_, read)| read(bytes));
    let mut message = bytes.to_vec();
    let Some(prefix) = message.first_chunk_mut::<{ codec::PREFIX_BYTES }>() else {
        return;
    };
    let number = u16::from_le_bytes([prefix[6], prefix[7]]);
    let (kind, read) = KINDS[usize::from(number.wrapping_sub(1)) % KINDS.len()];
    prefix[..4].copy_from_slice(b"DRML");
    prefix[4..6].copy_from_slice(&PROTOCOL_VERSION.to_le_bytes());
    prefix[6..8].copy_from_slice(&(kind as u16).to_le_bytes());
    prefix[8..16].copy_from_slice(&SPEC_HASH.to_le_bytes());
    repair_message(&mut message);
    read(&message);
}
