//! Batches of all kinds: drawn by priority, made of stacks of frames, merged from parts; and impossible ones.

use driml_protocol::{
    Batch, BatchHeader, BatchReply, Buffer, Origin, PriorityPart, RowScalars, StackedFrames, codec,
};

use crate::samples::{
    ORIGIN, STACKED, STACKS, batch, batch_from, encoded, prioritised_batch, receive_batch, refusal,
    rows, stacked_batch, used_memory,
};

/// A batch of a uniform run has 12 bytes less per row, and no origin.
#[test]
fn rows_drawn_by_priority_say_which_they_are_and_how_likely_they_were() {
    let (plain, prioritised) = (batch(), prioritised_batch());
    let more = prioritised.header.payload_bytes() - plain.header.payload_bytes();
    assert_eq!((more, plain.probabilities()), (3 * 12, None));
    let (_, payload) = prioritised.clone().into_payload();
    let mut columns = [1u64 << 40, 7, u64::MAX].map(u64::to_le_bytes).concat();
    columns.extend([0.5f32, 1.0, 1e-30].map(f32::to_le_bytes).concat());
    assert!(payload.ends_with(&columns), "transitions, then chances");
    let sent = [encoded(plain.clone()), encoded(prioritised.clone())].map(|bytes| bytes.len());
    // The origin takes one byte for the shard and nine for the incarnation.
    assert_eq!(sent[1] - sent[0], 3 * 12 + 10);
    assert_eq!(plain.priority_update(5, 9, &[0.0; 3]), None);
    assert_eq!(receive_batch(&encoded(plain.clone())).unwrap(), plain);

    let bytes = encoded(prioritised.clone());
    let mut back = receive_batch(&bytes).unwrap();
    assert_eq!(back, prioritised);
    assert_eq!(back.probabilities().unwrap(), [0.5, 1.0, 1e-30]);
    assert_eq!(back.actions(), [0, 1, 2]);
    assert_eq!(back.ks(), [2, 0, 255]);
    let update = back.priority_update(5, 9, &[1.0, 2.0, 3.0]).unwrap();
    let part = |origin, transitions: &[u64], priorities: &[f32]| PriorityPart {
        origin,
        transitions: transitions.to_vec(),
        priorities: priorities.to_vec(),
    };
    let own = [1 << 40, 7, u64::MAX];
    assert_eq!((update.learner, update.number, update.rows()), (5, 9, 3));
    assert_eq!(update.parts, [part(ORIGIN, &own, &[1.0, 2.0, 3.0])]);

    // Parts of two shards, of which the second is chosen with a probability of 3/4.
    let other = Origin {
        shard: 0,
        incarnation: 3,
    };
    let mut second = batch_from(Some(other));
    second.set_draws(&[(10, 0.5), (11, 0.25), (12, 0.25)]);
    back.scale_probabilities(0.25);
    second.scale_probabilities(0.75);
    let merged = Batch::merge(&[back, second], Buffer::zeroed).unwrap();
    let scaled = [0.125, 0.25, 2.5e-31, 0.375, 0.1875, 0.1875];
    assert_eq!(merged.probabilities().unwrap(), scaled);
    let found = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
    let update = merged.priority_update(5, 9, &found).unwrap();
    let expected = [
        part(ORIGIN, &own, &found[..3]),
        part(other, &[10, 11, 12], &found[3..]),
    ];
    assert_eq!(update.parts, expected);
    assert_eq!(Batch::merge(&[merged, plain], Buffer::zeroed), None);
}

/// A run with stacks sends each frame once.
#[test]
fn stacks_come_back_as_whole_states() {
    for origin in [None, Some(ORIGIN)] {
        let sent = stacked_batch(origin);
        let more = sent.header.payload_bytes() - batch_from(origin).header.payload_bytes();
        // Five frames of two bytes. Each of six states has two frame numbers of four bytes in place of four bytes of pixels.
        assert_eq!(more, 5 * 2 + 6 * 8 - 6 * 4);
        let bytes = encoded(sent.clone());
        let back = receive_batch(&bytes).unwrap();
        assert_eq!(back, sent);
        assert_eq!(back.probabilities().is_some(), origin.is_some());
        // The oldest channels of a pixel come first.
        let states_t = [50, 50, 50, 50, 50, 51, 50, 51, 51, 52, 51, 52];
        assert_eq!(back.states_t()[..], states_t);
        assert_eq!(back.states_k()[..], [50, 51, 50, 51, 53, 54, 53, 54]);
        assert_eq!(back.states_n()[..], [54, 54, 54, 54]);
        assert_eq!(back.ks(), [2, 0, 255]);
    }
}

