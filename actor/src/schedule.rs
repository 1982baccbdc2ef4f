//! How the probability of a random action falls over the run.
//! It does not count frames: the caller says how many the run has.

use crate::Config;

/// Epsilon after `frames` frames of the run: linear from `epsilon_start` to `epsilon_end`, then constant.
///
/// Source: table of parameters in the paper's appendix.
pub fn epsilon(config: &Config, frames: u64) -> f64 {
    if frames >= config.epsilon_decay_frames {
        return config.epsilon_end;
    }
    let progress = frames as f64 / config.epsilon_decay_frames as f64;
    config.epsilon_start + (config.epsilon_end - config.epsilon_start) * progress
}
