//! Saving and restoring a game of Ms. PacMan.
//! What never changes, the maze and the settings, is not in it.

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{
    game::Game,
    ghost::Ghost,
    maze::{DIRECTIONS, GHOSTS, Item, Maze, Place},
};
use crate::{error::EnvError, saved::check};

#[derive(Serialize, Deserialize)]
pub(crate) struct SavedGame {
    rng: ChaCha8Rng,
    agent: Place,
    ghosts: [Ghost; GHOSTS],
    lethal: [bool; GHOSTS],
    boost_left: u32,
    items: Vec<Item>,
    pellets_left: u32,
    episode_step: u32,
    episodes: u64,
    background: Vec<u8>,
    /// The spins of the walls and their generator, where walls flicker.
    walls: Option<(Vec<i8>, ChaCha8Rng)>,
}

impl Game {
    pub(super) fn saved(&self) -> SavedGame {
        let walls = self.walls.as_ref();
        SavedGame {
            rng: self.rng.clone(),
            agent: self.agent,
            ghosts: self.ghosts,
            lethal: self.lethal,
            boost_left: self.boost_left,
            items: self.items.clone(),
            pellets_left: self.pellets_left,
            episode_step: self.episode_step,
            episodes: self.episodes,
            background: self.background.clone(),
            walls: walls.map(|(lattice, rng)| (lattice.spins().to_vec(), rng.clone())),
        }
    }

    pub(super) fn load(&mut self, saved: SavedGame, maze: &Maze) -> Result<(), EnvError> {
        let places = maze.items().len();
        let is_place = |place: Place| usize::from(place) < places;
        check(is_place(saved.agent), "the agent's place")?;
        for ghost in saved.ghosts {
            let heads = ghost.heading.is_none_or(|it| usize::from(it) < DIRECTIONS);
            check(is_place(ghost.place) && heads, "a ghost's place")?;
        }
        let pellets = saved.items.iter().filter(|&&it| it == Item::Pellet).count();
        let fits = saved.items.len() == places && saved.pellets_left as usize == pellets;
        check(fits, "the food")?;
        check(saved.background.len() == self.background.len(), "a frame")?;
        match (&mut self.walls, saved.walls) {
            (Some((lattice, own)), Some((spins, rng))) => {
                lattice.set_spins(&spins)?;
                *own = rng;
            }
            (None, None) => {}
            _ => check(false, "the walls' flicker")?,
        }
        self.rng = saved.rng;
        self.agent = saved.agent;
        self.ghosts = saved.ghosts;
        self.lethal = saved.lethal;
        self.boost_left = saved.boost_left;
        self.items = saved.items;
        self.pellets_left = saved.pellets_left;
        self.episode_step = saved.episode_step;
        self.episodes = saved.episodes;
        self.background = saved.background;
        Ok(())
    }
}
