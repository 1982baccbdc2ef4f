//! Every message comes back as it was sent; damaged, foreign and hostile ones are refused, never a panic.
//! It opens no session.
#![allow(clippy::unwrap_used)]

use std::fmt::Debug;

use driml_protocol::{
    ActorJoin, AffinityUpdate, Batch, BatchHeader, BatchReply, BatchRequest, Buffer, BufferPool,
    Chunk, ChunkHeader, Claim, CodecError, Done, EPISODES_MAX, End, EndedEpisode, EpisodesReply,
    EpisodesRequest, Goodbye, Hello, Horizon, InsertReply, JoinReply, Kind, LearnerJoin,
    LearnerStatus, Life, LogStatus, Message, NO_ACTION, Origin, PROTOCOL_VERSION, PartName,
    PartStatus, PartsStatus, Played, PriorityPart, PriorityUpdate, ReplayStatus, Report, RequestId,
    Returns, RowScalars, RunSpec, StackedFrames, Tally, TimeoutRule, Waiting, Warning,
    WeightsHeader, WeightsReply, WeightsRequest, WeightsUpload, WeightsVersion,
    codec::{self, HEADER_BYTES_MAX, PAYLOAD_BYTES_MAX, PREFIX_BYTES},
};
use proptest::prelude::*;

const SPEC: u64 = 0x0123_4567_89ab_cdef;
const ACTIONS: u32 = 15;

/// A message of one type, and whether some bytes are accepted in its place.
struct Sample {
    name: String,
    kind: Kind,
    bytes: Vec<u8>,
    read: fn(&[u8]) -> Result<(), CodecError>,
}

impl Sample {
    /// Encodes `header`, checks that it comes back, and keeps the bytes.
    fn of<M: Message + PartialEq + Debug>(header: &M) -> Self {
        let bytes = codec::encode(SPEC, header, &[]).unwrap();
        let (back, payload) = codec::decode::<M>(&bytes, Some(SPEC)).unwrap();
        assert_eq!((&back, payload.len()), (header, 0));
        let (back, _) = codec::decode::<M>(&bytes, None).unwrap();
        assert_eq!(&back, header, "where any run is welcome");
        Self {
            name: format!("{header:?}"),
            kind: M::KIND,
            bytes,
            read: |bytes| codec::decode::<M>(bytes, Some(SPEC)).map(|_| ()),
        }
    }
}

fn read_chunk(bytes: &[u8]) -> Result<(), CodecError> {
    Chunk::decode(bytes, SPEC, ACTIONS).map(|_| ())
}

fn read_batch(bytes: &[u8]) -> Result<(), CodecError> {
    let (reply, payload) = codec::decode::<BatchReply>(bytes, Some(SPEC))?;
    match reply.header() {
        Some(header) => Batch::from_payload(header, payload.to_vec().into()).map(|_| ()),
        None => Ok(()),
    }
}

fn read_weights(bytes: &[u8]) -> Result<(), CodecError> {
    codec::decode::<WeightsUpload>(bytes, Some(SPEC)).map(|_| ())
}

