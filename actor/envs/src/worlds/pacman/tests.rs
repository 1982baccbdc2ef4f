//! The rules of Ms. PacMan, checked on games put into chosen situations; which settings and saved states are rejected.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::ghost::{Ghost, Mode};
use super::maze::{Item, tests::at};
use super::*;
use crate::environment::Environment;
use crate::playing::{self, fails, frames, play};
use crate::saved::tests::check_restore;

pub(crate) fn config() -> PacmanConfig {
    PacmanConfig {
        epsilon: 0.1,
        switch_probability: 0.5,
        lethal: [true; 4],
        lethal_schedule: None,
        boost_steps: 10,
        step_limit: 500,
        reward_pellet: 1.0,
        reward_boost: 5.0,
        reward_ghost: 20.0,
        reward_death: -100.0,
        reward_cleared: 1000.0,
        ising: None,
    }
}

fn harmless() -> PacmanConfig {
    PacmanConfig {
        lethal: [false; 4],
        ..config()
    }
}

fn schedule(episodes_per_task: u64, order: &[u8]) -> Option<LethalSchedule> {
    Some(LethalSchedule {
        episodes_per_task,
        order: order.to_vec(),
    })
}

fn overlay(temperature: f64, sweeps_per_step: u32) -> Option<IsingOverlay> {
    Some(IsingOverlay {
        temperature,
        sweeps_per_step,
    })
}

fn step(world: &mut PacmanWorld, action: u8) -> (f32, StepEnd) {
    let (rewards, ends) = playing::step(world, &[action]);
    (rewards[0], ends[0])
}

/// The bottom corridor, agent in column 9 and ghost 0 `apart` to the right, sure to come closer; the rest far away.
fn duel(config: &PacmanConfig, apart: usize) -> PacmanWorld {
    // Ghosts keep to the mode they are put into.
    let steady = PacmanConfig {
        epsilon: 0.0,
        switch_probability: 0.0,
        ..config.clone()
    };
    let mut world = PacmanWorld::new(&steady, 1, 0).unwrap();
    let (agent, hunter, far) = (at(19, 9), at(19, 9 + apart), at(1, 1));
    let game = &mut world.envs[0].game;
    game.agent = agent;
    game.ghosts = [hunter, far, far, far].map(Ghost::at);
    game.ghosts[0].mode = Mode::Follow;
    world
}

#[test]
fn the_first_frame_shows_everything() {
    let mut world = PacmanWorld::new(&config(), 1, 0).unwrap();
    let frame = frames(&mut world);
    let count = |colour: render::Colour| frame.chunks_exact(3).filter(|&p| p == colour).count();
    let counts = [render::AGENT, render::PELLET, render::BOOST].map(count);
    assert_eq!(counts, [1, 187, 4]);
    assert_eq!(render::GHOST_COLOURS.map(count), [1; 4]);
    assert_eq!(count(render::WALL), 21 * 19 - 196);
}

#[test]
fn a_wall_stops_the_agent_and_a_no_op_keeps_it() {
    let mut world = duel(&harmless(), 3);
    let before = world.envs[0].game.agent;
    for action in [0, 2] {
        step(&mut world, action);
        assert_eq!(world.envs[0].game.agent, before);
    }
    step(&mut world, 3);
    assert_eq!(world.envs[0].game.agent, at(19, 8));
}

#[test]
fn food_is_eaten_once() {
    let mut world = duel(&harmless(), 3);
    assert_eq!(step(&mut world, 3).0, 1.0);
    assert_eq!(world.envs[0].game.pellets_left, 186);
    // The agent eats the pellet on which it was put.
    assert_eq!(step(&mut world, 4).0, 1.0);
    assert_eq!(step(&mut world, 3).0, 0.0);
    let pixel = MAZE.pixel(at(19, 9));
    let found = &world.envs[0].game.background[pixel * 3..][..3];
    assert_eq!(found, render::FLOOR);
}

