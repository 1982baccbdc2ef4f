//! Damaged, foreign and hostile messages are rejected and never cause a panic.
//! Inputs that fuzzers found are in `decoders`.

use driml_protocol::{
    AffinityUpdate, Batch, BatchHeader, BatchReply, Buffer, ChunkHeader, CodecError, EPISODES_MAX,
    EndedEpisode, EpisodesReply, Kind, PROTOCOL_VERSION, Participant, PriorityUpdate, Recovering,
    RecoveryProgress, Report, RunInfo, Totals, Warning, WeightsHeader, WeightsUpload,
    WeightsVersion,
    codec::{self, HEADER_BYTES_MAX, PAYLOAD_BYTES_MAX, PREFIX_BYTES},
};

use crate::samples::{
    SPEC, Sample, batch, chunk, messages, prioritised_batch, read_chunk, refusal, samples,
};

#[test]
fn every_truncation_and_every_padding_is_refused() {
    for Sample {
        name, bytes, read, ..
    } in samples()
    {
        for length in 0..bytes.len() {
            let refused = read(&bytes[..length]).unwrap_err();
            let need = match length < PREFIX_BYTES {
                true => PREFIX_BYTES,
                false => bytes.len(),
            };
            let cut_off = CodecError::Length { have: length, need };
            assert_eq!(refused, cut_off, "{name} cut to {length}");
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
                4..6 => matches!(refused, CodecError::Version { .. }),
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

/// A message that no process of this project sends: any header and payload with a correct checksum.
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

fn forge_whole(kind: u16, header: &[u8], payload: &[u8]) -> Vec<u8> {
    let lengths = (header.len() as u32, payload.len() as u64);
    forge(PROTOCOL_VERSION, kind, lengths, header, payload)
}

#[test]
fn each_mismatch_has_its_own_error() {
    let header = [5u8];
    let read = |bytes: &[u8], hash| codec::decode::<WeightsVersion>(bytes, hash).map(|_| ());
    let good = forge_whole(Kind::WeightsVersion as u16, &header, &[]);
    let sent = codec::encode(SPEC, &WeightsVersion { version: 5 }, &[]);
    assert_eq!(good, sent.unwrap());
    assert_eq!(read(&good, Some(SPEC)), Ok(()));

    let own = Kind::WeightsVersion as u16;
    let newer = forge(PROTOCOL_VERSION + 1, own, (1, 0), &header, &[]);
    let version = CodecError::Version {
        theirs: PROTOCOL_VERSION + 1,
        ours: PROTOCOL_VERSION,
    };
    assert_eq!(read(&newer, Some(SPEC)), Err(version));
    for kind in [0, Kind::Leave as u16, 13, u16::MAX] {
        let other = forge(PROTOCOL_VERSION, kind, (1, 0), &header, &[]);
        let refused = CodecError::Kind {
            theirs: kind,
            ours: Kind::WeightsVersion as u16,
        };
        assert_eq!(read(&other, Some(SPEC)), Err(refused));
    }
    let (theirs, ours) = (SPEC, SPEC + 1);
    let other_run = CodecError::RunSpec { theirs, ours };
    assert_eq!(read(&good, Some(ours)), Err(other_run));
    assert_eq!(read(&good, None), Ok(()), "where any run is welcome");
    let longer = forge_whole(Kind::WeightsVersion as u16, &[5, 0], &[]);
    assert!(
        matches!(read(&longer, Some(SPEC)), Err(CodecError::Header(_))),
        "a byte after the header's end"
    );
}

#[test]
fn huge_lengths_are_refused_without_taking_memory() {
    let read = |lengths| {
        let kind = Kind::WeightsVersion as u16;
        let bytes = forge(PROTOCOL_VERSION, kind, lengths, &[5], &[]);
        codec::decode::<WeightsVersion>(&bytes, Some(SPEC)).unwrap_err()
    };
    let too_large = |have, max| CodecError::TooLarge { have, max };
    let header = HEADER_BYTES_MAX + 1;
    let cut_off = CodecError::Length {
        have: PREFIX_BYTES + 1,
        need: PREFIX_BYTES + 1 + PAYLOAD_BYTES_MAX,
    };
    let max = u32::MAX as usize;
    for (lengths, expected) in [
        ((header as u32, 0), too_large(header, HEADER_BYTES_MAX)),
        ((u32::MAX, u64::MAX), too_large(max, HEADER_BYTES_MAX)),
        ((1, u64::MAX), too_large(usize::MAX, PAYLOAD_BYTES_MAX)),
        ((1, PAYLOAD_BYTES_MAX as u64), cut_off),
    ] {
        assert_eq!(read(lengths), expected);
    }
    // The header claims more elements than any header has room for.
    let header = [&[1u8, 1, 253][..], &u64::MAX.to_le_bytes()].concat();
    let bytes = forge_whole(Kind::Affinity as u16, &header, &[]);
    let refused = codec::decode::<AffinityUpdate>(&bytes, Some(SPEC)).unwrap_err();
    let first = "UnexpectedEnd { additional: 4 }";
    assert_eq!(refused, CodecError::Header(first.into()));
    // The sender observes the limit too.
    let run_info = RunInfo {
        config_toml: "x".repeat(HEADER_BYTES_MAX),
        ..RunInfo::default()
    };
    let refused = codec::encode_head(SPEC, &run_info, &[]).unwrap_err();
    let max = HEADER_BYTES_MAX;
    let is_too_large = matches!(refused, CodecError::TooLarge { max: m, .. } if m == max);
    assert!(is_too_large, "{refused}");
}

#[test]
fn counts_that_do_not_fit_their_payload_are_refused() {
    let chunk = chunk();
    let header = chunk.header;
    let payload = chunk.payload();
    let read = |header: ChunkHeader| read_chunk(&codec::encode(SPEC, &header, payload).unwrap());
    assert_eq!(read(header), Ok(()));
    let most = u32::MAX;
    let chunks: [fn(&mut ChunkHeader); 5] = [
        |it| it.streams = 3,
        |it| it.steps = 0,
        |it| it.frame_bytes = 4,
        |it| (it.streams, it.steps, it.frame_bytes) = (u32::MAX, u32::MAX, u32::MAX),
        |it| (it.streams, it.steps, it.frame_bytes) = (1 << 31, 1 << 31, 4),
    ];
    for change in chunks {
        let mut wrong = header;
        change(&mut wrong);
        let read = read(wrong);
        assert!(matches!(read, Err(CodecError::Header(_))), "{wrong:?}");
    }
    let header = batch().header;
    let (_, payload) = batch().into_payload();
    let most_of_all = BatchHeader {
        rows: most,
        positives: most,
        state_bytes: most,
        states_k: most,
        states_n: most,
        ..header
    };
    let none = BatchHeader {
        rows: 0,
        states_k: 0,
        states_n: 0,
        ..header
    };
    let mut all = vec![(none, Buffer::zeroed(0)), (most_of_all, payload.clone())];
    let batches: [fn(&mut BatchHeader); 6] = [
        |it| it.rows = 0,
        |it| it.rows = 4,
        |it| it.states_n = 4,
        |it| it.positives = 0,
        // The same length, but other counts of states than its rows have.
        |it| (it.states_k, it.states_n) = (1, 2),
        |it| it.states_k = u32::MAX,
    ];
    for change in batches {
        let mut wrong = header;
        change(&mut wrong);
        all.push((wrong, payload.clone()));
    }
    for (wrong, payload) in all {
        assert!(Batch::from_payload(wrong, payload).is_err(), "{wrong:?}");
    }
}

#[test]
fn what_no_process_says_is_refused() {
    let episodes = EpisodesReply {
        ended: 8,
        ..messages().remove(0)
    };
    let upload = WeightsUpload {
        learner: 5,
        weights: WeightsHeader::new(1, 1, b"these"),
    };
    let long = "x".repeat(401);
    let report = |doing: &str, since_s, text: &str, age_s| Report {
        who: Participant::Learner(1),
        doing: doing.into(),
        since_s,
        last_warning: Some(Warning {
            text: text.into(),
            age_s,
        }),
        finished: None,
    };
    let good = report("plays", 1.0, "lost", 2.0);
    let recovering = |since_s| Recovering {
        progress: RecoveryProgress {
            since_s,
            ..RecoveryProgress::default()
        },
        ..Recovering::default()
    };
    let mut fewer: PriorityUpdate = messages().remove(0);
    fewer.parts[0].priorities.pop();
    let mut refused = vec![
        (refusal(&episodes, &[]), "2 episodes after 7, but only 8"),
        (refusal(&upload, b"those"), "not the one announced"),
        (refusal(&good, &[1]), "1 bytes of payload follow"),
        (refusal(&recovering(1.0), &[1]), "1 bytes of payload follow"),
        (refusal(&fewer, &[]), "1 priorities of 2"),
    ];
    let chunk_with = |at: usize, bytes: [u8; 4]| {
        let mut payload = chunk().payload().to_vec();
        payload[at..at + 4].copy_from_slice(&bytes);
        let bytes = codec::encode(SPEC, &chunk().header, &payload).unwrap();
        read_chunk(&bytes).unwrap_err().to_string()
    };
    // The ends of six rows begin at byte 36, their rewards at 42.
    refused.push((chunk_with(38, [0, 0, 0, 4]), "unknown end 4"));
    for reward in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        refused.push((chunk_with(42 + 4, reward.to_le_bytes()), "row 1"));
    }
    for report in [report(&long, 1.0, "", 0.0), report("", 1.0, &long, 0.0)] {
        refused.push((refusal(&report, &[]), "more than 80 bytes"));
    }
    for time in [f64::NAN, f64::INFINITY, -1.0] {
        for report in [report("", time, "", 0.0), report("", 0.0, "", time)] {
            refused.push((refusal(&report, &[]), "which are not possible times"));
        }
        refused.push((refusal(&recovering(time), &[]), "the recovery began"));
    }
    for priority in [-1.0, -1e-30, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut update: PriorityUpdate = messages().remove(0);
        update.parts[0].priorities[1] = priority;
        refused.push((refusal(&update, &[]), "not a number of at least 0"));
    }
    for chance in [0.0, -0.5, 1.5, f32::NAN, f32::INFINITY] {
        let mut batch = prioritised_batch();
        batch.set_draws(&[(1, 0.5), (2, chance), (3, 0.5)]);
        let (header, payload) = batch.into_payload();
        let said = refusal(&BatchReply::Batch(header), &payload);
        refused.push((said, "which is not above 0 and at most 1"));
    }
    for (said, words) in refused {
        assert!(said.contains(words), "{said}");
    }
}

/// Texts that are cut before sending, and replies with the most episodes.
#[test]
fn the_longest_messages_can_be_sent() {
    let long = "x".repeat(401);
    let warning = Some(Warning::new(&long, 0.0));
    Sample::new(&Report::new(Participant::Learner(1), &long, 0.0, warning));
    let most = EndedEpisode {
        frames: u64::MAX,
        actor: u32::MAX,
        env: u32::MAX,
        totals: Some(Totals {
            episode_return: f64::MAX,
            steps: u64::MAX,
        }),
    };
    Sample::new(&EpisodesReply {
        ended: u64::MAX,
        before: u64::MAX - EPISODES_MAX as u64,
        episodes: vec![most; EPISODES_MAX],
    });
}
