//! Whether a chunk can be one of this run at all, by its sizes and counts alone.
//! Whether it is the next of its actor, and whether it may come in now, is for `ledger` and `rate_limiter`.

use driml_protocol::{Chunk, RunSpec};

use crate::config::{Config, compressed_bytes_least};

/// Transitions that one life of an actor can have produced, by its own account: three years at three million a second.
pub(crate) const TRANSITIONS_MAX: u64 = 1 << 48;

/// Why a chunk is none of this run, whose shards hold `capacity` transitions each; none if it can be one.
pub(crate) fn unfit(
    spec: &RunSpec,
    config: &Config,
    capacity: u64,
    chunk: &Chunk,
) -> Option<String> {
    let header = &chunk.header;
    let frame_bytes = spec.frame_bytes();
    if header.frame_bytes as usize != frame_bytes {
        return Some(format!(
            "frames of {} bytes; this run has {frame_bytes}",
            header.frame_bytes
        ));
    }
    let transitions = header.transitions() as u64;
    if transitions == 0 || transitions > capacity {
        return Some(format!(
            "{transitions} transitions in one chunk; the replay holds {capacity}: use 1 to that many"
        ));
    }
    let bytes = compressed_bytes_least(transitions, frame_bytes);
    if let Some(max) = config.compressed_bytes_max.filter(|&max| max < bytes) {
        return Some(format!(
            "a chunk that may take {bytes} bytes; compressed_bytes_max is {max}"
        ));
    }
    let count = header.first_transition.checked_add(transitions);
    if header.sequence == u64::MAX || count.is_none_or(|count| count > TRANSITIONS_MAX) {
        return Some(format!(
            "counts that no run reaches: chunk {}, transition {}",
            header.sequence, header.first_transition
        ));
    }
    let reward_max = f32::MAX / spec.n_step as f32;
    if let Some(row) =
        (0..chunk.header.transitions()).find(|&row| chunk.reward(row).abs() > reward_max)
    {
        return Some(format!(
            "a reward of {:e}; returns of {} steps are float32, so a reward is at most {reward_max:e}: scale the world's rewards",
            chunk.reward(row),
            spec.n_step
        ));
    }
    let action = chunk
        .actions()
        .iter()
        .find(|&&a| u32::from(a) >= spec.num_actions)?;
    Some(format!(
        "action {action}; this run has {}",
        spec.num_actions
    ))
}
