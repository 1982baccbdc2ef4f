//! One game of Ms. PacMan: how it starts, and what one step does.
//! It neither resets a game that has ended, nor paints the agent and the ghosts.

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{
    config::PacmanConfig,
    ghost::Ghost,
    maze::{DIRECTIONS, GHOSTS, Item, MAZE, Place},
    render,
};
use crate::{environment::StepEnd, error::EnvError, saved::ensure_fits};

/// One game. The saved state is this struct: it leaves out the maze and the settings, which never change.
#[derive(Clone, Serialize, Deserialize)]
pub struct Game {
    pub(super) rng: ChaCha8Rng,
    pub(super) agent: Place,
    pub(super) ghosts: [Ghost; GHOSTS],
    pub(super) lethal: [bool; GHOSTS],
    /// Steps for which the agent is still invincible.
    pub(super) boost_left: u32,
    pub(super) items: Vec<Item>,
    pub(super) pellets_left: u32,
    pub(super) episode_step: u32,
    /// Episodes that this environment has ended.
    pub(super) episodes: u64,
    /// The frame without the agent and the ghosts.
    pub(super) background: Vec<u8>,
}

impl Game {
    /// Starts an episode, after `episodes` others.
    pub(super) fn start(config: &PacmanConfig, rng: ChaCha8Rng, episodes: u64) -> Self {
        Self {
            rng,
            agent: MAZE.agent_start,
            ghosts: MAZE.ghost_starts.map(Ghost::at),
            lethal: config.lethal_ghosts(episodes),
            boost_left: 0,
            items: MAZE.items.clone(),
            pellets_left: MAZE.pellets,
            episode_step: 0,
            episodes,
            background: render::BACKGROUND.clone(),
        }
    }

    /// Returns an error if no game can be in this state.
    pub(super) fn check_state(&self) -> Result<(), EnvError> {
        let places = MAZE.items.len();
        let is_place = |place: Place| usize::from(place) < places;
        ensure_fits(is_place(self.agent), "the agent's place")?;
        for ghost in self.ghosts {
            let is_heading = ghost.heading.is_none_or(|it| usize::from(it) < DIRECTIONS);
            ensure_fits(is_place(ghost.place) && is_heading, "a ghost's place")?;
        }
        let pellets = self.items.iter().filter(|&&it| it == Item::Pellet).count();
        let fits = self.items.len() == places && self.pellets_left as usize == pellets;
        ensure_fits(fits, "the food")?;
        ensure_fits(self.background.len() == render::FRAME_BYTES, "a frame")
    }

    /// Plays one step, without a reset. Returns its reward and its end.
    pub(super) fn step(&mut self, config: &PacmanConfig, action: u8) -> (f32, StepEnd) {
        let (agent_before, boosted_before) = (self.agent, self.boost_left > 0);
        self.episode_step += 1;
        self.boost_left = self.boost_left.saturating_sub(1);
        if action > 0 {
            self.agent = MAZE.next(self.agent, action - 1);
        }
        let item = std::mem::replace(&mut self.items[usize::from(self.agent)], Item::Nothing);
        let mut reward = self.eat(config, item);
        let boosted = boosted_before || item == Item::Boost;

        let ghosts_before = self.ghosts.map(|ghost| ghost.place);
        for ghost in &mut self.ghosts {
            ghost.step(config, agent_before, boosted_before, &mut self.rng);
        }
        if self.pellets_left == 0 {
            return (reward + config.reward_cleared, StepEnd::Terminal);
        }
        for (index, before) in ghosts_before.into_iter().enumerate() {
            let place = self.ghosts[index].place;
            let crossed = place == agent_before && before == self.agent;
            if place != self.agent && !crossed {
                continue;
            }
            if boosted {
                self.ghosts[index] = Ghost::at(MAZE.ghost_starts[index]);
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

    fn eat(&mut self, config: &PacmanConfig, item: Item) -> f32 {
        if item != Item::Nothing {
            let pixel = MAZE.pixel(self.agent);
            render::paint_pixel(&mut self.background, pixel, render::FLOOR);
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
