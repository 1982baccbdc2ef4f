//! Checks what the real engine does, call by call: the facts on which `driml-envs` builds its worlds.
//! The engine is fetched into the cache folder once; with `DRIML_OFFLINE=1` every test that needs it is skipped.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::{io::Write, sync::OnceLock};

use procgen_sys::{
    DistributionMode, Engine, Game, NUM_ACTIONS, NUM_ENVS_MAX, Options, State, VecGame,
};

/// The installed engine, or a line that says the test was skipped.
fn engine() -> Option<&'static Engine> {
    static ENGINE: OnceLock<Engine> = OnceLock::new();
    if std::env::var_os("DRIML_OFFLINE").is_some_and(|it| !it.is_empty() && it != "0") {
        let test = std::thread::current();
        // Bypasses the test runner, which hides the output of a test that passes.
        let line = format!(
            "skipped: {} (DRIML_OFFLINE=1)\n",
            test.name().unwrap_or("?")
        );
        std::io::stderr().write_all(line.as_bytes()).unwrap();
        return None;
    }
    Some(ENGINE.get_or_init(|| Engine::install(&mut |line| println!("{line}")).unwrap()))
}

fn options(game: Game) -> Options {
    Options {
        game,
        num_envs: 4,
        num_levels: 500,
        start_level: 0,
        rand_seed: 7,
        num_threads: 0,
        distribution_mode: DistributionMode::Easy,
        use_sequential_levels: false,
        paint_vel_info: true,
        use_backgrounds: true,
        center_agent: true,
        restrict_themes: false,
    }
}

/// The actions of step `t`: a fixed pseudo-random sequence (Knuth's multiplicative hash).
fn actions(t: usize, num_envs: usize) -> Vec<i32> {
    let draw = |env: usize| ((t * 64 + env + 1) as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
    (0..num_envs)
        .map(|env| (draw(env) % NUM_ACTIONS as u64) as i32)
        .collect()
}

#[test]
fn what_would_end_the_process_is_rejected_with_the_value() {
    options(Game::Coinrun).validate().unwrap();
    let rejected = |change: fn(&mut Options), text: &str| {
        let mut options = options(Game::Coinrun);
        change(&mut options);
        let error = options.validate().unwrap_err().to_string();
        assert!(error.contains(text), "{error}");
    };
    rejected(|o| o.num_envs = 0, "0 environments");
    rejected(|o| o.num_envs = NUM_ENVS_MAX + 1, "4097 environments");
    rejected(|o| o.num_threads = 1000, "1000 threads");
    rejected(|o| o.num_levels = -1, "num_levels = -1");
    rejected(|o| o.start_level = -1, "start_level = -1");
    rejected(|o| o.start_level = i32::MAX, "past the last level");
    rejected(|o| (o.num_levels, o.start_level) = (0, 7), "no effect");
    let extreme = "coinrun has no distribution mode \"extreme\"; easy and hard work, and these games have that one: \
        chaser, dodgeball, leaper, starpilot";
    rejected(|o| o.distribution_mode = DistributionMode::Extreme, extreme);
    let memory = "caveflyer, dodgeball, heist, jumper, maze, miner";
    rejected(|o| o.distribution_mode = DistributionMode::Memory, memory);
}

#[test]
fn wrong_actions_are_refused_and_step_nothing() {
    let Some(engine) = engine() else { return };
    let mut envs = VecGame::new(engine, &options(Game::Coinrun)).unwrap();
    let before = envs.state(0).unwrap();
    for (actions, words) in [
        (&[0, 0, 15, 0][..], "action 15 for environment 2 of coinrun"),
        (&[0, 0, 0, -2], "action -2 for environment 3"),
        (&[0; 3], "3 actions for 4 environments"),
    ] {
        let error = envs.act(actions).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    }
    assert_eq!(envs.state(0).unwrap(), before);
}

#[test]
fn a_state_of_another_game_or_of_no_environment_is_refused() {
    let Some(engine) = engine() else { return };
    let mut coinrun = VecGame::new(engine, &options(Game::Coinrun)).unwrap();
    let mut maze = VecGame::new(engine, &options(Game::Maze)).unwrap();
    let state = maze.state(0).unwrap();
    let error = coinrun.set_state(0, &state).unwrap_err().to_string();
    assert!(error.contains("a state of maze"), "{error}");
    let error = coinrun.state(4).unwrap_err().to_string();
    assert!(error.contains("environment 4 of 4"), "{error}");
}

/// `first` stays 0, the level's number goes up by 997, and so leaves a set of 500 levels at once.
#[test]
fn sequential_levels_leave_their_set_without_a_flag() {
    let Some(engine) = engine() else { return };
    for game in [Game::Leaper, Game::Jumper, Game::Maze] {
        let options = Options {
            num_envs: 16,
            use_sequential_levels: true,
            ..options(game)
        };
        let mut envs = VecGame::new(engine, &options).unwrap();
        let mut completed = 0;
        for t in 0..1000 {
            let before = envs.level_seed().to_vec();
            envs.act(&actions(t, 16)).unwrap();
            for (env, before) in before.into_iter().enumerate() {
                let (first, level) = (envs.first()[env], envs.level_seed()[env]);
                if envs.prev_level_complete()[env] == 1 {
                    completed += 1;
                    assert_eq!((first, level), (0, before + 997), "{game}, step {t}");
                } else if first == 0 {
                    assert_eq!(level, before, "{game}, step {t}");
                } else {
                    assert!((0..500).contains(&level), "{game}, step {t}");
                }
            }
        }
        assert!(completed > 0, "{game}: no level was completed");
    }
}

/// `timeout` and `cur_time` in a state: after version and name come 17 numbers, two generators (a flag and a text
/// each), 5 numbers, `timeout`, 8 numbers and `cur_time`. Source: `Game::serialize` in `procgen/src/game.cpp`.
fn time_limit_and_time(state: &State) -> (i32, i32) {
    let bytes = state.bytes();
    let int = |at: usize| i32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let after_text = |at: usize| at + 4 + usize::try_from(int(at)).unwrap();
    let mut at = after_text(4) + 17 * 4;
    for _ in 0..2 {
        at = after_text(at + 4);
    }
    // Skips reward, done and complete; and action.
    at += 4 * 4;
    (int(at), int(at + 9 * 4))
}

/// `Game::time_limit_steps` returns the engine's limits, in every mode of every game.
#[test]
fn time_limits_are_the_engines() {
    let Some(engine) = engine() else { return };
    use DistributionMode::{Easy, Extreme, Hard, Memory};
    for game in Game::ALL {
        let modes = [Easy, Hard, Extreme, Memory].into_iter();
        for mode in modes.filter(|mode| game.has_mode(*mode)) {
            let options = Options {
                num_envs: 1,
                distribution_mode: mode,
                ..options(game)
            };
            let mut envs = VecGame::new(engine, &options).unwrap();
            let limit = i32::try_from(game.time_limit_steps(mode)).unwrap();
            let first = time_limit_and_time(&envs.state(0).unwrap());
            envs.act(&[4]).unwrap();
            let second = time_limit_and_time(&envs.state(0).unwrap());
            let expected = [(limit, 0), (limit, 1)];
            assert_eq!([first, second], expected, "{game} {mode}");
        }
    }
}
