//! The uniform rule (DRIML-randk): every k that the episode allows is equally likely.
//! It does not look at actions.

use rand::Rng;

/// Uniform on 1..=min(`k_max`, `steps_left`). Both at least 1.
pub fn draw_k(k_max: u32, steps_left: u32, rng: &mut impl Rng) -> u32 {
    rng.random_range(1..=k_max.min(steps_left))
}
