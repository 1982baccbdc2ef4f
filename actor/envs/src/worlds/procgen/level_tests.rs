//! Tests of which levels are played one after the other. They fetch the engine once and are skipped with `DRIML_OFFLINE=1`.
//! Frames, rewards and ends are in `tests`.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::tests::{alone, config, draw, engine, step};
use super::*;

fn redraw(world: &mut ProcgenWorld, env: usize) {
    let levels = world.levels.as_mut().unwrap();
    levels.redraw(&mut world.game, env).unwrap();
}

#[test]
fn completed_levels_are_followed_by_levels_of_the_set() {
    let Some(_engine) = engine() else { return };
    for (game, start_level, num_levels) in [
        (Game::Leaper, 0, 500),
        (Game::Maze, 30, 7),
        (Game::Jumper, 900, 1),
    ] {
        let config = ProcgenConfig {
            start_level,
            num_levels,
            ..config(game)
        };
        let mut world = ProcgenWorld::new(&config, 16, 3, 0).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut changes = 0;
        for _ in 0..1000 {
            let (_, rewards, ends) = step(&mut world, &draw(&mut rng, 16));
            let set = start_level as i32..(start_level + num_levels) as i32;
            let mut levels = world.levels().iter();
            assert!(levels.all(|level| set.contains(level)), "{game}");
            for (end, reward) in ends.into_iter().zip(rewards) {
                if end == StepEnd::LevelChange {
                    changes += 1;
                    // The step that completed the level keeps its reward.
                    assert_eq!(reward, 10.0, "{game}");
                }
            }
        }
        assert!(changes > 10, "{game}: {changes} levels completed");
    }
}

/// A redrawn environment equals a fresh one of that level, also in the steps that follow, in every game.
#[test]
fn a_redrawn_level_is_the_level_itself() {
    let Some(engine) = engine() else { return };
    for game in Game::ALL {
        let config = config(game);
        let mut world = ProcgenWorld::new(&config, 3, 11, 0).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut last_move = 7;
        let mut draw = || {
            let actions = draw(&mut rng, 3);
            if actions[1] < 9 && actions[1] != 4 {
                last_move = actions[1];
            }
            (actions, last_move)
        };
        for round in 0..3 {
            let mut last_move = 7;
            for _ in 0..15 {
                let actions;
                (actions, last_move) = draw();
                step(&mut world, &actions);
            }
            let others = [0, 2].map(|env| world.game.state(env).unwrap());
            redraw(&mut world, 1);
            let unchanged = [0, 2].map(|env| world.game.state(env).unwrap());
            assert!(others == unchanged, "{game}");
            let mut alone = alone(engine, &config, world.levels()[1], last_move);
            let frame = |frames: &[u8]| frames[FRAME_BYTES..2 * FRAME_BYTES].to_vec();
            let at = format!("{game}, round {round}");
            assert!(frame(world.game.frames()) == alone.frames(), "{at}");
            for t in 0..40 {
                let (actions, _) = draw();
                let (frames, rewards, ends) = step(&mut world, &actions);
                alone.act(&[i32::from(actions[1])]).unwrap();
                assert_eq!(rewards[1], alone.rewards()[0], "{at}, step {t}");
                if ends[1] != StepEnd::Running {
                    break;
                }
                assert!(frame(&frames) == alone.frames(), "{at}, step {t}");
            }
        }
    }
}

/// Levels have no order: whichever was played, each level of the set is as likely to be the next.
#[test]
fn redrawn_levels_are_uniform_over_the_set_after_each_level() {
    let Some(_engine) = engine() else { return };
    let config = ProcgenConfig {
        num_levels: 5,
        ..config(Game::Maze)
    };
    let mut world = ProcgenWorld::new(&config, 1, 17, 0).unwrap();
    let mut counts = [[0.0; 5]; 5];
    for _ in 0..2500 {
        let before = world.levels()[0] as usize;
        redraw(&mut world, 0);
        counts[before][world.levels()[0] as usize] += 1.0;
    }
    let chi_square_of = |row: &[f64; 5]| {
        let expected = row.iter().sum::<f64>() / 5.0;
        let terms = row.iter().map(|count| (count - expected).powi(2));
        terms.sum::<f64>() / expected
    };
    let chi_square: f64 = counts.iter().map(chi_square_of).sum();
    // The 99.9 % quantile of chi-square with 20 degrees of freedom.
    assert!(chi_square < 45.31, "{chi_square}, counts {counts:?}");
}