fn chunk() -> Chunk {
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

fn batch() -> Batch {
    batch_from(None)
}

/// Its rows drawn by priority.
fn prioritised_batch() -> Batch {
    let mut batch = batch_from(Some(ORIGIN));
    let draws = [(1 << 40, 0.5), (7, 1.0), (u64::MAX, 1e-30)];
    batch.set_draws(draws.into_iter());
    batch
}

const ORIGIN: Origin = Origin {
    shard: 2,
    incarnation: u64::MAX,
};

/// Of these the first does not bootstrap, the second has no positive and ends its episode.
fn rows() -> Vec<RowScalars> {
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

fn batch_from(origin: Option<Origin>) -> Batch {
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
        origin,
        stacked: None,
    };
    let mut batch = Batch::of_rows(header, &rows(), |bytes| Buffer::from(vec![0xAB; bytes]));
    assert_eq!(batch.header, header);
    let mut places = batch.states_mut();
    for row in 0..3 {
        places.t(row).fill(10 + row as u8);
    }
    assert!(places.n(0).is_none() && places.n(1).is_none() && places.k(0, 1).is_none());
    places.n(2).unwrap().fill(22);
    places.k(0, 0).unwrap().fill(30);
    places.k(0, 2).unwrap().fill(32);
    batch
}

const STACKED: StackedFrames = StackedFrames {
    frames: 5,
    frame_stack: 2,
    frame_channels: 1,
};

/// The same rows, whose states are stacks of two of five frames.
fn stacked_batch(origin: Option<Origin>) -> Batch {
    let header = BatchHeader {
        stacked: Some(STACKED),
        ..batch_from(origin).header
    };
    let mut batch = Batch::of_rows(header, &rows(), |bytes| Buffer::from(vec![0xAB; bytes]));
    assert_eq!(batch.header, header);
    let mut places = batch.states_mut();
    for frame in 0..5 {
        places.frame(frame).fill(50 + frame as u8);
    }
    // s_t; s_{t+k} of the first and the last; s_{t+n} of the last.
    let stacks = [[0, 0], [0, 1], [1, 2], [0, 1], [3, 4], [4, 4]];
    for (state, stack) in stacks.iter().enumerate() {
        places.set_stack(state, stack);
    }
    if origin.is_some() {
        batch.set_draws([(1, 0.5), (2, 0.5), (3, 0.5)].into_iter());
    }
    batch
}

/// The bytes of a message as the wire joins them.
fn join((mut head, payload): (Vec<u8>, impl AsRef<[u8]>)) -> Vec<u8> {
    head.extend_from_slice(payload.as_ref());
    head
}

/// A batch as it travels.
fn sealed(batch: Batch) -> Vec<u8> {
    let (header, payload) = batch.into_payload();
    codec::encode(SPEC, &BatchReply::of(header), &payload).unwrap()
}

fn weights() -> Vec<u8> {
    let payload: Vec<u8> = (0..40).collect();
    let upload = WeightsUpload {
        learner: 5,
        weights: WeightsHeader::new(4, 312, &payload),
    };
    codec::encode(SPEC, &upload, &payload).unwrap()
}

fn parts_status() -> PartsStatus {
    PartsStatus {
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
        parts: vec![PartStatus {
            who: PartName::Actor(3),
            connected: true,
            since_s: 50.0,
            lives: 2,
            heard_s: Some(0.5),
            held_s: None,
            weights_version: Some(3),
            doing: Some(("plays".into(), 5.0, 1.0)),
            last_warning: Some(Warning::new("late", 9.0)),
        }],
    }
}

/// An episode of which all was seen, and one of which a part was lost.
fn episodes() -> EpisodesReply {
    let whole = EndedEpisode {
        frames: 1 << 20,
        actor: 3,
        copy: 15,
        played: Some(Played {
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
                played: None,
                ..whole
            },
        ],
    }
}

#[test]
fn episodes_that_did_not_end_are_refused() {
    let fewer = EpisodesReply {
        ended: 8,
        ..episodes()
    };
    let bytes = codec::encode(SPEC, &fewer, &[]).unwrap();
    let refused = codec::decode::<EpisodesReply>(&bytes, Some(SPEC)).unwrap_err();
    assert!(matches!(refused, CodecError::Header(_)), "{refused}");
    // The longest answer is one that can be sent.
    let most = EndedEpisode {
        frames: u64::MAX,
        actor: u32::MAX,
        copy: u32::MAX,
        played: Some(Played {
            episode_return: f64::MAX,
            steps: u64::MAX,
        }),
    };
    let longest = EpisodesReply {
        ended: u64::MAX,
        before: u64::MAX - EPISODES_MAX as u64,
        episodes: vec![most; EPISODES_MAX],
    };
    assert!(codec::encode(SPEC, &longest, &[]).is_ok());
}

fn priority_update() -> PriorityUpdate {
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
fn samples() -> Vec<Sample> {
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
        Waiting::Nobody,
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
        num_actions: 3,
        matrix: [0.25, 0.5, 0.25].repeat(3),
    };
    let hello = Hello {
        config_toml: "[run]\nseed = 1\n".into(),
        inserted_total: 12,
        tally: Tally::default(),
        after_updates: 3,
        shard: (1, 2),
        shared_memory: true,
    };
    let goodbye = Goodbye {
        actor: 1,
        incarnation: 2,
        produced: 3,
    };
    let mut samples: Vec<Sample> = replies.iter().map(Sample::of).collect();
    let joined = [
        JoinReply::Welcome {
            inserted_total: 3,
            weights_version: 4,
            earlier_incarnations: 5,
        },
        JoinReply::Taken { why: "a".into() },
        JoinReply::Refused { why: "b".into() },
    ];
    samples.extend(joined.map(|reply| Sample::of(&reply)));
    samples.extend(waits.map(|waiting| Sample::of(&BatchReply::Wait(waiting))));
    samples.extend([
        Sample::of(&BatchReply::Finished),
        Sample::of(&BatchReply::Refused { why: String::new() }),
        Sample::of(&BatchRequest {
            learner: 5,
            id: RequestId::first(u64::MAX).again(),
            rows: 256,
            shared_memory: true,
            other_shards: Some(Tally::default()),
        }),
        Sample::of(&affinity),
        Sample::of(&priority_update()),
        Sample::of(&WeightsVersion { version: 9 }),
        Sample::of(&goodbye),
        Sample::of(&ReplayStatus::default()),
        Sample::of(&replay),
        Sample::of(&learner),
        Sample::of(&hello),
        Sample::of(&ActorJoin {
            actor: 1,
            incarnation: 2,
        }),
        Sample::of(&LearnerJoin {
            learner: 5,
            rows_sampled: 9,
        }),
        Sample::of(&Claim {
            actor: 1,
            incarnation: 2,
            sequence: 3,
            leaving: true,
        }),
        Sample::of(&WeightsRequest::NewerThan(7)),
        Sample::of(&WeightsRequest::Piece {
            version: 8,
            offset: 1 << 18,
        }),
        Sample::of(&WeightsReply::NoneNewer),
        Sample::of(&WeightsReply::Gone),
        Sample::of(&WeightsReply::Piece {
            weights: WeightsHeader::new(8, 9, b"these"),
            bytes: 5,
            offset: 0,
        }),
        Sample::of(&Done),
        Sample::of(&Report::new(
            Life::Learner(5),
            "learns",
            1.5,
            Some(Warning::new("a chunk was refused", 3.0)),
        )),
        Sample::of(&parts_status()),
        Sample::of(&EpisodesRequest { since: 7 }),
        Sample::of(&episodes()),
    ]);
    let with_payload = [
        (
            "chunk",
            Kind::Chunk,
            join(chunk().seal(SPEC).unwrap()),
            read_chunk as fn(&[u8]) -> _,
        ),
        ("batch", Kind::BatchReply, sealed(batch()), read_batch),
        (
            "batch drawn by priority",
            Kind::BatchReply,
            sealed(prioritised_batch()),
            read_batch,
        ),
        (
            "batch of stacked frames",
            Kind::BatchReply,
            sealed(stacked_batch(None)),
            read_batch,
        ),
        (
            "batch of stacked frames drawn by priority",
            Kind::BatchReply,
            sealed(stacked_batch(Some(ORIGIN))),
            read_batch,
        ),
        ("weights", Kind::WeightsUpload, weights(), read_weights),
    ];
    samples.extend(with_payload.map(|(name, kind, bytes, read)| Sample {
        name: name.into(),
        kind,
        bytes,
        read,
    }));
    samples
}

/// A message with a right checksum and whatever else.
fn forge(version: u16, kind: u16, lengths: (u32, u64), header: &[u8], payload: &[u8]) -> Vec<u8> {
    let mut bytes = b"DRML".to_vec();
    bytes.extend(version.to_le_bytes());
    bytes.extend(kind.to_le_bytes());
    bytes.extend(SPEC.to_le_bytes());
    bytes.extend(lengths.0.to_le_bytes());
    bytes.extend(lengths.1.to_le_bytes());
    let mut hasher = crc32fast::Hasher::new();
    [&bytes, header, payload]
        .iter()
        .for_each(|part| hasher.update(part));
    bytes.extend(hasher.finalize().to_le_bytes());
    bytes.extend_from_slice(header);
    bytes.extend_from_slice(payload);
    bytes
}

fn forge_whole(kind: Kind, header: &[u8], payload: &[u8]) -> Vec<u8> {
    forge(
        PROTOCOL_VERSION,
        kind as u16,
        (header.len() as u32, payload.len() as u64),
        header,
        payload,
    )
}

#[test]
fn chunk_batch_and_weights_come_back() {
    let bytes = join(chunk().seal(SPEC).unwrap());
    let back = Chunk::decode(&bytes, SPEC, ACTIONS).unwrap();
    assert_eq!(back, chunk());
    assert_eq!(
        (back.actions()[4], back.reward(4), back.end(3)),
        (4, -2.0, End::Terminal)
    );
    assert_eq!(back.frames()[5 * 5..], [6; 5]);

    let bytes = sealed(batch());
    let (reply, payload) = codec::decode(&bytes, Some(SPEC)).unwrap();
    let BatchReply::Batch(header) = reply else {
        panic!("{reply:?}")
    };
    let back = Batch::from_payload(header, payload.to_vec().into()).unwrap();
    assert_eq!(back, batch());
    assert_eq!(
        back.states_t()[..],
        [10, 10, 10, 10, 11, 11, 11, 11, 12, 12, 12, 12]
    );
    assert_eq!(back.states_n()[..], [22; 4], "no state that a row lacks");
    assert_eq!(back.states_k()[..], [30, 30, 30, 30, 32, 32, 32, 32]);
    assert_eq!(
        (back.actions(), back.next_actions()),
        (&[0, 1, 2][..], &[4, NO_ACTION, 6][..])
    );
    assert_eq!(
        (back.positive_valid(), back.ks()),
        (&[1, 0, 1][..], &[2, 0, 255][..])
    );
    assert_eq!(back.n_step_returns(), [0.5, 1.5, 2.5]);
    assert_eq!(back.bootstrap_discounts(), [0.0, 0.0, 0.5]);

    let bytes = weights();
    let (upload, payload) = codec::decode::<WeightsUpload>(&bytes, Some(SPEC)).unwrap();
    let WeightsUpload { learner, weights } = upload;
    assert_eq!((learner, weights.version, weights.updates), (5, 4, 312));
    assert_eq!((payload.len(), weights.sha256_hex().len()), (40, 64));
}

/// However a message was cut on its way, what is received is what was sent, and in memory that held something else before.
#[test]
fn pieces_are_received_as_the_whole_is() {
    let pool = BufferPool::new(1);
    let bytes = join(chunk().seal(SPEC).unwrap());
    for at in 0..=bytes.len() {
        let (first, second) = bytes.split_at(at);
        pool.take_own(64).fill(0xAB);
        let pieces = [first, &[], second];
        let back = Chunk::receive(pieces, bytes.len(), &pool, SPEC, ACTIONS).unwrap();
        assert_eq!(back, chunk(), "cut at {at}");
        // A piece that is missing at the end, or a length that is not the sum of the pieces.
        if at < bytes.len() {
            assert!(Chunk::receive([first], at, &pool, SPEC, ACTIONS).is_err());
            assert!(Chunk::receive([first], bytes.len(), &pool, SPEC, ACTIONS).is_err());
        }
    }
    for flipped in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[flipped] ^= 1;
        let (first, second) = damaged.split_at(flipped / 2);
        let refused = Chunk::receive([first, second], bytes.len(), &pool, SPEC, ACTIONS);
        assert_eq!(
            refused.unwrap_err(),
            Chunk::decode(&damaged, SPEC, ACTIONS).unwrap_err()
        );
    }
}