#[test]
fn contact_with_a_lethal_ghost_ends_the_episode() {
    for (apart, action) in [
        // The agent waits: the ghost steps onto it.
        (1, 0),
        // The agent walks at the ghost: they change places, which counts.
        (1, 4),
        // Both go to the middle.
        (2, 4),
    ] {
        let seen = step(&mut duel(&config(), apart), action);
        assert_eq!(seen, (1.0 - 100.0, StepEnd::Terminal), "{apart} {action}");
    }
    // 1 apart, agent flees: the ghost is where the agent was, and no contact.
    assert_eq!(step(&mut duel(&config(), 1), 3), (1.0, StepEnd::Running));
}

#[test]
fn the_game_starts_again_after_an_end() {
    let mut world = duel(&config(), 1);
    let start = frames(&mut PacmanWorld::new(&config(), 1, 0).unwrap());
    assert_ne!(frames(&mut world), start);
    assert_eq!(step(&mut world, 0).1, StepEnd::Terminal);
    assert_eq!(frames(&mut world), start);
    let game = &world.envs[0].game;
    assert_eq!((game.pellets_left, game.episode_step), (187, 0));
}

#[test]
fn contact_with_a_harmless_ghost_is_nothing() {
    let lethal = [false, true, true, true];
    let mut world = duel(&PacmanConfig { lethal, ..config() }, 1);
    assert_eq!(step(&mut world, 0), (1.0, StepEnd::Running));
    assert_eq!(world.envs[0].game.ghosts[0].place, world.envs[0].game.agent);
    // The harmless ghost stays in contact, and still does nothing.
    assert_eq!(step(&mut world, 0), (0.0, StepEnd::Running));
}

#[test]
fn a_boosted_agent_destroys_ghosts_and_only_lethal_ones_pay() {
    for (lethal, reward) in [([true; 4], 1.0 + 20.0), ([false, true, true, true], 1.0)] {
        let mut world = duel(&PacmanConfig { lethal, ..config() }, 1);
        world.envs[0].game.boost_left = 5;
        assert_eq!(step(&mut world, 0), (reward, StepEnd::Running));
        // Back at its start, wandering.
        let home = Ghost::at(MAZE.ghost_starts[0]);
        assert_eq!(world.envs[0].game.ghosts[0], home);
    }
}

#[test]
fn a_boost_protects_in_its_own_step_and_the_next_ten() {
    let mut world = duel(&config(), 1);
    let (boost, beside) = (at(1, 1), at(1, 2));
    let away = at(19, 9);
    let game = &mut world.envs[0].game;
    game.agent = beside;
    game.ghosts = [boost, away, away, away].map(Ghost::at);
    game.ghosts[0].mode = Mode::Follow;
    // The boost counts in the step in which it is taken.
    assert_eq!(step(&mut world, 3), (5.0 + 20.0, StepEnd::Running));
    assert_eq!(world.envs[0].game.pellets_left, MAZE.pellets);
    let pixel = MAZE.pixel(boost) * 3;
    for after in 1..=11 {
        let (colour, expected) = match after {
            11 => (render::AGENT, (-100.0, StepEnd::Terminal)),
            _ => (render::AGENT_BOOSTED, (20.0, StepEnd::Running)),
        };
        assert_eq!(frames(&mut world)[pixel..][..3], colour, "{after}");
        let ghost = &mut world.envs[0].game.ghosts[0];
        *ghost = Ghost::at(beside);
        ghost.mode = Mode::Follow;
        assert_eq!(step(&mut world, 0), expected, "{after}");
    }
}

#[test]
fn the_last_pellet_ends_the_episode_before_any_contact() {
    let mut world = duel(&config(), 1);
    let game = &mut world.envs[0].game;
    game.items.fill(Item::Nothing);
    game.items[usize::from(at(19, 10))] = Item::Pellet;
    game.pellets_left = 1;
    assert_eq!(step(&mut world, 4), (1.0 + 1000.0, StepEnd::Terminal));
}

