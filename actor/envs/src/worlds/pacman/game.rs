//! One game of Ms. PacMan: how it starts, and what one step does.
//! It neither starts anew what has ended, nor draws what moves.

use rand_chacha::ChaCha8Rng;

use super::{
    config::PacmanConfig,
    ghost::{Chance, Ghost},
    maze::{GHOSTS, Item, Maze, Place},
    render,
};
use crate::environment::StepEnd;
use crate::envs::{RngUse, env_rng};
use crate::error::EnvError;
use crate::worlds::ising::IsingLattice;

pub(super) struct Game {
    pub(super) rng: ChaCha8Rng,
    pub(super) agent: Place,
    pub(super) ghosts: [Ghost; GHOSTS],
    pub(super) lethal: [bool; GHOSTS],
    /// Steps that the agent is still invincible.
    pub(super) boost_left: u32,
    pub(super) items: Vec<Item>,
    pub(super) pellets_left: u32,
    pub(super) episode_step: u32,
    /// Episodes that this environment has ended.
    pub(super) episodes: u64,
    /// The frame without what moves.
    pub(super) background: Vec<u8>,
    /// Its own generator, so that the ghosts do the same with and without it.
    pub(super) walls: Option<(IsingLattice, ChaCha8Rng)>,
}

impl Game {
    pub(super) fn new(
        config: &PacmanConfig,
        maze: &Maze,
        fresh: &[u8],
        env: usize,
        seed: u64,
    ) -> Result<Self, EnvError> {
        let mut overlay_rng = env_rng(seed, env, RngUse::Overlay);
        let walls = match &config.ising {
            Some(overlay) => Some((
                overlay.lattice(&maze.walls(), &mut overlay_rng)?,
                overlay_rng,
            )),
            None => None,
        };
        let mut game = Self {
            rng: env_rng(seed, env, RngUse::Game),
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

    pub(super) fn reset(&mut self, config: &PacmanConfig, maze: &Maze, fresh: &[u8]) {
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
    pub(super) fn step(
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