/// What a uniform run sends has no byte of what priorities need.
#[test]
fn rows_drawn_by_priority_say_which_they_are_and_how_likely_they_were() {
    let (plain, prioritised) = (batch(), prioritised_batch());
    let more = prioritised.header.payload_bytes() - plain.header.payload_bytes();
    assert_eq!((more, plain.probabilities()), (3 * 12, None));
    let sent = [sealed(plain.clone()), sealed(prioritised.clone())].map(|bytes| bytes.len());
    // The origin: a byte of the shard, nine of the incarnation.
    assert_eq!(sent[1] - sent[0], 3 * 12 + 10);
    assert_eq!(plain.priority_update(5, 9, &[0.0; 3]), None);

    let bytes = sealed(prioritised.clone());
    let (reply, payload) = codec::decode::<BatchReply>(&bytes, Some(SPEC)).unwrap();
    assert!(matches!(reply, BatchReply::Prioritised(_, ORIGIN)));
    let mut back = Batch::from_payload(reply.header().unwrap(), payload.to_vec().into()).unwrap();
    assert_eq!(back, prioritised);
    assert_eq!(back.probabilities().unwrap(), [0.5, 1.0, 1e-30]);
    assert_eq!(
        (back.actions(), back.ks()),
        (&[0, 1, 2][..], &[2, 0, 255][..])
    );
    let update = back.priority_update(5, 9, &[1.0, 2.0, 3.0]).unwrap();
    let part = |origin, transitions: &[u64], priorities: &[f32]| PriorityPart {
        origin,
        transitions: transitions.to_vec(),
        priorities: priorities.to_vec(),
    };
    let own = [1 << 40, 7, u64::MAX];
    assert_eq!((update.learner, update.number, update.rows()), (5, 9, 3));
    assert_eq!(update.parts, [part(ORIGIN, &own, &[1.0, 2.0, 3.0])]);

    // Of two shards, the second of which gives three rows of four.
    let other = Origin {
        shard: 0,
        incarnation: 3,
    };
    let mut second = batch_from(Some(other));
    second.set_draws([(10, 0.5), (11, 0.25), (12, 0.25)].into_iter());
    back.scale_probabilities(0.25);
    second.scale_probabilities(0.75);
    let parts = [back, second];
    let whole = Batch::merged_header(&parts).unwrap();
    let merged = Batch::merge(&parts, Buffer::zeroed(whole.payload_bytes()));
    assert_eq!(
        merged.probabilities().unwrap(),
        [0.125, 0.25, 2.5e-31, 0.375, 0.1875, 0.1875]
    );
    let found = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
    let update = merged.priority_update(5, 9, &found).unwrap();
    let expected = [
        part(ORIGIN, &own, &found[..3]),
        part(other, &[10, 11, 12], &found[3..]),
    ];
    assert_eq!(update.parts, expected);
    let mixed = [merged, plain];
    assert_eq!(Batch::merged_header(&mixed), None);
}

