//! Every message comes back as it was sent; damaged, foreign and hostile ones are refused, never a panic.
//! It opens no session.
#![allow(clippy::unwrap_used)]

mod batches;
mod samples;

use std::{fs, path::Path};

use driml_protocol::{
    AffinityUpdate, Batch, BatchHeader, BatchReply, Buffer, BufferPool, Chunk, ChunkHeader,
    CodecError, EPISODES_MAX, End, EndedEpisode, EpisodesReply, Hello, Horizon, Kind, NO_ACTION,
    PROTOCOL_VERSION, Played, RunSpec, Tally, TimeoutRule, WeightsHeader, WeightsUpload,
    WeightsVersion,
    codec::{self, HEADER_BYTES_MAX, PAYLOAD_BYTES_MAX, PREFIX_BYTES},
};
use proptest::prelude::*;

use crate::samples::{
    ACTIONS, SPEC, Sample, batch, chunk, episodes, forge, forge_whole, join, read_chunk, samples,
    sealed, weights,
};

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

#[test]
fn every_kind_has_a_sample_that_is_read() {
    let samples = samples();
    for kind in 1..=Kind::Recovering as u16 {
        assert!(
            samples.iter().any(|sample| sample.kind as u16 == kind),
            "kind {kind}"
        );
    }
    for sample in &samples {
        assert_eq!((sample.read)(&sample.bytes), Ok(()), "{}", sample.name);
    }
}

/// What fuzzers of the decoders begin with is today's messages: `UPDATE_CORPUS=1` writes them.
#[test]
fn the_fuzzers_seeds_are_the_samples() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/decoders/fuzz/corpus/wire");
    for (number, sample) in samples().iter().enumerate() {
        let file = folder.join(format!("sample-{number:02}"));
        if std::env::var_os("UPDATE_CORPUS").is_some() {
            fs::write(&file, &sample.bytes).unwrap();
        }
        let stored = fs::read(&file).unwrap_or_default();
        assert!(
            stored == sample.bytes,
            "{} is not today's {}: UPDATE_CORPUS=1 writes it",
            file.display(),
            sample.name
        );
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
