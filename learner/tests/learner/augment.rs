//! Augmentation: its distribution, its bounds, and that it changes no byte at strength 0.
//! `driml experiment stability` checks what a crop, factors and a turn make of each byte.

use driml_learner::{AugmentSettings, Augmenter};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::synthetic::pool;

pub(crate) const NOTHING: AugmentSettings = AugmentSettings {
    crop_side: 1.0,
    brightness: 0.0,
    contrast: 0.0,
    saturation: 0.0,
    hue: 0.0,
};
pub(crate) const PAPER: AugmentSettings = AugmentSettings {
    crop_side: 0.8,
    brightness: 0.4,
    contrast: 0.4,
    saturation: 0.4,
    hue: 0.4,
};

fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

fn noise(bytes: usize, seed: u64) -> Vec<u8> {
    let mut rng = rng(seed);
    (0..bytes).map(|_| rng.random()).collect()
}

/// Chi-square of counts against the uniform distribution.
fn chi_square(counts: &[u32]) -> f64 {
    let expected = f64::from(counts.iter().sum::<u32>()) / counts.len() as f64;
    let square = |&count: &u32| (f64::from(count) - expected).powi(2) / expected;
    counts.iter().map(square).sum()
}

#[test]
fn at_no_strength_every_byte_stays() {
    for (size, frame_channels) in [
        ((64, 64, 3), 3),
        ((84, 84, 12), 3),
        ((12, 12, 1), 1),
        ((5, 7, 10), 5),
        ((1, 1, 3), 3),
    ] {
        let states = noise(9 * size.0 * size.1 * size.2, 2);
        let mut augmented = Vec::new();
        let augment = Augmenter::new(NOTHING, size, frame_channels);
        augment.apply(&states, &mut augmented, &mut rng(3));
        assert!(augmented == states, "{size:?}");
    }
}

#[test]
fn crops_are_of_a_share_of_each_side() {
    for (size, crop_side, wanted) in [
        ((64, 64, 3), 0.8, (51, 51)),
        ((84, 84, 12), 0.8, (67, 67)),
        ((104, 80, 3), 0.8, (83, 64)),
        ((12, 12, 1), 0.5, (6, 6)),
        ((9, 5, 4), 0.6, (5, 3)),
        ((7, 8, 5), 0.01, (1, 1)),
    ] {
        let settings = AugmentSettings {
            crop_side,
            ..NOTHING
        };
        assert_eq!(Augmenter::new(settings, size, 1).crop(), wanted);
    }
}

/// The crop's position, the factors and the turn: within their bounds, equally frequent in 14 bins, and independent of one another.
#[test]
fn every_draw_is_uniform_within_its_strength() {
    let settings = AugmentSettings {
        brightness: 0.1,
        contrast: 0.2,
        saturation: 0.3,
        hue: 0.4,
        ..PAPER
    };
    let augment = Augmenter::new(settings, (64, 64, 3), 3);
    assert_eq!(augment.crop(), (51, 51));
    let (mut rng, draws) = (rng(7), 28_000);
    let (mut bins, mut places) = ([[0u32; 14]; 6], vec![0u32; 14 * 14]);
    let mut products = [0.0; 5];
    for _ in 0..draws {
        let view = augment.draw(&mut rng);
        places[view.top * 14 + view.left] += 1;
        let place = |at: usize| (2 * at + 1) as f64 / 14.0 - 1.0;
        // Each relative to its range, from -1 to 1.
        let shares = [
            place(view.top),
            place(view.left),
            (view.brightness - 1.0) / 0.1,
            (view.contrast - 1.0) / 0.2,
            (view.saturation - 1.0) / 0.3,
            view.hue / 0.4,
        ];
        for (bins, share) in bins.iter_mut().zip(shares) {
            assert!((-1.0 - 1e-9..=1.0 + 1e-9).contains(&share), "{view:?}");
            bins[(((share + 1.0) * 7.0) as usize).min(13)] += 1;
        }
        for (product, pair) in products.iter_mut().zip(shares.windows(2)) {
            *product += pair[0] * pair[1];
        }
    }
    // 99.9% quantiles for 13 and 195 degrees of freedom.
    assert!(bins.iter().all(|it| chi_square(it) < 34.5), "{bins:?}");
    assert!(chi_square(&places) < 262.0, "{}", chi_square(&places));
    for product in products {
        // Standard deviation of a product of two such shares: 1/3.
        assert!((product / f64::from(draws)).abs() < 4.0 / 3.0 / f64::from(draws).sqrt());
    }
}

#[test]
fn the_generator_alone_decides_and_rows_differ() {
    let augment = Augmenter::new(PAPER, (16, 16, 3), 3);
    let state = noise(16 * 16 * 3, 9);
    let states = state.repeat(33);
    let applied = || {
        let mut augmented = vec![7; 3];
        augment.apply(&states, &mut augmented, &mut rng(1));
        augmented
    };
    let first = applied();
    for threads in [1, 2, 5] {
        assert!(pool(threads).install(applied) == first);
    }
    let mut different: Vec<_> = first.chunks_exact(state.len()).collect();
    different.sort_unstable();
    different.dedup();
    assert_eq!(different.len(), 33, "each row has its own draw");
    // Each call continues the generator, and reused memory leaves no trace.
    let (mut rng, mut augmented) = (rng(1), vec![1; 7]);
    for rows in [20, 13] {
        augment.apply(&states[..rows * state.len()], &mut augmented, &mut rng);
        assert_eq!(augmented.len(), rows * state.len());
    }
    assert!(augmented == first[20 * state.len()..]);
}
