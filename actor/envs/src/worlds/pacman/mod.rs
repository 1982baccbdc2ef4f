//! The simplified Ms. PacMan of the paper: a yellow square eats pellets in a maze and is hunted by four ghosts.
//! It has no levels, no lives and no fruit, and it does not stack or enlarge frames.
//!
//! In one step all move at once. The agent moves and eats what lies in its new cell; each ghost moves by what it saw before the step. Then
//! contacts count, and crossing (agent and ghost changing places) is one. A lethal ghost in contact ends the episode. If the agent is
//! boosted, the ghost goes back to its start instead and earns `reward_ghost`. A harmless ghost in contact with a boosted agent goes back
//! too, without a reward. The episode also ends when the last pellet is eaten, before any contact of that step. Boosts need not be eaten.
//!
//! Source: the paper's appendix on Ms. PacMan; what it leaves open (maze, colours, rewards, order within a step, how a
//! ghost finds its way) is decided here and in `config`.

mod config;
mod game;
mod ghost;
mod maze;
mod render;
#[cfg(test)]
pub(crate) mod tests;

pub use config::{IsingOverlay, LethalSchedule, PacmanConfig};
use game::Game;
use maze::{HEIGHT, MAZE, WIDTH};
use rand_chacha::ChaCha8Rng;

use crate::environment::{FrameShape, StepEnd};
use crate::envs::{RngUse, SerialWorld, SingleEnv, env_rng};
use crate::error::EnvError;
use crate::saved::ensure_fits;
use crate::settings::{BuildResult, WorldSettings};
use crate::worlds::ising::{Boundary, IsingLattice};

/// N games of Ms. PacMan. Frames [21, 19, 3] RGB, one pixel a cell; actions 0 no-op, 1 up, 2 down, 3 left, 4 right.
///
/// A move into a wall is a no-op. The no-op is a separate action so that an agent can wait for a ghost to pass.
pub type PacmanWorld = SerialWorld<Board>;

/// One game, and the Ising model in its walls.
pub struct Board {
    game: Game,
    /// The spins in the walls, if walls flicker. Their separate generator keeps the ghosts' moves the same with and without spins.
    wall_spins: Option<(IsingLattice, ChaCha8Rng)>,
}

impl WorldSettings for PacmanConfig {
    fn validate(&self) -> Result<(), EnvError> {
        self.check_ranges()
    }

    /// 21 x 19 x 3.
    fn frame_shape(&self) -> FrameShape {
        FrameShape::new(HEIGHT, WIDTH, render::CHANNELS)
    }

    fn action_names(&self) -> Vec<&str> {
        vec!["no-op", "up", "down", "left", "right"]
    }

    fn build(&self, num_envs: usize, seed: u64, _threads: usize) -> BuildResult {
        Ok(Box::new(PacmanWorld::new(self, num_envs, seed)?))
    }

    fn is_resumable(&self) -> bool {
        // Which ghost is lethal depends on how many episodes were played.
        self.lethal_schedule.is_none()
    }
}

impl SingleEnv for Board {
    type Config = PacmanConfig;

    /// A game; and, if walls flicker, the spins in its walls with their generator.
    type State = (Game, Option<(Vec<i8>, ChaCha8Rng)>);

    fn new(config: &PacmanConfig, seed: u64, env: usize) -> Self {
        let mut wall_spins = None;
        if let Some(overlay) = &config.ising {
            let (sites, temperature, free) = (MAZE.walls(), overlay.temperature, Boundary::Free);
            let mut rng = env_rng(seed, env, RngUse::Overlay);
            let mut lattice =
                IsingLattice::masked(HEIGHT, WIDTH, &sites, temperature, free, &mut rng);
            lattice.randomise(&mut rng);
            wall_spins = Some((lattice, rng));
        }
        let game = Game::start(config, env_rng(seed, env, RngUse::Game), 0);
        Self { game, wall_spins }
    }

    fn render(&self, _: &PacmanConfig, frame: &mut [u8]) {
        let game = &self.game;
        frame.copy_from_slice(&game.background);
        if let Some((lattice, _)) = &self.wall_spins {
            render::paint_spins(lattice.spins(), frame);
        }
        let ghosts = game.ghosts.map(|ghost| ghost.place);
        render::paint_actors(ghosts, game.agent, game.boost_left > 0, frame);
    }

    fn act(&mut self, config: &PacmanConfig, action: u8) -> (f32, StepEnd) {
        let game = &mut self.game;
        let (reward, end) = game.step(config, action);
        if end != StepEnd::Running {
            *game = Game::start(config, game.rng.clone(), game.episodes + 1);
        }
        if let (Some((lattice, rng)), Some(overlay)) = (&mut self.wall_spins, &config.ising) {
            match end {
                StepEnd::Running => (0..overlay.sweeps_per_step).for_each(|_| lattice.sweep(rng)),
                _ => lattice.randomise(rng),
            }
        }
        (reward, end)
    }

    fn state(&self) -> Self::State {
        let spins = self.wall_spins.as_ref();
        let spins = spins.map(|(lattice, rng)| (lattice.spins().to_vec(), rng.clone()));
        (self.game.clone(), spins)
    }

    fn restore(&mut self, _: &PacmanConfig, (game, walls): Self::State) -> Result<(), EnvError> {
        game.check_state()?;
        match (&mut self.wall_spins, walls) {
            (Some((lattice, own)), Some((spins, rng))) => {
                lattice.set_spins(&spins)?;
                *own = rng;
            }
            (None, None) => {}
            _ => ensure_fits(false, "the walls' flicker")?,
        }
        self.game = game;
        Ok(())
    }
}
