//! How well a policy plays: whole episodes, undiscounted returns.
//! It stores and sends nothing.

use driml_envs::{Environment, StepEnd};
use rand_chacha::ChaCha8Rng;

use crate::{acting::Acting, policy::Policy};

/// Returns of `episodes` whole episodes of `policy` in `world`, in the order in which they ended.
///
/// Each copy contributes the same number of episodes (the last round's surplus is dropped by copy order), so that short
/// episodes are not favoured by being over first.
///
/// # Errors
/// The policy or the world failed, or episodes have not ended after `steps_max` steps a copy.
pub fn episode_returns(
    world: Box<dyn Environment>,
    frame_stack: usize,
    policy: &mut dyn Policy,
    epsilon: f64,
    episodes: usize,
    steps_max: u64,
    rng: ChaCha8Rng,
) -> anyhow::Result<Vec<f64>> {
    let envs = world.num_envs();
    let quota = |copy: usize| episodes / envs + usize::from(copy < episodes % envs);
    let mut acting = Acting::new(world, frame_stack, rng)?;
    let mut running = vec![0.0; envs];
    let mut ended = vec![0; envs];
    let mut returns = Vec::with_capacity(episodes);
    for _ in 0..steps_max {
        if returns.len() == episodes {
            return Ok(returns);
        }
        let step = acting.step(policy, epsilon)?;
        for copy in 0..envs {
            running[copy] += f64::from(step.rewards[copy]);
            if matches!(step.ends[copy], StepEnd::Terminal | StepEnd::TimedOut) {
                if ended[copy] < quota(copy) {
                    returns.push(running[copy]);
                    ended[copy] += 1;
                }
                running[copy] = 0.0;
            }
        }
    }
    anyhow::ensure!(
        returns.len() == episodes,
        "only {} of {episodes} episodes ended within {steps_max} steps of each copy: ask for fewer",
        returns.len()
    );
    Ok(returns)
}
