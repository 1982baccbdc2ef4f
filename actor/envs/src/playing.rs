//! Helpers for tests: playing a world, and checking the text of an error.

use std::fmt::Display;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::environment::{Environment, StepEnd};

/// Returns the current frames [N, H, W, C].
pub(crate) fn frames(world: &mut dyn Environment) -> Vec<u8> {
    let mut frames = vec![0; world.num_envs() * world.frame_shape().bytes()];
    world.observe(&mut frames);
    frames
}

/// Steps the world and returns the rewards [N] and ends [N].
pub(crate) fn step(world: &mut dyn Environment, actions: &[u8]) -> (Vec<f32>, Vec<StepEnd>) {
    let num_envs = world.num_envs();
    let (mut rewards, mut ends) = (vec![0.0; num_envs], vec![StepEnd::Running; num_envs]);
    world.step(actions, &mut rewards, &mut ends).unwrap();
    (rewards, ends)
}

/// Takes `steps` steps with actions drawn from `rng`. Returns for each step the frames before it, its rewards and its ends.
pub(crate) fn play(
    world: &mut dyn Environment,
    steps: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<(Vec<u8>, Vec<f32>, Vec<StepEnd>)> {
    let (num_envs, num_actions) = (world.num_envs(), world.num_actions() as u8);
    let mut seen = Vec::new();
    for _ in 0..steps {
        let draw = |_| rng.random_range(0..num_actions);
        let actions: Vec<u8> = (0..num_envs).map(draw).collect();
        let frames = frames(world);
        let (rewards, ends) = step(world, &actions);
        seen.push((frames, rewards, ends));
    }
    seen
}

/// Checks that the result is an error whose text contains all `sentences`, and returns the text.
#[track_caller]
pub(crate) fn fails<T, E: Display>(result: Result<T, E>, sentences: &[&str]) -> String {
    let text = result.err().expect("an error").to_string();
    for sentence in sentences {
        assert!(text.contains(sentence), "no {sentence:?} in {text}");
    }
    text
}
