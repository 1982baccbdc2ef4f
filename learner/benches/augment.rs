//! Measures the augmentation of a batch's states: 256 frames of 64x64x3, cropped, jittered, both and neither.
//! `driml bench learner` measures updates.

#![allow(missing_docs, reason = "criterion's macros make public functions")]

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use driml_learner::{AugmentSettings, Augmenter};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ROWS: usize = 256;

fn augmentation(criterion: &mut Criterion) {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let mut states = vec![0; ROWS * 64 * 64 * 3];
    rng.fill_bytes(&mut states);
    let mut augmented = Vec::new();
    let mut group = criterion.benchmark_group("augment");
    group.throughput(Throughput::Elements(ROWS as u64));
    for (name, crop_side, jitter) in [
        ("crop and jitter", 0.8, 0.4),
        ("crop", 0.8, 0.0),
        ("jitter", 1.0, 0.4),
        ("nothing", 1.0, 0.0),
    ] {
        let settings = AugmentSettings {
            crop_side,
            brightness: jitter,
            contrast: jitter,
            saturation: jitter,
            hue: jitter,
        };
        let augment = Augmenter::new(settings, (64, 64, 3), 3);
        group.bench_function(name, |bencher| {
            bencher.iter(|| augment.apply(black_box(&states), &mut augmented, &mut rng));
        });
    }
    group.finish();
}

criterion_group!(benches, augmentation);
criterion_main!(benches);
