//! Every k at once (CPC): one positive for each offset that the episode allows.
//! It draws nothing.

/// The furthest k: `k_max`, or `steps_left` if fewer. Both at least 1.
pub const fn furthest(k_max: u32, steps_left: u32) -> u32 {
    if k_max < steps_left {
        k_max
    } else {
        steps_left
    }
}

/// k of positive `p`, counted from 0, in a row whose furthest is `furthest`: p + 1, or none beyond it.
pub fn k_of(p: usize, furthest: u32) -> Option<u32> {
    u32::try_from(p + 1).ok().filter(|&k| k <= furthest)
}

#[cfg(test)]
mod tests {
    #[test]
    fn offsets_run_from_one_to_the_end() {
        for (k_max, steps_left, expected) in [(5, 9, 5), (5, 5, 5), (5, 2, 2), (1, 7, 1)] {
            let furthest = super::furthest(k_max, steps_left);
            assert_eq!(furthest, expected, "k_max {k_max}, {steps_left} left");
            let ks: Vec<_> = (0..k_max as usize)
                .map(|p| super::k_of(p, furthest))
                .collect();
            for (p, k) in ks.iter().enumerate() {
                let there = p < expected as usize;
                assert_eq!(*k, there.then_some(p as u32 + 1));
            }
        }
    }
}
