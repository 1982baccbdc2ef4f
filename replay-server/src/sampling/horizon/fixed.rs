//! The fixed rule: always the same k, where the episode is long enough.

/// k, or `steps_left` if fewer. Both at least 1.
pub const fn draw_k(k: u32, steps_left: u32) -> u32 {
    if k < steps_left { k } else { steps_left }
}