/// What a run without stacks sends has no byte of what stacks need; what it sends otherwise is each frame once.
#[test]
fn stacks_come_back_as_whole_states() {
    for origin in [None, Some(ORIGIN)] {
        let sent = stacked_batch(origin);
        let more = sent.header.payload_bytes() - batch_from(origin).header.payload_bytes();
        // Five frames of two bytes, and two numbers of four for each of six states, which had four bytes.
        assert_eq!(more, 5 * 2 + 6 * 8 - 6 * 4);
        let bytes = sealed(sent.clone());
        let (reply, payload) = codec::decode::<BatchReply>(&bytes, Some(SPEC)).unwrap();
        assert!(matches!(reply, BatchReply::Stacked(_, STACKED, from) if from == origin));
        let back = Batch::from_payload(reply.header().unwrap(), payload.to_vec().into()).unwrap();
        assert_eq!(back, sent);
        assert_eq!(back.probabilities().is_some(), origin.is_some());
        assert_eq!(
            back.states_t()[..],
            [50, 50, 50, 50, 50, 51, 50, 51, 51, 52, 51, 52],
            "a pixel's oldest channels come first"
        );
        assert_eq!(back.states_k()[..], [50, 51, 50, 51, 53, 54, 53, 54]);
        assert_eq!(back.states_n()[..], [54, 54, 54, 54]);
        assert_eq!(back.ks(), [2, 0, 255]);
    }
}