#[test]
fn episodes_are_cut_off_at_the_step_limit() {
    let config = PacmanConfig {
        step_limit: 7,
        ..harmless()
    };
    let mut world = PacmanWorld::new(&config, 1, 6).unwrap();
    let seen = play(&mut world, 21, &mut ChaCha8Rng::seed_from_u64(1));
    for (t, (.., ends)) in seen.into_iter().enumerate() {
        let end = match t % 7 {
            6 => StepEnd::TimedOut,
            _ => StepEnd::Running,
        };
        assert_eq!(ends, [end], "step {t}");
    }
}

#[test]
fn the_lethal_ghost_changes_by_the_schedule() {
    let config = PacmanConfig {
        step_limit: 1,
        lethal_schedule: schedule(2, &[0, 2, 3]),
        ..config()
    };
    let mut world = PacmanWorld::new(&config, 1, 7).unwrap();
    for ghost in [0, 0, 2, 2, 3, 3, 0, 0] {
        let lethal = std::array::from_fn(|g| g == ghost);
        assert_eq!(world.envs[0].game.lethal, lethal);
        assert_eq!(step(&mut world, 0).1, StepEnd::TimedOut);
    }
}

#[test]
fn the_overlay_changes_walls_only_and_starts_afresh_in_each_episode() {
    let seen = |ising| {
        let config = PacmanConfig {
            ising,
            step_limit: 40,
            ..config()
        };
        let mut world = PacmanWorld::new(&config, 1, 8).unwrap();
        play(&mut world, 400, &mut ChaCha8Rng::seed_from_u64(2))
    };
    let (mut starts, mut is_start) = (vec![], true);
    let both = seen(overlay(0.4, 1)).into_iter().zip(seen(None));
    for ((a, rewards, ends), (b, bare_rewards, _)) in both {
        assert_eq!(rewards, bare_rewards);
        let mut fuchsia = 0;
        for (a, b) in a.chunks_exact(3).zip(b.chunks_exact(3)) {
            if b == render::WALL {
                assert!(a == render::WALL || a == render::FUCHSIA);
                fuchsia += i32::from(a == render::FUCHSIA);
            } else {
                assert_eq!(a, b);
            }
        }
        if is_start {
            // Half of 203 walls, more or less.
            assert!((60..140).contains(&fuchsia), "{fuchsia}");
            starts.push(a);
        }
        is_start = ends[0] != StepEnd::Running;
    }
    // Each episode starts with other spins.
    assert!(starts.windows(2).all(|pair| pair[0] != pair[1]));
}

#[test]
fn a_game_continues_where_it_was_saved() {
    let schedule = schedule(1, &[0, 1, 2, 3]);
    for (ising, lethal_schedule) in [(None, None), (overlay(2.0, 1), schedule)] {
        let config = PacmanConfig {
            ising,
            lethal_schedule,
            step_limit: 40,
            ..config()
        };
        let make =
            || -> Box<dyn Environment> { Box::new(PacmanWorld::new(&config, 3, 5).unwrap()) };
        assert!(check_restore("Ms. PacMan", 100, make) > 3);
    }
}

#[test]
fn a_state_that_no_game_has_is_refused() {
    let refuse = |what: &str, change: fn(&mut Game)| {
        let mut wrong = PacmanWorld::new(&config(), 1, 5).unwrap().envs.remove(0);
        change(&mut wrong.game);
        fails(wrong.game.check_state(), &[what]);
    };
    refuse("the agent's place", |game| game.agent = 10_000);
    refuse("a ghost's place", |game| game.ghosts[2].heading = Some(4));
    refuse("the food", |game| game.pellets_left += 1);
    refuse("the food", |game| game.items.clear());
    refuse("a frame", |game| game.background.clear());
}
