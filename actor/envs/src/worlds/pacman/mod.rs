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
use crate::envs::{Env, Envs, RngUse, env_rng};
use crate::error::EnvError;
use crate::saved::check;
use crate::settings::{Built, WorldSettings};
use crate::worlds::ising::{Boundary, IsingLattice};

/// N games of Ms. PacMan. Frames [21, 19, 3] RGB, one pixel a cell; actions 0 no-op, 1 up, 2 down, 3 left, 4 right.
///
/// A move into a wall is a no-op. The no-op is a separate action so that an agent can wait for a ghost to pass.
pub type PacmanWorld = Envs<Board>;

/// One game, and the Ising model in its walls.
pub struct Board {
    game: Game,
    /// The spins in the walls, if walls flicker. Their separate generator keeps the ghosts' moves the same with and without spins.
    walls: Option<(IsingLattice, ChaCha8Rng)>,
}

impl WorldSettings for PacmanConfig {
    fn validate(&self) -> Result<(), EnvError> {
        self.check()
    }

    /// 21 x 19 x 3.
    fn frame_shape(&self) -> FrameShape {
        FrameShape::new(HEIGHT, WIDTH, render::CHANNELS)
    }

    fn action_names(&self) -> Vec<&str> {
        vec!["no-op", "up", "down", "left", "right"]
    }

    fn build(&self, num_envs: usize, seed: u64, _threads: usize) -> Built {
        Ok(Box::new(PacmanWorld::new(self, num_envs, seed)?))
    }

    fn is_resumable(&self) -> bool {
        // Which ghost is lethal depends on how many episodes were played.
        self.lethal_schedule.is_none()
    }
}

impl Env for Board {
    type Config = PacmanConfig;

    /// A game; and, if walls flicker, the spins in its walls with their generator.
    type Saved = (Game, Option<(Vec<i8>, ChaCha8Rng)>);

    fn new(config: &PacmanConfig, seed: u64, env: usize) -> Result<Self, EnvError> {
        let mut walls = None;
        if let Some(overlay) = &config.ising {
            let (sites, temperature, free) = (MAZE.walls(), overlay.temperature, Boundary::Free);
            let mut rng = env_rng(seed, env, RngUse::Overlay);
            let mut lattice =
                IsingLattice::masked(HEIGHT, WIDTH, &sites, temperature, free, &mut rng)?;
            lattice.randomise(&mut rng);
            walls = Some((lattice, rng));
        }
        let game = Game::start(config, env_rng(seed, env, RngUse::Game), 0);
        Ok(Self { game, walls })
    }

    fn draw(&self, _: &PacmanConfig, frame: &mut [u8]) {
        let game = &self.game;
        frame.copy_from_slice(&game.background);
        if let Some((lattice, _)) = &self.walls {
            render::overlay(lattice.spins(), frame);
        }
        let ghosts = game.ghosts.map(|ghost| ghost.place);
        render::actors(ghosts, game.agent, game.boost_left > 0, frame);
    }

    fn act(&mut self, config: &PacmanConfig, action: u8) -> (f32, StepEnd) {
        let game = &mut self.game;
        let (reward, end) = game.step(config, action);
        if end != StepEnd::Running {
            *game = Game::start(config, game.rng.clone(), game.episodes + 1);
        }
        if let (Some((lattice, rng)), Some(overlay)) = (&mut self.walls, &config.ising) {
            match end {
                StepEnd::Running => (0..overlay.sweeps_per_step).for_each(|_| lattice.sweep(rng)),
                _ => lattice.randomise(rng),
            }
        }
        (reward, end)
    }

    fn saved(&self) -> Self::Saved {
        let walls = self.walls.as_ref();
        let walls = walls.map(|(lattice, rng)| (lattice.spins().to_vec(), rng.clone()));
        (self.game.clone(), walls)
    }

    fn restore(&mut self, _: &PacmanConfig, (game, walls): Self::Saved) -> Result<(), EnvError> {
        game.check()?;
        match (&mut self.walls, walls) {
            (Some((lattice, own)), Some((spins, rng))) => {
                lattice.set_spins(&spins)?;
                *own = rng;
            }
            (None, None) => {}
            _ => check(false, "the walls' flicker")?,
        }
        self.game = game;
        Ok(())
    }
}
