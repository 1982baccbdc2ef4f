//! What every world of many copies shares: a generator for each copy, and the check of a caller's step buffers.
//! It holds no game rules and no state.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::environment::StepEnd;
use crate::error::EnvError;

/// What a copy's generator is used for; each use has its own stream, so adding one leaves the others as they were.
#[derive(Clone, Copy)]
pub(crate) enum RngUse {
    /// The game's own chance moves.
    Game,
    /// The Ising model in Ms. PacMan's walls.
    Overlay,
}

/// The generator of copy `env` in a world seeded with `seed`: ChaCha8 keyed by the seed, one stream a copy and use.
pub(crate) fn copy_rng(seed: u64, env: usize, used_for: RngUse) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(2 * env as u64 + used_for as u64);
    rng
}

/// Rejects a world without copies.
pub(crate) fn check_num_envs(num_envs: usize) -> Result<(), EnvError> {
    if num_envs == 0 {
        return Err(EnvError::Config(
            "a world needs at least one copy, got num_envs = 0".into(),
        ));
    }
    Ok(())
}

/// Checks the arguments of `Environment::step`: `actions`, `rewards` and `ends` are [N], each action < `num_actions`.
pub(crate) fn check_step(
    num_envs: usize,
    num_actions: usize,
    actions: &[u8],
    rewards: &[f32],
    ends: &[StepEnd],
) -> Result<(), EnvError> {
    for (name, got) in [
        ("actions", actions.len()),
        ("rewards", rewards.len()),
        ("ends", ends.len()),
    ] {
        if got != num_envs {
            return Err(EnvError::BufferLength {
                name,
                got,
                num_envs,
            });
        }
    }
    match actions
        .iter()
        .position(|&action| usize::from(action) >= num_actions)
    {
        Some(env) => Err(EnvError::ActionOutOfRange {
            env,
            action: actions[env],
            num_actions,
        }),
        None => Ok(()),
    }
}
