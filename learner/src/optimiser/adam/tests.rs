//! Adam by itself: steps that overflow, and the moments of gradients that have become 0.
//! `driml experiment stability` compares steps and moments with float64, in long runs too.

use super::*;

const SETTINGS: AdamSettings = AdamSettings {
    lr: 1.0,
    beta1: 0.9,
    beta2: 0.999,
    eps: 1e-8,
};

#[test]
fn moments_of_a_gradient_that_is_gone_end_at_zero() {
    for size in [1e-30f32, 1e-3, 1.0, 1e15] {
        let (mut p, mut m, mut v) = (vec![1.0f32; 9], vec![0.0; 9], vec![0.0; 9]);
        // The last element's gradient stays.
        let mut g = vec![size; 9];
        let mut updates = 0;
        let mut run = |g: &[f32], count: u64| {
            for _ in 0..count {
                updates += 1;
                let coefficients = StepCoefficients::new(SETTINGS, updates, 1.0);
                assert!(coefficients.apply(&mut p, g, &mut m, &mut v));
            }
            (m.clone(), v.clone())
        };
        // Whether an f32 holds the square.
        let is_held = size > 1e-15;
        run(&g, 10);
        g[..8].fill(0.0);
        let (m, v) = run(&g, 2_000);
        assert_eq!(m[..8], [0.0; 8], "0.9^2000 of what it was");
        assert!((m[8] / size - 1.0).abs() < 1e-5);
        assert!(!is_held || v[0] > f32::MIN_POSITIVE);
        let (_, v) = run(&g, 250_000);
        assert_eq!(v[..8], [0.0; 8], "0.999^252000 of what it was");
        assert!(!is_held || (v[8] / size.powi(2) - 1.0).abs() < 1e-3);
    }
}

/// Whether a step is finite for this parameter and gradient, which are the last of `elements` elements.
fn is_step_finite(settings: AdamSettings, elements: usize, parameter: f32, gradient: f32) -> bool {
    let coefficients = StepCoefficients::new(settings, 1, 1.0);
    let (mut p, mut g) = (vec![0.5; elements], vec![0.1; elements]);
    (p[elements - 1], g[elements - 1]) = (parameter, gradient);
    let (mut m, mut v) = (vec![0.0; elements], vec![0.0; elements]);
    coefficients.apply(&mut p, &g, &mut m, &mut v)
}

#[test]
fn a_step_beyond_the_finite_numbers_is_noticed_wherever_it_is() {
    // The largest step size.
    let far = AdamSettings {
        lr: *LR_RANGE.end(),
        beta1: *BETA_RANGE.end(),
        ..SETTINGS
    };
    for (settings, parameter, gradient, is_finite) in [
        (SETTINGS, 3e38, 1.0, true),
        (far, 3e38, 1.0, true),
        (far, f32::MAX, -1.0, false),
        (SETTINGS, f32::NAN, 1.0, false),
        (SETTINGS, f32::NEG_INFINITY, 1.0, false),
        // The square of the gradient is not finite: the parameter would stand still for good.
        (SETTINGS, 0.0, 1e30, false),
    ] {
        for elements in [1, 2, 7, 16, 33] {
            let found = is_step_finite(settings, elements, parameter, gradient);
            let case = format!("{elements} elements, {parameter:e}, {gradient:e}");
            assert_eq!(found, is_finite, "{case}, {settings:?}");
        }
    }
}
