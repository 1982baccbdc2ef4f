//! Every k at once (CPC): one positive for each of 1, 2, .. that the episode allows.

/// The furthest k: `k_max`, or `steps_left` if fewer. Both at least 1.
pub const fn furthest(k_max: u32, steps_left: u32) -> u32 {
    if k_max < steps_left {
        k_max
    } else {
        steps_left
    }
}
