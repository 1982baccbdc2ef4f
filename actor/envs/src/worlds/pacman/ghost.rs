//! The moves of a ghost: it wanders, follows or avoids, changes between these at random, and sometimes moves at random.
//! It decides nothing about contacts; every ghost sees the agent where it was before the step.

use rand::Rng;
use serde::{Deserialize, Serialize};

use super::{
    config::PacmanConfig,
    maze::{DIRECTIONS, Direction, MAZE, Place},
};

/// A ghost's behaviour. `wanted_mode` says which one the situation asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Mode {
    /// Continue at random, turning back only where there is no other way.
    Wander,
    /// Take the shortest way to the agent.
    Follow,
    /// Take the move that ends furthest from the agent.
    Avoid,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Ghost {
    pub(crate) place: Place,
    /// The last move's direction; `None` before the first.
    pub(crate) heading: Option<Direction>,
    pub(crate) mode: Mode,
}

impl Ghost {
    /// A ghost at its start, wandering.
    pub(crate) fn at(place: Place) -> Self {
        Self {
            place,
            heading: None,
            mode: Mode::Wander,
        }
    }

    /// One step: perhaps a change of mode, then one move.
    pub(crate) fn step(
        &mut self,
        config: &PacmanConfig,
        agent: Place,
        boosted: bool,
        rng: &mut impl Rng,
    ) {
        let wanted = wanted_mode(MAZE.in_sight(self.place, agent), boosted);
        if wanted != self.mode && rng.random::<f64>() < config.switch_probability {
            self.mode = wanted;
        }
        let direction = if rng.random::<f64>() < config.epsilon {
            Some(draw_direction(MAZE.exits(self.place), rng))
        } else {
            match self.mode {
                Mode::Wander => Some(self.wander(rng)),
                Mode::Follow if self.place == agent => None,
                Mode::Follow => self.best_move(|place| -i32::from(MAZE.distance(place, agent))),
                Mode::Avoid => self.best_move(|place| MAZE.distance(place, agent).into()),
            }
        };
        if let Some(direction) = direction {
            self.place = MAZE.next(self.place, direction);
            self.heading = Some(direction);
        }
    }

    fn wander(&self, rng: &mut impl Rng) -> Direction {
        let open = MAZE.exits(self.place);
        let back = self.heading.map_or(0, |heading| 1 << (heading ^ 1));
        let onward = open & !back;
        draw_direction(if onward == 0 { open } else { onward }, rng)
    }

    /// Returns the open direction with the highest score; of equals, the first in the order up, down, left, right.
    fn best_move(&self, score: impl Fn(Place) -> i32) -> Option<Direction> {
        (0..DIRECTIONS as Direction)
            .rev()
            .filter(|d| MAZE.exits(self.place) >> d & 1 == 1)
            .max_by_key(|&d| score(MAZE.next(self.place, d)))
    }
}

/// The paper's three behaviours: out of sight wander; in sight follow, or avoid an agent with a boost.
fn wanted_mode(visible: bool, boosted: bool) -> Mode {
    match (visible, boosted) {
        (false, _) => Mode::Wander,
        (true, false) => Mode::Follow,
        (true, true) => Mode::Avoid,
    }
}

