//! Evaluates a policy: plays whole episodes and sums their rewards without discount.
//! It stores and sends nothing.

use std::ops::ControlFlow;

use driml_envs::{Environment, StepEnd};
use rand_chacha::ChaCha8Rng;

use crate::{
    acting::{ActingLoop, Step},
    error::ActError,
    policy::Policy,
};

/// The size and the settings of an evaluation.
#[derive(Clone, Copy, Debug)]
pub struct Evaluation {
    /// The number of frames stacked in a state.
    pub frame_stack: usize,
    /// Probability of a random action.
    pub epsilon: f64,
    /// The number of whole episodes, of all environments together.
    pub episodes: usize,
    /// Steps of each environment after which the evaluation fails.
    pub steps_max: u64,
}

/// A callback that gets every step and the returns so far, and decides whether to continue.
pub type OnStep<'a> = &'a mut dyn FnMut(&Step<'_>, &[f64]) -> ControlFlow<()>;

/// Plays whole episodes of `policy` in `world`. Returns their returns in the order in which they ended, fewer of them
/// if `on_step` breaks. `rng` is for exploration alone.
///
/// Each environment contributes the same number of episodes (the last round's surplus is dropped by environment order),
/// so that short episodes do not count more because they end first.
///
/// # Errors
/// The policy or the world failed, or episodes have not ended after `steps_max` steps per environment.
pub fn episode_returns(
    world: Box<dyn Environment>,
    policy: &mut dyn Policy,
    evaluation: Evaluation,
    rng: ChaCha8Rng,
    on_step: OnStep<'_>,
) -> Result<Vec<f64>, ActError> {
    let (episodes, steps_max) = (evaluation.episodes, evaluation.steps_max);
    let envs = world.num_envs();
    let quota = |env: usize| episodes / envs + usize::from(env < episodes % envs);
    let mut acting = ActingLoop::new(world, evaluation.frame_stack, rng);
    let mut episode_return = vec![0.0; envs];
    let mut episodes_ended = vec![0; envs];
    let mut returns = Vec::with_capacity(episodes);
    for _ in 0..steps_max {
        if returns.len() == episodes {
            return Ok(returns);
        }
        let step = acting.step(policy, evaluation.epsilon)?;
        for env in 0..envs {
            episode_return[env] += f64::from(step.rewards[env]);
            if matches!(step.ends[env], StepEnd::Terminal | StepEnd::TimedOut) {
                if episodes_ended[env] < quota(env) {
                    returns.push(episode_return[env]);
                    episodes_ended[env] += 1;
                }
                episode_return[env] = 0.0;
            }
        }
        if on_step(&step, &returns).is_break() {
            return Ok(returns);
        }
    }
    if returns.len() < episodes {
        let ended = returns.len();
        return Err(ActError::Other(format!(
            "only {ended} of {episodes} episodes ended within {steps_max} steps of each environment: the world may need a step limit"
        )));
    }
    Ok(returns)
}

#[cfg(test)]
mod tests {
    use driml_envs::{FrameShape, StepResult};
    use rand::SeedableRng;

    use super::*;

    /// A world whose environments repeat a script of rewards and ends.
    struct Scripted {
        scripts: Vec<Vec<(f32, StepEnd)>>,
        step: usize,
    }

    impl Environment for Scripted {
        fn frame_shape(&self) -> FrameShape {
            FrameShape::new(1, 1, 1)
        }

        fn num_actions(&self) -> usize {
            1
        }

        fn num_envs(&self) -> usize {
            self.scripts.len()
        }

        fn observe(&mut self, frames: &mut [u8]) {
            frames.fill(0);
        }

        fn step(&mut self, _: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> StepResult {
            for (env, script) in self.scripts.iter().enumerate() {
                (rewards[env], ends[env]) = script[self.step % script.len()];
            }
            self.step += 1;
            Ok(())
        }
    }

    /// Records the epsilons that it gets.
    #[derive(Default)]
    struct Tape(Vec<f64>);

    impl Policy for Tape {
        fn act(
            &mut self,
            _states: &[u8],
            epsilon: f64,
            _rng: &mut ChaCha8Rng,
            actions: &mut [u8],
        ) -> Result<(), ActError> {
            self.0.push(epsilon);
            actions.fill(0);
            Ok(())
        }
    }

    fn play(
        scripts: &[&[(f32, StepEnd)]],
        episodes: usize,
        steps_max: u64,
    ) -> Result<Vec<f64>, ActError> {
        play_until(usize::MAX, scripts, episodes, steps_max)
    }

    /// Like `play`, but breaks after `ended` episodes.
    fn play_until(
        ended: usize,
        scripts: &[&[(f32, StepEnd)]],
        episodes: usize,
        steps_max: u64,
    ) -> Result<Vec<f64>, ActError> {
        let scripts = scripts.iter().map(|script| script.to_vec()).collect();
        let world = Box::new(Scripted { scripts, step: 0 });
        let (mut policy, rng) = (Tape::default(), ChaCha8Rng::seed_from_u64(1));
        let evaluation = Evaluation {
            frame_stack: 1,
            epsilon: 0.25,
            episodes,
            steps_max,
        };
        let (mut seen, mut shown) = (0, Vec::new());
        let returns = episode_returns(world, &mut policy, evaluation, rng, &mut |_, returns| {
            seen += 1;
            shown = returns.to_vec();
            match returns.len() == ended {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            }
        });
        assert_eq!(seen, policy.0.len(), "every step is shown");
        assert!(returns.as_ref().is_ok_and(|it| *it == shown) || returns.is_err());
        assert!(policy.0.iter().all(|&epsilon| epsilon == 0.25));
        returns
    }

    const SHORT: &[(f32, StepEnd)] = &[(1.0, StepEnd::Terminal)];
    const LONG: &[(f32, StepEnd)] = &[
        (10.0, StepEnd::Running),
        (20.0, StepEnd::LevelChange),
        (30.0, StepEnd::Running),
        (40.0, StepEnd::Terminal),
    ];

    #[test]
    fn a_level_change_does_not_end_an_episode_and_a_time_out_does() {
        let cut_off: &[_] = &[(2.0, StepEnd::Running), (3.0, StepEnd::TimedOut)];
        assert_eq!(play(&[LONG], 2, 100).unwrap(), [100.0, 100.0]);
        assert_eq!(play(&[cut_off], 2, 100).unwrap(), [5.0, 5.0]);
    }

    /// In the order in which they end, the first four episodes would all be the short environment's.
    #[test]
    fn every_environment_plays_its_share_of_the_episodes() {
        let all = play(&[SHORT, LONG], 4, 100).unwrap();
        assert_eq!(all, [1.0, 1.0, 100.0, 100.0]);
        // What is left over goes to the first environments.
        assert_eq!(play(&[SHORT, LONG], 3, 100).unwrap(), [1.0, 1.0, 100.0]);
        assert_eq!(play(&[LONG, SHORT], 3, 100).unwrap(), [1.0, 100.0, 100.0]);
        assert_eq!(play(&[SHORT, LONG], 1, 100).unwrap(), [1.0]);
    }

    #[test]
    fn a_watch_that_breaks_ends_the_play() {
        assert_eq!(play_until(3, &[SHORT], 9, 100).unwrap(), [1.0; 3]);
    }

    #[test]
    fn episodes_that_do_not_end_are_an_error() {
        assert_eq!(play(&[LONG], 1, 4).unwrap(), [100.0]);
        let message = play(&[LONG], 2, 7).unwrap_err().to_string();
        assert_eq!(
            message,
            "only 1 of 2 episodes ended within 7 steps of each environment: the world may need a step limit"
        );
        let endless: &[_] = &[(1.0, StepEnd::LevelChange)];
        assert!(play(&[endless], 1, 50).is_err());
    }
}
