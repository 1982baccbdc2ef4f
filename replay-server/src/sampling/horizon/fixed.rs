//! The fixed rule: always the same k, where the episode is long enough.
//! It draws nothing.

/// k, or `steps_left` if fewer. Both at least 1.
pub const fn draw_k(k: u32, steps_left: u32) -> u32 {
    if k < steps_left { k } else { steps_left }
}

#[cfg(test)]
mod tests {
    #[test]
    fn k_or_the_steps_left() {
        for (k, steps_left, expected) in [(1, 1, 1), (5, 9, 5), (5, 5, 5), (5, 4, 4), (5, 1, 1)] {
            assert_eq!(
                super::draw_k(k, steps_left),
                expected,
                "k {k}, {steps_left} left"
            );
        }
    }
}