/// Each part's states are made of its own frames.
#[test]
fn parts_of_stacks_are_merged() {
    let first = stacked_batch(None);
    let mut second = stacked_batch(None);
    for frame in 0..5 {
        second.states_mut().frame(frame).fill(150 + frame as u8);
    }
    let parts = [first, second, stacked_batch(None)];
    let whole = Batch::merged_header(&parts).unwrap();
    assert_eq!(whole.stacked.unwrap().frames, 15);
    let merged = Batch::merge(&parts, Buffer::from(vec![0xAB; whole.payload_bytes()]));
    let planes = |batch: &Batch| {
        [batch.states_t(), batch.states_k(), batch.states_n()].map(|plane| plane.to_vec())
    };
    let parts_planes = parts.each_ref().map(planes);
    for (at, plane) in planes(&merged).into_iter().enumerate() {
        assert_eq!(
            plane,
            parts_planes.each_ref().map(|it| &it[at][..]).concat()
        );
    }
    let (header, payload) = merged.into_payload();
    assert!(Batch::from_payload(header, payload).is_ok());

    let [part, ..] = parts;
    for other in [
        None,
        Some(StackedFrames {
            frame_stack: 4,
            ..STACKED
        }),
    ] {
        let mut other_part = part.clone();
        other_part.header.stacked = other;
        assert_eq!(Batch::merged_header(&[part.clone(), other_part]), None);
    }
}

#[test]
fn stacks_that_cannot_be_are_refused() {
    let said = |header, payload: Buffer| {
        let message = codec::encode(SPEC, &BatchReply::of(header), &payload).unwrap();
        read_batch(&message).unwrap_err().to_string()
    };
    for number in [5, 6, u32::MAX] {
        let mut wrong = stacked_batch(None);
        wrong.states_mut().set_stack(5, &[0, number]);
        let (header, payload) = wrong.into_payload();
        let said = said(header, payload);
        assert!(
            said.contains(&format!("a state of frame {number}, of 5 that travel")),
            "{said}"
        );
    }
    let (header, payload) = stacked_batch(None).into_payload();
    for wrong in [
        StackedFrames {
            frames: 0,
            ..STACKED
        },
        StackedFrames {
            frames: 4,
            ..STACKED
        },
        StackedFrames {
            frames: u32::MAX,
            ..STACKED
        },
        StackedFrames {
            frame_stack: 0,
            ..STACKED
        },
        StackedFrames {
            frame_stack: 1,
            ..STACKED
        },
        StackedFrames {
            frame_stack: 17,
            ..STACKED
        },
        StackedFrames {
            frame_stack: u32::MAX,
            ..STACKED
        },
        StackedFrames {
            frame_channels: 0,
            ..STACKED
        },
        StackedFrames {
            frame_channels: 3,
            ..STACKED
        },
        StackedFrames {
            frame_channels: u32::MAX,
            ..STACKED
        },
    ] {
        let header = BatchHeader {
            stacked: Some(wrong),
            ..header
        };
        let said = said(header, payload.clone());
        assert!(said.contains("do not fill"), "{wrong:?}: {said}");
    }
    // More frames than all stacks have room for.
    let most = StackedFrames {
        frames: 13,
        ..STACKED
    };
    let header = BatchHeader {
        stacked: Some(most),
        ..header
    };
    assert!(said(header, Buffer::zeroed(13 * 2 + 6 * 8 + 36)).contains("do not fill"));
}

/// A message of some MB whose states would fill the memory.
#[test]
fn few_frames_do_not_make_more_than_a_message_may_have() {
    let rows = vec![
        RowScalars {
            positives: 0,
            bootstrap_discount: 0.0,
            ..rows()[0]
        };
        4096
    ];
    let whole_bytes = codec::PAYLOAD_BYTES_MAX / rows.len();
    for (state_bytes, is_refused) in [(whole_bytes - 16, false), (whole_bytes, true)] {
        let header = BatchHeader {
            state_bytes: state_bytes as u32,
            stacked: Some(StackedFrames {
                frames: 1,
                ..STACKED
            }),
            ..batch().header
        };
        let (header, payload) = Batch::of_rows(header, &rows, Buffer::zeroed).into_payload();
        match Batch::from_payload(header, payload) {
            Ok(_) => assert!(!is_refused),
            Err(e) => {
                let said = e.to_string();
                assert!(
                    is_refused && said.contains("states would fill more than"),
                    "{said}"
                );
            }
        }
    }
}

#[test]
fn draws_and_priorities_that_cannot_be_are_refused() {
    for chance in [0.0, -0.5, 1.5, f32::NAN, f32::INFINITY] {
        let mut batch = prioritised_batch();
        batch.set_draws([(1, 0.5), (2, chance), (3, 0.5)].into_iter());
        let refused = read_batch(&sealed(batch)).unwrap_err().to_string();
        assert!(
            refused.contains("was drawn with the probability"),
            "{refused}"
        );
    }
    for priority in [-1.0, -1e-30, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut update = priority_update();
        update.parts[0].priorities[1] = priority;
        let bytes = codec::encode(SPEC, &update, &[]).unwrap();
        let refused = codec::decode::<PriorityUpdate>(&bytes, Some(SPEC)).unwrap_err();
        let said = refused.to_string();
        assert!(said.contains("no number from 0 on"), "{said}");
    }
    let mut update = priority_update();
    update.parts[0].priorities.pop();
    let bytes = codec::encode(SPEC, &update, &[]).unwrap();
    let refused = codec::decode::<PriorityUpdate>(&bytes, Some(SPEC)).unwrap_err();
    assert!(
        refused.to_string().contains("1 priorities of 2"),
        "{refused}"
    );
}

