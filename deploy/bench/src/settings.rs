//! The settings that benches take from the presets, so that they measure what a run does.
//! The settings of [`REPLAY_SETS`] make a replay that is soon full.

use driml_machine::{error::Usage, resources::Machine};
use driml_settings::{config::RunConfig, flags};

pub(super) const WORLD: &str = "procgen:bigfish";

/// Settings that keep the limiter from affecting the figures, and a replay that is soon full. `bench peers` gives Reverb a table of the
/// same size.
pub(super) const REPLAY_SETS: [&str; 5] = [
    "replay.capacity_transitions=20000",
    "replay.replay_ratio=1e9",
    "replay.slack_transitions=1000000000000",
    "replay.transitions_max=1000000000000",
    "replay.warmup_transitions=1000",
];
/// The capacity in [`REPLAY_SETS`], in transitions.
pub(super) const CAPACITY: u64 = 20_000;
/// The agent of most figures, which draws k along the stored actions.
pub(super) const AGENT: &str = "driml-ada";

/// Returns the settings of a run: world, agent and preset, overridden by single settings.
pub(super) fn run_config(
    world: &str,
    agent: &str,
    preset: &str,
    sets: &[&str],
) -> Result<RunConfig, Usage> {
    flags::resolve_names(preset, world, agent, sets, &Machine::detect())
}

/// Returns the name and the settings of a case "name|agent|preset|setting|..", with whole frames.
pub(super) fn case(line: &str) -> anyhow::Result<(&str, RunConfig)> {
    let words: Vec<_> = line.split('|').collect();
    let config = run_config(WORLD, words[1], words[2], &words[3..])?;
    Ok((words[0], config.with_whole_frames()?))
}
