//! The settings that benches take from the presets, so that they measure what a run does.
//! It holds no number of its own.

use driml_machine::{error::Usage, resources::Machine};
use driml_settings::{
    config::RunConfig,
    flags::{self, RunFlags},
};

/// The world where it does not matter which.
pub(super) const WORLD: &str = "procgen:bigfish";

/// A run's settings: world, agent and preset, and single settings over them.
///
/// # Errors
/// Settings that cannot work.
pub(super) fn of_run(
    world: &str,
    agent: &str,
    preset: &str,
    sets: &[&str],
) -> Result<RunConfig, Usage> {
    let flags = RunFlags {
        env: Some(world.into()),
        agent: Some(agent.into()),
        preset: Some(preset.into()),
        config: None,
        actors: None,
        envs: None,
        replay_shards: None,
        frames: None,
        seed: None,
        study: None,
        sets: sets.iter().map(|&set| set.to_owned()).collect(),
    };
    Ok(flags::resolve(&flags, &Machine::this())?.0)
}