#[test]
fn parts_are_merged_row_by_row() {
    let header = |mean_age, versions| BatchHeader {
        rows: 0,
        positives: 3,
        state_bytes: 3,
        states_k: 0,
        states_n: 0,
        tally: Tally {
            inserted: 10,
            rows_sampled: 1,
        },
        held: 5,
        mean_age,
        weights_versions: versions,
        origin: None,
        stacked: None,
    };
    // Rows from `first` on, which have fewer positives and bootstraps, the higher their number.
    let part = |header: BatchHeader, values: std::ops::Range<u8>| {
        let scalars = |value: u8| RowScalars {
            action: value,
            next_action: value + 100,
            n_step_return: value.into(),
            bootstrap_discount: if value.is_multiple_of(2) { 0.5 } else { 0.0 },
            positives: 3 - u32::from(value) % 4,
            k_first: 1,
        };
        let rows: Vec<_> = values.clone().map(scalars).collect();
        let mut batch = Batch::of_rows(header, &rows, Buffer::zeroed);
        let mut places = batch.states_mut();
        for (row, value) in values.enumerate() {
            places.t(row).fill(value);
            if let Some(place) = places.n(row) {
                place.fill(value + 20);
            }
            for p in 0..3 {
                if let Some(place) = places.k(p, row) {
                    place.fill(value + 40 + 20 * p as u8);
                }
            }
        }
        batch
    };
    let parts = [
        part(header(1.0, (7, 3)), 0..4),
        part(header(4.0, (9, 5)), 4..6),
        part(header(1.0, (8, 4)), 6..8),
    ];
    let whole = Batch::merged_header(&parts).unwrap();
    let merged = Batch::merge(&parts, Buffer::from(vec![0xAB; whole.payload_bytes()]));
    let expected = part(whole, 0..8);
    assert_eq!((whole.mean_age, whole.weights_versions), (1.75, (9, 3)));
    assert_eq!((whole.tally.inserted, whole.held), (30, 15));
    assert_eq!((whole.rows, whole.states_k, whole.states_n), (8, 12, 4));
    assert_eq!(merged, expected);
    assert_eq!(
        merged.states_n()[..],
        [[20; 3], [22; 3], [24; 3], [26; 3]].concat()
    );

    let other = BatchHeader {
        state_bytes: 4,
        ..header(0.0, (1, 1))
    };
    let other = part(other, 0..1);
    assert_eq!(Batch::merged_header(&[parts[0].clone(), other]), None);
    assert_eq!(Batch::merged_header(&[]), None);
}

#[test]
fn every_kind_has_a_sample_that_is_read() {
    let samples = samples();
    for kind in 1..=20 {
        assert!(
            samples.iter().any(|sample| sample.kind as u16 == kind),
            "kind {kind}"
        );
    }
    for sample in &samples {
        assert_eq!((sample.read)(&sample.bytes), Ok(()), "{}", sample.name);
    }
}

#[test]
fn every_truncation_and_every_padding_is_refused() {
    for Sample {
        name, bytes, read, ..
    } in samples()
    {
        for length in 0..bytes.len() {
            let refused = read(&bytes[..length]).unwrap_err();
            let need = if length < PREFIX_BYTES {
                PREFIX_BYTES
            } else {
                bytes.len()
            };
            assert_eq!(
                refused,
                CodecError::Length { have: length, need },
                "{name} cut to {length}"
            );
        }
        let mut padded = bytes.clone();
        padded.push(0);
        let longer = CodecError::Length {
            have: padded.len(),
            need: bytes.len(),
        };
        assert_eq!(read(&padded), Err(longer), "{name}");
    }
}

