//! Batches whose states are stacks of frames that travel once: a learner learns from them what it learns from whole states.

use driml_learner::{AuxiliaryKind, Learner, LearnerConfig};
use driml_model::Compute;
use driml_protocol::{Batch, BatchHeader, Buffer, RowScalars, StackedFrames};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    augment::PAPER,
    served::config,
    synthetic::{CPC, DIM},
};

const ROWS: usize = 6;
const STACK: usize = 2;
/// Fewer than the states have room for.
const FRAMES: usize = 11;

/// A run whose states are stacks of two frames of this size, of one channel.
fn stacked(auxiliary_loss: AuxiliaryKind, (height, width): (u32, u32)) -> LearnerConfig {
    let mut config = config(auxiliary_loss, None);
    let spec = &mut config.spec;
    (spec.frame_height, spec.frame_width) = (height, width);
    (spec.frame_channels, spec.frame_stack) = (1, STACK as u32);
    config
}

/// The same rows with the frames of their states once each, and with every state whole.
fn batches(config: &LearnerConfig, seed: u64) -> [Batch; 2] {
    let spec = &config.spec;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let frames: Vec<Vec<u8>> = (0..FRAMES)
        .map(|_| (0..spec.frame_bytes()).map(|_| rng.random()).collect())
        .collect();
    let row = |row: usize| RowScalars {
        action: (row % 4) as u8,
        next_action: 1,
        n_step_return: row as f32 * 0.3 - 1.0,
        bootstrap_discount: if row % 3 == 1 { 0.0 } else { 0.9 },
        positives: spec.horizon.positives().min(row) as u32,
        k_first: 1,
    };
    let rows: Vec<_> = (0..ROWS).map(row).collect();
    let header = BatchHeader {
        weights_versions: (1, 1),
        ..BatchHeader::of(spec, ROWS as u32)
    };
    let once = header.stacked.map(|stacked| StackedFrames {
        frames: FRAMES as u32,
        ..stacked
    });
    let [mut once, mut whole] = [once, None].map(|stacked| {
        let header = BatchHeader { stacked, ..header };
        Batch::of_rows(header, &rows, Buffer::zeroed)
    });
    let (mut states, mut whole_states) = (once.states_mut(), whole.states_mut());
    for (number, frame) in frames.iter().enumerate() {
        states.frame(number).copy_from_slice(frame);
    }
    for row in 0..ROWS {
        let numbers: Vec<usize> = states.of_row(row).collect();
        assert!(numbers.iter().copied().eq(whole_states.of_row(row)));
        for number in numbers {
            let stack: [usize; STACK] = std::array::from_fn(|_| rng.random_range(0..FRAMES));
            states.set_stack(number, &stack.map(|frame| frame as u32));
            let place = whole_states.frame(number);
            for (at, byte) in place.iter_mut().enumerate() {
                *byte = frames[stack[at % STACK]][at / STACK];
            }
        }
    }
    [once, whole]
}

/// Of plain frames, of frames that are enlarged, and of augmented ones: states, losses and weights are the same, to the last bit.
#[test]
fn frames_that_travel_once_change_no_bit() {
    for (auxiliary_loss, size, augment) in [
        (DIM, (20, 24), None),
        (CPC, (10, 8), None),
        (DIM, (10, 12), Some(PAPER)),
    ] {
        let mut config = stacked(auxiliary_loss, size);
        config.learner.augment = augment;
        let learner = || Learner::new(config.clone(), &Compute::CPU).unwrap();
        let [mut of_once, mut of_whole] = [learner(), learner()];
        for seed in 0..3 {
            let [once, whole] = batches(&config, seed);
            assert!(once.header.payload_bytes() < whole.header.payload_bytes());
            assert_eq!(once.states_t(), whole.states_t());
            assert_eq!(once.states_k(), whole.states_k());
            assert_eq!(once.states_n(), whole.states_n());
            let reports = [of_once.update(&once), of_whole.update(&whole)];
            let [a, b] = reports.map(|report| report.unwrap().total.to_bits());
            assert_eq!(a, b);
        }
        let weights = [of_once, of_whole].map(|mut it| it.next_weights().unwrap().safetensors);
        assert_eq!(weights[0], weights[1]);
    }
}
