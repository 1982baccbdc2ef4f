//! Tests of settings and saved states of Ms. PacMan: what is read back, and what is refused.
//! The rules of the game are in `tests`.

use super::tests::config;
use super::*;
use crate::environment::Environment;
use crate::playing::fails;

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

#[test]
fn unusable_settings_are_errors() {
    let changes: [fn(&mut PacmanConfig); 10] = [
        |it| it.epsilon = 1.1,
        |it| it.epsilon = f64::NAN,
        |it| it.switch_probability = -0.1,
        |it| it.step_limit = 0,
        |it| it.reward_ghost = f32::INFINITY,
        |it| it.lethal_schedule = schedule(0, &[0]),
        |it| it.lethal_schedule = schedule(1, &[]),
        |it| it.lethal_schedule = schedule(1, &[4]),
        |it| it.ising = overlay(0.0, 1),
        |it| it.ising = overlay(0.4, 0),
    ];
    for change in changes {
        let mut bad = config();
        change(&mut bad);
        let error = fails(PacmanWorld::new(&bad, 1, 0), &[]);
        let words = ["must", "0 to 3"];
        assert!(words.iter().any(|it| error.contains(it)), "{error}");
    }
}

#[test]
fn a_game_continues_where_it_was_saved() {
    use crate::saved::tests::continues;

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
        assert!(continues("Ms. PacMan", 100, make) > 3);
    }
}

#[test]
fn a_state_that_no_game_has_is_refused() {
    let refuse = |what: &str, change: fn(&mut Game)| {
        let mut wrong = PacmanWorld::new(&config(), 1, 5).unwrap().envs.remove(0);
        change(&mut wrong.game);
        fails(wrong.game.check(), &[what]);
    };
    refuse("the agent's place", |game| game.agent = 10_000);
    refuse("a ghost's place", |game| game.ghosts[2].heading = Some(4));
    refuse("the food", |game| game.pellets_left += 1);
    refuse("the food", |game| game.items.clear());
    refuse("a frame", |game| game.background.clear());
}
