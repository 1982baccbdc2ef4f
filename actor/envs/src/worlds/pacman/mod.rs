//! The simplified Ms. PacMan of the paper: a yellow square eats pellets in a maze and is hunted by four ghosts.
//! It has no levels, no lives and no fruit, and it knows nothing of stacks or enlargement.
//!
//! One step, everyone at once: the agent moves and eats what lies there; each ghost moves by what it saw before the
//! step; then contacts count, and crossing (agent and ghost changing places) is one. A lethal ghost in contact ends the
//! episode, or, while the agent is boosted, goes back to its start and earns `reward_ghost`. A harmless ghost in contact
//! with a boosted agent goes back too, for the same behaviour, but has no link to the reward. The episode also ends when
//! the last pellet is eaten, before any contact of that step. Boosts need not be eaten.
//!
//! Source: the paper's appendix on Ms. PacMan; what it leaves open (maze, colours, rewards, order within a step, how a
//! ghost finds its way) is decided here and in `config`.

mod config;
mod ghost;
mod maze;
mod render;
mod saved;
#[cfg(test)]
mod state_tests;
#[cfg(test)]
pub(crate) mod tests;

use rand_chacha::ChaCha8Rng;

pub use config::{IsingOverlay, LethalSchedule, PacmanConfig};
use ghost::{Chance, Ghost};
use maze::{GHOSTS, Item, Maze, Place};
use saved::SavedGame;

use crate::copies::{Copies, RngUse, check_num_envs, copy_rng};
use crate::environment::{Environment, FrameShape, StepEnd};
use crate::error::EnvError;
use crate::settings::WorldSettings;
use crate::worlds::ising::IsingLattice;

/// N games of Ms. PacMan. Frames [21, 19, 3] RGB, one pixel a cell; actions 0 no-op, 1 up, 2 down, 3 left, 4 right.
///
/// A move into a wall is a no-op. The no-op is a separate action so that an agent can wait for a ghost to pass.
pub struct PacmanWorld {
    config: PacmanConfig,
    chance: Chance,
    maze: Maze,
    /// The frame at the start of an episode, without what moves.
    fresh: Vec<u8>,
    copies: Vec<Game>,
}

struct Game {
    rng: ChaCha8Rng,
    agent: Place,
    ghosts: [Ghost; GHOSTS],
    lethal: [bool; GHOSTS],
    /// Steps that the agent is still invincible.
    boost_left: u32,
    items: Vec<Item>,
    pellets_left: u32,
    episode_step: u32,
    /// Episodes that this copy has ended.
    episodes: u64,
    /// The frame without what moves.
    background: Vec<u8>,
    /// Its own generator, so that the ghosts do the same with and without it.
    walls: Option<(IsingLattice, ChaCha8Rng)>,
}

impl PacmanWorld {
    /// The actions, in their order.
    pub const ACTION_NAMES: [&str; 5] = ["no-op", "up", "down", "left", "right"];

    /// `num_envs` games; copy i depends on (`seed`, i) and its actions only.
    ///
    /// # Errors
    /// Settings that cannot work.
    pub fn new(config: &PacmanConfig, num_envs: usize, seed: u64) -> Result<Self, EnvError> {
        config.validate()?;
        check_num_envs(num_envs)?;
        let maze = Maze::new();
        let mut fresh = vec![0; render::FRAME_BYTES];
        render::background(&maze, &mut fresh);
        let copies = (0..num_envs)
            .map(|env| Game::new(config, &maze, &fresh, env, seed))
            .collect::<Result<Vec<_>, EnvError>>()?;
        let chance = Chance {
            epsilon: config.epsilon,
            switch_probability: config.switch_probability,
        };
        Ok(Self {
            config: config.clone(),
            chance,
            maze,
            fresh,
            copies,
        })
    }

    /// Which ghosts are lethal in copy `env`'s current episode; `None` if there is no such copy.
    pub fn lethal(&self, env: usize) -> Option<[bool; GHOSTS]> {
        self.copies.get(env).map(|game| game.lethal)
    }
}

impl WorldSettings for PacmanConfig {
    fn validate(&self) -> Result<(), EnvError> {
        PacmanConfig::validate(self)
    }

    fn frame_shape(&self) -> FrameShape {
        PacmanConfig::frame_shape(self)
    }

    fn action_names(&self) -> Vec<&str> {
        PacmanWorld::ACTION_NAMES.to_vec()
    }

    fn build(
        &self,
        num_envs: usize,
        seed: u64,
        _threads: usize,
    ) -> Result<Box<dyn Environment>, EnvError> {
        Ok(Box::new(PacmanWorld::new(self, num_envs, seed)?))
    }

    fn is_resumable(&self) -> bool {
        // Which ghost is lethal depends on how many episodes were played.
        self.lethal_schedule.is_none()
    }
}

impl Copies for PacmanWorld {
    type Saved = SavedGame;

    fn shape(&self) -> FrameShape {
        self.config.frame_shape()
    }

    fn actions(&self) -> usize {
        Self::ACTION_NAMES.len()
    }