/// After a merge, each part's states still consist of the part's own frames.
#[test]
fn parts_of_stacks_are_merged() {
    let first = stacked_batch(None);
    let mut second = stacked_batch(None);
    for frame in 0..5 {
        second.frame_mut(frame).fill(150 + frame as u8);
    }
    let parts = [first, second, stacked_batch(None)];
    let merged = Batch::merge(&parts, used_memory).unwrap();
    assert_eq!(merged.header.stacked.unwrap().frames, 15);
    let planes = |batch: &Batch| {
        [batch.states_t(), batch.states_k(), batch.states_n()].map(|plane| plane.to_vec())
    };
    let parts_planes = parts.each_ref().map(planes);
    for (at, plane) in planes(&merged).into_iter().enumerate() {
        let of_parts = parts_planes.each_ref().map(|it| &it[at][..]);
        assert_eq!(plane, of_parts.concat());
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
        let parts = [part.clone(), other_part];
        assert_eq!(Batch::merge(&parts, Buffer::zeroed), None);
    }
}

#[test]
fn stacks_that_cannot_be_are_refused() {
    let said = |header, payload: Buffer| refusal(&BatchReply::Batch(header), &payload);
    for number in [5, 6, u32::MAX] {
        let mut wrong = stacked_batch(None);
        let [stacks @ .., _] = STACKS;
        let stacks = [&stacks[..], &[number]].concat();
        wrong.set_stacks(&stacks);
        let (header, payload) = wrong.into_payload();
        let (said, why) = (said(header, payload), format!("a state has frame {number}"));
        assert!(
            said.contains(&format!("{why}, but the batch has 5")),
            "{said}"
        );
    }
    let (header, payload) = stacked_batch(None).into_payload();
    let changes: [fn(&mut StackedFrames); 10] = [
        |it| it.frames = 0,
        |it| it.frames = 4,
        |it| it.frames = u32::MAX,
        |it| it.frame_stack = 0,
        |it| it.frame_stack = 1,
        |it| it.frame_stack = 17,
        |it| it.frame_stack = u32::MAX,
        |it| it.frame_channels = 0,
        |it| it.frame_channels = 3,
        |it| it.frame_channels = u32::MAX,
    ];
    for change in changes {
        let mut wrong = STACKED;
        change(&mut wrong);
        let header = BatchHeader {
            stacked: Some(wrong),
            ..header
        };
        let said = said(header, payload.clone());
        assert!(said.contains("do not fill"), "{wrong:?}: {said}");
    }
    // More frames than all stacks can contain.
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

/// A message of some MB, whose states would fill the memory once assembled.
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
        let (header, payload) = Batch::from_rows(header, &rows, Buffer::zeroed).into_payload();
        let frame_bytes = state_bytes / STACKED.frame_stack as usize;
        let without_frames = Buffer::zeroed(payload.len() - frame_bytes);
        let empty_states = BatchHeader {
            state_bytes: 0,
            ..header
        };
        assert!(Batch::from_payload(empty_states, without_frames).is_err());
        let said =
            Batch::from_payload(header, payload).map_or_else(|e| e.to_string(), |_| String::new());
        let why = "states would fill more than";
        assert_eq!(said.contains(why), is_refused, "{said}");
        assert_eq!(said.is_empty(), !is_refused, "{said}");
    }
}

#[test]
fn parts_are_merged_row_by_row() {
    let header = |versions| BatchHeader {
        positives: 3,
        state_bytes: 3,
        weights_versions: versions,
        ..BatchHeader::default()
    };
    // Makes rows of `values`: their positives cycle through 3, 2, 1 and 0, and even values bootstrap.
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
        let mut batch = Batch::from_rows(header, &rows, Buffer::zeroed);
        // s_t is the value; s_{t+n} is 20 more, s_{t+k} of the positives 40, 60 and 80.
        let k = (0..3).flat_map(|p| {
            let with_positive = rows.iter().filter(move |row| row.positives > p);
            with_positive.map(move |row| row.action + 40 + 20 * p as u8)
        });
        let n = rows.iter().filter(|row| row.bootstraps());
        let n = n.map(|row| row.action + 20);
        for (number, byte) in values.chain(k).chain(n).enumerate() {
            batch.frame_mut(number).fill(byte);
        }
        batch
    };
    let parts = [
        part(header((7, 3)), 0..4),
        part(header((9, 5)), 4..6),
        part(header((8, 4)), 6..8),
    ];
    let merged = Batch::merge(&parts, used_memory).unwrap();
    let whole = merged.header;
    let expected = part(whole, 0..8);
    assert_eq!(whole.weights_versions, (9, 3));
    assert_eq!((whole.rows, whole.states_k, whole.states_n), (8, 12, 4));
    assert_eq!(merged, expected);
    let states_n: Vec<u8> = [20, 22, 24, 26].map(|byte| [byte; 3]).concat();
    assert_eq!(merged.states_n()[..], states_n);

    let other = BatchHeader {
        state_bytes: 4,
        ..header((1, 1))
    };
    let other = part(other, 0..1);
    let parts = [parts[0].clone(), other];
    assert_eq!(Batch::merge(&parts, Buffer::zeroed), None);
    assert_eq!(Batch::merge(&[], Buffer::zeroed), None);
}