/// A uniform draw among the directions whose bit is set in `open`, which must not be 0.
fn draw_direction(open: u8, rng: &mut impl Rng) -> Direction {
    let mut remaining = open;
    for _ in 0..rng.random_range(0..open.count_ones()) {
        remaining &= remaining - 1;
    }
    remaining.trailing_zeros() as Direction
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::worlds::pacman::tests::config;

    fn chance(epsilon: f64, switch_probability: f64) -> PacmanConfig {
        PacmanConfig {
            epsilon,
            switch_probability,
            ..config()
        }
    }

    #[test]
    fn followers_close_in_and_avoiders_do_not() {
        let (mut rng, certain) = (ChaCha8Rng::seed_from_u64(1), chance(0.0, 1.0));
        for place in MAZE.places() {
            let is_seen = |agent: &Place| *agent != place && MAZE.in_sight(place, *agent);
            for agent in MAZE.places().filter(is_seen) {
                let (mut follower, mut avoider) = (Ghost::at(place), Ghost::at(place));
                follower.step(&certain, agent, false, &mut rng);
                avoider.step(&certain, agent, true, &mut rng);
                assert_eq!((follower.mode, avoider.mode), (Mode::Follow, Mode::Avoid));
                let closer = MAZE.distance(place, agent) - 1;
                assert_eq!(MAZE.distance(follower.place, agent), closer);
                let furthest = (0..4).map(|d| MAZE.next(place, d)).filter(|&p| p != place);
                let furthest = furthest.map(|p| MAZE.distance(p, agent)).max().unwrap();
                assert_eq!(MAZE.distance(avoider.place, agent), furthest);
            }
        }
    }

    #[test]
    fn a_follower_that_lost_sight_continues_until_it_changes_over() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut ghost = Ghost {
            mode: Mode::Follow,
            ..Ghost::at(MAZE.ghost_starts[2])
        };
        let agent = 0;
        assert!(!MAZE.in_sight(ghost.place, agent));
        for _ in 0..MAZE.distance(ghost.place, agent) {
            ghost.step(&chance(0.0, 0.0), agent, false, &mut rng);
        }
        assert_eq!((ghost.place, ghost.mode), (agent, Mode::Follow));
        let far = MAZE.ghost_starts[2];
        ghost.step(&chance(0.0, 1.0), far, false, &mut rng);
        assert_eq!(ghost.mode, Mode::Wander);
    }

    #[test]
    fn modes_change_over_with_the_given_probability() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let start = Ghost::at(MAZE.agent_start);
        let (trials, p) = (20_000, 0.3);
        let changed = (0..trials)
            .filter(|_| {
                let mut ghost = start;
                ghost.step(&chance(0.0, p), start.place, false, &mut rng);
                ghost.mode == Mode::Follow
            })
            .count() as f64;
        let expected = f64::from(trials) * p;
        let off = (changed - expected) / (expected * (1.0 - p)).sqrt();
        assert!(off.abs() < 4.0, "{changed} of {trials}");
    }

    /// At epsilon 1 every open direction is equally likely, even back, whatever the mode.
    #[test]
    fn random_moves_are_uniform() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let crossing = MAZE.places().find(|&p| MAZE.exits(p) == 0b1111).unwrap();
        let mut counts = [0i32; 4];
        for _ in 0..40_000 {
            let mut ghost = Ghost {
                mode: Mode::Follow,
                heading: Some(1),
                ..Ghost::at(crossing)
            };
            ghost.step(&chance(1.0, 0.0), 0, false, &mut rng);
            counts[usize::from(ghost.heading.unwrap())] += 1;
        }
        let squares = counts.map(|count| f64::from(count - 10_000).powi(2));
        let chi = squares.iter().sum::<f64>() / 10_000.0;
        // On 3 degrees of freedom, p = 0.001.
        assert!(chi < 16.3, "chi-square {chi}");
    }

    #[test]
    fn wanderers_turn_back_only_in_dead_ends() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut ghost = Ghost::at(MAZE.ghost_starts[1]);
        let mut visited = std::collections::BTreeSet::new();
        for _ in 0..20_000 {
            let before = ghost;
            ghost.step(&chance(0.0, 0.0), before.place, false, &mut rng);
            visited.insert(ghost.place);
            let back = before
                .heading
                .is_some_and(|heading| ghost.heading == Some(heading ^ 1));
            assert!(!back || MAZE.exits(before.place).count_ones() == 1);
        }
        // A wanderer gets everywhere.
        assert_eq!(visited.len(), MAZE.items.len());
    }
}