    fn count(&self) -> usize {
        self.copies.len()
    }

    fn draw(&self, copy: usize, frame: &mut [u8]) {
        let game = &self.copies[copy];
        frame.copy_from_slice(&game.background);
        if let Some((lattice, _)) = &game.walls {
            render::overlay(lattice.spins(), frame);
        }
        let ghosts = game.ghosts.map(|ghost| ghost.place);
        render::actors(&self.maze, ghosts, game.agent, game.boost_left > 0, frame);
    }

    fn act(&mut self, copy: usize, action: u8) -> (f32, StepEnd) {
        let game = &mut self.copies[copy];
        let (reward, end) = game.step(&self.config, &self.maze, self.chance, action);
        if end != StepEnd::Running {
            game.episodes += 1;
            game.reset(&self.config, &self.maze, &self.fresh);
        } else if let (Some((lattice, rng)), Some(overlay)) = (&mut game.walls, &self.config.ising)
        {
            (0..overlay.sweeps_per_step).for_each(|_| lattice.sweep(rng));
        }
        (reward, end)
    }

    fn saved(&self, copy: usize) -> SavedGame {
        self.copies[copy].saved()
    }

    fn restore(&mut self, copy: usize, saved: SavedGame) -> Result<(), EnvError> {
        self.copies[copy].load(saved, &self.maze)
    }
}

impl Game {
    fn new(
        config: &PacmanConfig,
        maze: &Maze,
        fresh: &[u8],
        env: usize,
        seed: u64,
    ) -> Result<Self, EnvError> {
        let mut overlay_rng = copy_rng(seed, env, RngUse::Overlay);
        let walls = match &config.ising {
            Some(overlay) => Some((
                overlay.lattice(&maze.walls(), &mut overlay_rng)?,
                overlay_rng,
            )),
            None => None,
        };
        let mut game = Self {
            rng: copy_rng(seed, env, RngUse::Game),
            agent: maze.agent_start(),
            ghosts: maze.ghost_starts().map(Ghost::at),
            lethal: config.lethal_in(0),
            boost_left: 0,
            items: maze.items().to_vec(),
            pellets_left: maze.pellets(),
            episode_step: 0,
            episodes: 0,
            background: fresh.to_vec(),
            walls,
        };
        game.reset(config, maze, fresh);
        Ok(game)
    }

    fn reset(&mut self, config: &PacmanConfig, maze: &Maze, fresh: &[u8]) {
        self.agent = maze.agent_start();
        self.ghosts = maze.ghost_starts().map(Ghost::at);
        self.lethal = config.lethal_in(self.episodes);
        self.boost_left = 0;
        self.items.copy_from_slice(maze.items());
        self.pellets_left = maze.pellets();
        self.episode_step = 0;
        self.background.copy_from_slice(fresh);
        if let Some((lattice, rng)) = &mut self.walls {
            lattice.randomise(rng);
        }
    }

    /// One step of one game; it does not reset. Returns what was earned and what ended.
    fn step(
        &mut self,
        config: &PacmanConfig,
        maze: &Maze,
        chance: Chance,
        action: u8,
    ) -> (f32, StepEnd) {
        let (agent_before, boosted_before) = (self.agent, self.boost_left > 0);
        self.episode_step += 1;
        self.boost_left = self.boost_left.saturating_sub(1);
        if action > 0 {
            self.agent = maze.next(self.agent, action - 1);
        }
        let item = std::mem::replace(&mut self.items[usize::from(self.agent)], Item::Nothing);
        let mut reward = self.eat(config, maze, item);
        let boosted = boosted_before || item == Item::Boost;

        let ghosts_before = self.ghosts.map(|ghost| ghost.place);
        for ghost in &mut self.ghosts {
            ghost.step(maze, agent_before, boosted_before, chance, &mut self.rng);
        }
        if self.pellets_left == 0 {
            return (reward + config.reward_cleared, StepEnd::Terminal);
        }
        for (index, before) in ghosts_before.into_iter().enumerate() {
            let here = self.ghosts[index].place;
            let crossed = here == agent_before && before == self.agent;
            if here != self.agent && !crossed {
                continue;
            }
            if boosted {
                self.ghosts[index] = Ghost::at(maze.ghost_starts()[index]);
                if self.lethal[index] {
                    reward += config.reward_ghost;
                }
            } else if self.lethal[index] {
                return (reward + config.reward_death, StepEnd::Terminal);
            }
        }
        match self.episode_step >= config.step_limit {
            true => (reward, StepEnd::TimedOut),
            false => (reward, StepEnd::Running),
        }
    }

    fn eat(&mut self, config: &PacmanConfig, maze: &Maze, item: Item) -> f32 {
        if item != Item::Nothing {
            render::erase(maze, self.agent, &mut self.background);
        }
        match item {
            Item::Nothing => 0.0,
            Item::Pellet => {
                self.pellets_left -= 1;
                config.reward_pellet
            }
            Item::Boost => {
                self.boost_left = config.boost_steps;
                config.reward_boost
            }
        }
    }
}