#[test]
fn every_flipped_bit_is_refused() {
    for Sample {
        name,
        mut bytes,
        read,
        ..
    } in samples()
    {
        for bit in 0..8 * bytes.len() {
            bytes[bit / 8] ^= 1 << (bit % 8);
            let refused = read(&bytes).expect_err(&format!("{name} with bit {bit} flipped"));
            let expected = match bit / 8 {
                0..4 => refused == CodecError::Magic,
                4..6 => matches!(
                    refused,
                    CodecError::Version {
                        ours: PROTOCOL_VERSION,
                        ..
                    }
                ),
                16..28 => matches!(
                    refused,
                    CodecError::Length { .. } | CodecError::TooLarge { .. }
                ),
                _ => refused == CodecError::Checksum,
            };
            assert!(expected, "{name} with bit {bit} flipped: {refused}");
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
    }
}

#[test]
fn each_mismatch_has_its_own_error() {
    let header = [5u8];
    let read = |bytes: &[u8], hash| codec::decode::<WeightsVersion>(bytes, hash).map(|_| ());
    let good = forge_whole(Kind::WeightsVersion, &header, &[]);
    assert_eq!(
        good,
        codec::encode(SPEC, &WeightsVersion { version: 5 }, &[]).unwrap()
    );
    assert_eq!(read(&good, Some(SPEC)), Ok(()));

    let newer = forge(
        PROTOCOL_VERSION + 1,
        Kind::WeightsVersion as u16,
        (1, 0),
        &header,
        &[],
    );
    let version = CodecError::Version {
        theirs: PROTOCOL_VERSION + 1,
        ours: PROTOCOL_VERSION,
    };
    assert_eq!(read(&newer, Some(SPEC)), Err(version));
    for kind in [0, Kind::Goodbye as u16, 13, u16::MAX] {
        let other = forge(PROTOCOL_VERSION, kind, (1, 0), &header, &[]);
        let refused = CodecError::Kind {
            theirs: kind,
            ours: Kind::WeightsVersion as u16,
        };
        assert_eq!(read(&other, Some(SPEC)), Err(refused));
    }
    assert_eq!(
        read(&good, Some(SPEC + 1)),
        Err(CodecError::RunSpec {
            theirs: SPEC,
            ours: SPEC + 1
        })
    );
    assert_eq!(read(&good, None), Ok(()), "where any run is welcome");
    assert_eq!(
        read(b"", Some(SPEC)),
        Err(CodecError::Length {
            have: 0,
            need: PREFIX_BYTES
        })
    );
    assert_eq!(read(&[0; 64], Some(SPEC)), Err(CodecError::Magic));
    let longer = forge_whole(Kind::WeightsVersion, &[5, 0], &[]);
    assert!(
        matches!(read(&longer, Some(SPEC)), Err(CodecError::Header(_))),
        "a byte after the header's end"
    );
}

#[test]
fn huge_lengths_are_refused_without_taking_memory() {
    let read = |lengths| {
        let bytes = forge(
            PROTOCOL_VERSION,
            Kind::WeightsVersion as u16,
            lengths,
            &[5],
            &[],
        );
        codec::decode::<WeightsVersion>(&bytes, Some(SPEC)).unwrap_err()
    };
    let header = HEADER_BYTES_MAX as u32 + 1;
    assert_eq!(
        read((header, 0)),
        CodecError::TooLarge {
            have: header as usize,
            max: HEADER_BYTES_MAX
        }
    );
    assert_eq!(
        read((u32::MAX, u64::MAX)),
        CodecError::TooLarge {
            have: u32::MAX as usize,
            max: HEADER_BYTES_MAX
        }
    );
    assert_eq!(
        read((1, u64::MAX)),
        CodecError::TooLarge {
            have: usize::MAX,
            max: PAYLOAD_BYTES_MAX
        }
    );
    let need = PREFIX_BYTES + 1 + PAYLOAD_BYTES_MAX;
    assert_eq!(
        read((1, PAYLOAD_BYTES_MAX as u64)),
        CodecError::Length {
            have: PREFIX_BYTES + 1,
            need
        }
    );
    // A header that claims more elements than any header has room for.
    let claim = [&[1u8, 3, 253][..], &u64::MAX.to_le_bytes()].concat();
    let bytes = forge_whole(Kind::Affinity, &claim, &[]);
    let refused = codec::decode::<AffinityUpdate>(&bytes, Some(SPEC)).unwrap_err();
    assert!(matches!(refused, CodecError::Header(_)), "{refused}");
    // The sender keeps to the limit too.
    let hello = Hello {
        config_toml: "x".repeat(HEADER_BYTES_MAX),
        inserted_total: 0,
        tally: Tally::default(),
        after_updates: 0,
        shard: (0, 1),
        shared_memory: false,
    };
    let refused = codec::seal(SPEC, &hello, &[]).unwrap_err();
    assert!(
        matches!(
            refused,
            CodecError::TooLarge {
                max: HEADER_BYTES_MAX,
                ..
            }
        ),
        "{refused}"
    );
}

#[test]
fn counts_that_do_not_fit_their_payload_are_refused() {
    let header = chunk().header;
    let payload = &join(chunk().seal(SPEC).unwrap())[..];
    let payload = &payload[payload.len() - 6 * 11..];
    let read = |header: ChunkHeader| read_chunk(&codec::encode(SPEC, &header, payload).unwrap());
    assert_eq!(read(header), Ok(()));
    let most = u32::MAX;
    for wrong in [
        ChunkHeader {
            streams: 3,
            ..header
        },
        ChunkHeader { steps: 0, ..header },
        ChunkHeader {
            frame_bytes: 4,
            ..header
        },
        ChunkHeader {
            streams: most,
            steps: most,
            frame_bytes: most,
            ..header
        },
        ChunkHeader {
            streams: 1 << 31,
            steps: 1 << 31,
            frame_bytes: 4,
            ..header
        },
    ] {
        assert!(
            matches!(read(wrong), Err(CodecError::Header(_))),
            "{wrong:?}"
        );
    }
    let header = batch().header;
    for wrong in [
        BatchHeader { rows: 0, ..header },
        BatchHeader { rows: 4, ..header },
        BatchHeader {
            positives: 0,
            ..header
        },
        // As long, but other states than those of its rows.
        BatchHeader {
            states_k: 1,
            states_n: 2,
            ..header
        },
        BatchHeader {
            states_k: most,
            ..header
        },
        BatchHeader {
            rows: most,
            positives: most,
            state_bytes: most,
            states_k: most,
            states_n: most,
            ..header
        },
    ] {
        let (_, payload) = batch().into_payload();
        assert!(Batch::from_payload(wrong, payload).is_err(), "{wrong:?}");
    }
    assert!(
        Batch::from_payload(BatchHeader { rows: 0, ..header }, Buffer::zeroed(0)).is_err(),
        "no rows at all"
    );
}

#[test]
fn what_no_world_gives_is_refused() {
    let decode = |change: &dyn Fn(&mut Vec<u8>)| {
        let whole = join(chunk().seal(SPEC).unwrap());
        let mut payload = whole[whole.len() - 6 * 11..].to_vec();
        change(&mut payload);
        read_chunk(&codec::encode(SPEC, &chunk().header, &payload).unwrap())
    };
    assert_eq!(decode(&|_| {}), Ok(()));
    assert!(
        decode(&|payload| payload[30 + 2] = ACTIONS as u8)
            .unwrap_err()
            .to_string()
            .contains("action 15")
    );
    assert!(
        decode(&|payload| payload[36 + 5] = 4)
            .unwrap_err()
            .to_string()
            .contains("end 4")
    );
    for reward in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let refused =
            decode(&|payload| payload[42 + 4..42 + 8].copy_from_slice(&reward.to_le_bytes()));
        assert!(refused.unwrap_err().to_string().contains("row 1"));
    }
    let upload = WeightsUpload {
        learner: 5,
        weights: WeightsHeader::new(1, 1, b"these"),
    };
    let bytes = codec::encode(SPEC, &upload, b"those").unwrap();
    assert!(matches!(
        codec::decode::<WeightsUpload>(&bytes, Some(SPEC)),
        Err(CodecError::Header(_))
    ));
}

