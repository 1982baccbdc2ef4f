//! Every message survives encoding and decoding, and each kind has a sample.
//! No session is opened; `damaged` tests rejected messages.
#![allow(clippy::unwrap_used)]

mod batches;
mod damaged;
mod run_hash;
mod samples;

use std::{fs, io::Read, path::Path};

use driml_protocol::{BufferPool, Chunk, End, Kind, NO_ACTION, WeightsUpload, codec};

use crate::samples::{SPEC, batch, chunk, encoded_chunk, samples, weights};

#[test]
fn chunk_batch_and_weights_hold_what_was_written() {
    let back = chunk();
    assert_eq!((back.actions()[4], back.reward(4)), (4, -2.0));
    assert_eq!(back.end(3), End::Terminal);
    assert_eq!(back.frames()[5 * 5..], [6; 5]);

    let back = batch();
    assert_eq!(back.states_t()[..], [[10; 4], [11; 4], [12; 4]].concat());
    assert_eq!(back.states_n()[..], [22; 4], "no state that a row lacks");
    assert_eq!(back.states_k()[..], [[30; 4], [32; 4]].concat());
    assert_eq!(back.actions(), [0, 1, 2]);
    assert_eq!(back.next_actions(), [4, NO_ACTION, 6]);
    assert_eq!(back.positive_valid(), [1, 0, 1]);
    assert_eq!(back.ks(), [2, 0, 255]);
    assert_eq!(back.n_step_returns(), [0.5, 1.5, 2.5]);
    assert_eq!(back.bootstrap_discounts(), [0.0, 0.0, 0.5]);

    let (WeightsUpload { learner, weights }, payload) = weights();
    assert_eq!((learner, weights.version, weights.updates), (5, 4, 312));
    assert_eq!((payload.len(), weights.sha256_hex().len()), (40, 64));
}

/// However a message is cut into pieces on its way, the receiver gets the message that was sent, even in memory with other content.
#[test]
fn pieces_are_received_as_the_whole_is() {
    let pool = BufferPool::new(1);
    let receive = |first: &[u8], second: &[u8], len| {
        let pieces = first.chain(&b""[..]).chain(second);
        let (header, payload) = codec::decode_from(pieces, len, &pool, Some(SPEC))?;
        Chunk::from_payload(header, payload)
    };
    let bytes = encoded_chunk();
    for at in 0..=bytes.len() {
        let (first, second) = bytes.split_at(at);
        pool.take_private(64).fill(0xAB);
        let back = receive(first, second, bytes.len()).unwrap();
        assert_eq!(back, chunk(), "cut at {at}");
        // The last piece is missing, or the length is not the sum of the pieces.
        if at < bytes.len() {
            assert!(receive(first, &[], at).is_err());
            assert!(receive(first, &[], bytes.len()).is_err());
        }
    }
    for flipped in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[flipped] ^= 1;
        let (first, second) = damaged.split_at(flipped / 2);
        let refused = receive(first, second, bytes.len()).unwrap_err();
        assert_eq!(refused, Chunk::decode(&damaged, SPEC).unwrap_err());
    }
}

#[test]
fn every_kind_has_a_sample_that_is_read() {
    let samples = samples();
    for &kind in Kind::ALL {
        let has_it = samples.iter().any(|sample| sample.kind == kind as u16);
        assert!(has_it, "{kind:?} has no sample");
    }
    for sample in &samples {
        assert_eq!((sample.read)(&sample.bytes), Ok(()), "{}", sample.name);
    }
}

/// Fuzzers of the decoders start with today's messages: `UPDATE_CORPUS=1` writes them.
#[test]
fn the_fuzzers_seeds_are_the_samples() {
    let folder =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/decoders/fuzz/corpus/messages");
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
