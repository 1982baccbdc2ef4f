//! The Procgen world: what the engine's flags mean for episodes and levels.
//! It does not fetch or load the engine itself (`procgen-sys` does), nor enlarge or stack frames; it makes them smaller or grey on request.
//!
//! # Ends
//! After a step the engine shows the next episode's first frame at once, so the terminal frame is never seen.
//!
//! | `first` | level completed | steps | end |
//! | --- | --- | --- | --- |
//! | 0 | no | | `Running` |
//! | 0 | yes (sequential levels only) | | `LevelChange` |
//! | 1 | no | the game's limit | `TimedOut` |
//! | 1 | otherwise | | `Terminal` |
//!
//! The engine does not say which episodes its limit cut off, so steps are counted here. The limits are exact (they are
//! read out of the engine's saved states in the tests of `procgen-sys`). An episode that was lost in the very step of
//! the limit cannot be told apart: it is reported as `TimedOut`.
//!
//! # Sequential levels
//! With `use_sequential_levels` the engine continues a completed level s with level s + 997: `first` stays 0, and the
//! return continues. With 500 levels this leaves the training set at the first completed level, and the agent trains on
//! ever new levels until it dies. Only a lost or timed-out episode draws from the set again.
//!
//! Here a level **of the set** follows a completed level. When the engine has left the set, the environment's complete
//! state is moved to a spare environment, reset there, and moved back. The reset draws the level with the environment's
//! own generator, as after every lost episode. So levels are uniform over the set, and the result depends on the seed
//! and the environment's own actions only. No other environment is stepped and no transition is made up: the step that
//! completed the level keeps its reward and is a `LevelChange`, and the next frame is the first of the drawn level.
//! Where s + 997 lies in the set (sets of more than 997 levels, or all levels), the engine's own choice stays.

mod config;
mod shrink;
#[cfg(test)]
pub(crate) mod tests;
mod visible_actions;

use procgen_sys::{FRAME_BYTES, Game, NUM_ACTIONS, ProcgenError, RESET, State, VecGame};

use crate::environment::{Environment, FrameShape, StepEnd, StepResult};
use crate::envs::{check_frames, check_step};
use crate::error::{EnvError, require};
use crate::saved;
use crate::settings::{BuildResult, Variants, WorldSettings};
use config::engine_side;
use shrink::{FrameShrinker, RGB};

pub use config::ProcgenConfig;
pub use visible_actions::visible_actions;

const SIDE_MIN: u32 = 8;

/// Resets in a row that may fail to draw a level of the set before it is an error. One is enough unless the game's
/// no-op completes the drawn level in its first step.
const REDRAWS_MAX: usize = 16;

/// Environments of one of Procgen's games.
pub struct ProcgenWorld {
    game: VecGame,
    /// Steps taken in the current level or episode [N].
    steps_taken: Vec<u32>,
    /// Steps after which the engine ends an episode.
    time_limit_steps: u32,
    /// Keeps sequential levels in their set; `None` without sequential levels, where the engine does so itself.
    level_set: Option<LevelSet>,
    shape: FrameShape,
    /// Makes frames smaller or grey; `None` if this world's frames are the engine's.
    shrinker: Option<FrameShrinker>,
}

/// The set of levels, and the spare environment in which an environment that has left it is reset.
struct LevelSet {
    range: std::ops::Range<i32>,
    spare: VecGame,
}

impl ProcgenWorld {
    /// Makes `num_envs` environments. Fetches the engine unless it is installed; [`procgen_sys::Engine::install`] does so beforehand.
    ///
    /// `seed` decides which levels are drawn; `threads` is the number of threads that step, 0 for the calling one.
    pub fn new(
        config: &ProcgenConfig,
        num_envs: usize,
        seed: u64,
        threads: usize,
    ) -> Result<ProcgenWorld, EnvError> {
        config.validate()?;
        let options = config.options(num_envs, seed, threads)?;
        let engine = config.engine(&mut |_| {})?;
        let level_set = if config.use_sequential_levels {
            let spare = procgen_sys::Options {
                num_envs: 1,
                num_threads: 0,
                ..options
            };
            let end = match options.num_levels {
                0 => i32::MAX,
                levels => options.start_level + levels,
            };
            Some(LevelSet {
                range: options.start_level..end,
                spare: VecGame::new(&engine, &spare)?,
            })
        } else {
            None
        };
        let shape = config.frame_shape();
        Ok(ProcgenWorld {
            game: VecGame::new(&engine, &options)?,
            steps_taken: vec![0; num_envs],
            time_limit_steps: config.game.time_limit_steps(config.distribution_mode),
            level_set,
            shape,
            shrinker: (shape.bytes() < FRAME_BYTES).then(|| FrameShrinker::new(shape)),
        })
    }