/// Any change of a field, and of the protocol version, makes another run.
#[test]
fn the_hash_knows_every_field() {
    let spec = RunSpec {
        world: "procgen/bigfish".into(),
        agent: "driml-ada".into(),
        seed: 1,
        frame_height: 64,
        frame_width: 64,
        frame_channels: 3,
        frame_stack: 1,
        num_actions: 15,
        n_step: 7,
        gamma: 0.99,
        horizon: Horizon::Nhg { k_max: 5 },
        timeout: TimeoutRule::Terminal,
    };
    let base = || spec.clone();
    let others = [
        RunSpec {
            world: "procgen/maze".into(),
            ..base()
        },
        RunSpec {
            agent: "c51".into(),
            ..base()
        },
        RunSpec { seed: 2, ..base() },
        RunSpec {
            frame_height: 32,
            ..base()
        },
        RunSpec {
            frame_width: 32,
            ..base()
        },
        RunSpec {
            frame_channels: 1,
            ..base()
        },
        RunSpec {
            frame_stack: 4,
            ..base()
        },
        RunSpec {
            num_actions: 14,
            ..base()
        },
        RunSpec {
            n_step: 1,
            ..base()
        },
        RunSpec {
            gamma: 0.9,
            ..base()
        },
        RunSpec {
            horizon: Horizon::Nhg { k_max: 4 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::Uniform { k_max: 5 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::Fixed { k: 5 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::All { k_max: 5 },
            ..base()
        },
        RunSpec {
            horizon: Horizon::None,
            ..base()
        },
        RunSpec {
            timeout: TimeoutRule::Bootstrap,
            ..base()
        },
    ];
    let mut hashes: Vec<u64> = others.iter().map(RunSpec::hash).collect();
    hashes.push(spec.hash());
    assert_eq!(spec.hash(), base().hash());
    // Checkpoints bear it: with another one nobody could go on with them.
    assert_eq!(format!("{:016x}", spec.hash()), "0c6c6069564f3984");
    hashes.sort_unstable();
    hashes.dedup();
    assert_eq!(hashes.len(), others.len() + 1);
}

proptest! {
    #[test]
    fn random_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let after_magic = [b"DRML", &bytes[..]].concat();
        for Sample { read, .. } in samples() {
            prop_assert!(read(&bytes).is_err());
            prop_assert!(read(&after_magic).is_err());
        }
    }

    /// Bytes with a right prefix and checksum are read or refused, but never a panic.
    #[test]
    fn random_headers_and_payloads_do_no_harm(
        header in prop::collection::vec(any::<u8>(), 0..80),
        payload in prop::collection::vec(any::<u8>(), 0..80),
    ) {
        for Sample { kind, read, .. } in samples() {
            let _ = read(&forge_whole(kind, &header, &payload));
        }
    }

    #[test]
    fn any_chunk_comes_back(
        (streams, steps, frame_bytes) in (1u32..5, 1u32..9, 0u32..40),
        (actor, incarnation, sequence, first_transition) in any::<(u32, u64, u64, u64)>(),
        fill in any::<u8>(),
        rewards in prop::collection::vec(-1e30f32..1e30, 45),
    ) {
        let mut chunk = Chunk::zeroed(ChunkHeader {
            actor, incarnation, sequence, first_transition, weights_version: incarnation ^ 1,
            leaving: fill > 99, streams, steps, frame_bytes,
        });
        for (row, &reward) in rewards.iter().enumerate().take(chunk.header.transitions()) {
            chunk.frame_mut(row).fill(fill.wrapping_add(row as u8));
            let end = End::from_byte((row % 4) as u8).unwrap();
            chunk.set(row, (row % 15) as u8, reward, end);
        }
        let bytes = join(chunk.seal(SPEC).unwrap());
        prop_assert_eq!(Chunk::decode(&bytes, SPEC, ACTIONS), Ok(chunk));
    }
}
