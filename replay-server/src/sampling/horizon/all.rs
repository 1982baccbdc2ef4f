//! Every k at once (CPC): one positive for each of 1, 2, .. that the episode allows.
//! It draws nothing.

/// The furthest k: `k_max`, or `steps_left` if fewer. Both at least 1.
pub const fn furthest(k_max: u32, steps_left: u32) -> u32 {
    if k_max < steps_left {
        k_max
    } else {
        steps_left
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn k_max_or_the_steps_left() {
        for (k_max, steps_left, expected) in [(5, 9, 5), (5, 5, 5), (5, 2, 2), (1, 7, 1)] {
            assert_eq!(super::furthest(k_max, steps_left), expected);
        }
    }
}