    /// What the last step ended in environment `env`; `steps_taken` must already count that step.
    fn step_end(&self, env: usize) -> StepEnd {
        let completed = self.game.prev_level_complete()[env] != 0;
        match (self.game.first()[env] != 0, completed) {
            (false, false) => StepEnd::Running,
            (false, true) => StepEnd::LevelChange,
            (true, false) if self.steps_taken[env] >= self.time_limit_steps => StepEnd::TimedOut,
            (true, _) => StepEnd::Terminal,
        }
    }
}

impl LevelSet {
    /// Moves environment `env` of `game` to the first frame of a level of the set, drawn by the environment's own generator.
    fn redraw(&mut self, game: &mut VecGame, env: usize) -> Result<(), ProcgenError> {
        self.spare.set_state(0, &game.state(env)?)?;
        for _ in 0..REDRAWS_MAX {
            self.spare.act(&[RESET])?;
            if self.range.contains(&self.spare.level_seed()[0]) {
                return game.set_state(env, &self.spare.state(0)?);
            }
        }
        let text = format!(
            "{REDRAWS_MAX} resets in a row drew no level of {:?}",
            self.range
        );
        Err(ProcgenError::Unexpected(text))
    }
}

impl WorldSettings for ProcgenConfig {
    /// Needs no engine.
    fn validate(&self) -> Result<(), EnvError> {
        let (side, whole) = (self.frame_side, engine_side());
        let why = format!(
            "frame_side = {side}; the engine draws {whole} pixels a side, and {SIDE_MIN} of them are the fewest; `input.height` and \
             `input.width` enlarge"
        );
        require((SIDE_MIN..=whole).contains(&side), why)?;
        self.options(1, 0, 0).map(drop)
    }

    fn frame_shape(&self) -> FrameShape {
        let side = self.frame_side as usize;
        FrameShape::new(side, side, if self.grey { 1 } else { RGB })
    }

    /// Source: the `tps` of Procgen's own `interactive.py`.
    fn steps_per_second(&self) -> f64 {
        15.0
    }

    /// What each action presses, by the engine's numbering. Source: `get_combos` in `procgen/env.py`.
    fn action_names(&self) -> Vec<&str> {
        let names = "left+down left left+up down no-op up right+down right right+up d a w s q e";
        names.split(' ').collect()
    }

    fn build(&self, num_envs: usize, seed: u64, threads: usize) -> BuildResult {
        Ok(Box::new(ProcgenWorld::new(self, num_envs, seed, threads)?))
    }

    fn variants() -> Variants {
        Variants {
            key: "game",
            names: &Game::NAMES,
            is_free_text: false,
        }
    }

    fn variant(&self) -> Option<&str> {
        Some(self.game.name())
    }

    fn library(&self) -> Option<&str> {
        self.library.as_deref()
    }

    fn visible_actions(&self) -> Vec<u8> {
        visible_actions(self.game).into()
    }

    fn install(&self, progress: &mut dyn FnMut(&str)) -> Result<(), EnvError> {
        self.engine(progress)?;
        Ok(())
    }
}

impl Environment for ProcgenWorld {
    fn frame_shape(&self) -> FrameShape {
        self.shape
    }

    fn num_actions(&self) -> usize {
        NUM_ACTIONS
    }

    fn num_envs(&self) -> usize {
        self.game.num_envs()
    }

    fn observe(&mut self, frames: &mut [u8]) {
        check_frames(frames, self.num_envs(), self.shape);
        match &self.shrinker {
            None => frames.copy_from_slice(self.game.frames()),
            Some(shrinker) => shrinker.apply(self.game.frames(), frames),
        }
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> StepResult {
        check_step(self.num_envs(), NUM_ACTIONS, actions, rewards, ends)?;
        let actions: Vec<_> = actions.iter().copied().map(i32::from).collect();
        self.game.act(&actions)?;
        rewards.copy_from_slice(self.game.rewards());
        for (env, end) in ends.iter_mut().enumerate() {
            self.steps_taken[env] += 1;
            *end = self.step_end(env);
            if *end != StepEnd::Running {
                self.steps_taken[env] = 0;
            }
            if let Some(level_set) = &mut self.level_set
                && !level_set.range.contains(&self.game.level_seed()[env])
            {
                level_set.redraw(&mut self.game, env)?;
            }
        }
        Ok(())
    }

    fn save(&mut self) -> Result<Vec<u8>, EnvError> {
        let game = &mut self.game;
        let envs = self.steps_taken.iter().enumerate();
        let envs = envs.map(|(env, &steps)| Ok((steps, game.state(env)?)));
        saved::encode(&envs.collect::<Result<Vec<_>, ProcgenError>>()?)
    }

    fn load(&mut self, state: &[u8]) -> Result<(), EnvError> {
        let envs: Vec<(u32, State)> = saved::decode(state)?;
        saved::check_env_count(envs.len(), self.num_envs())?;
        for (env, (steps, state)) in envs.into_iter().enumerate() {
            self.game.set_state(env, &state)?;
            self.steps_taken[env] = steps;
        }
        Ok(())
    }
}
