//! Tests the names of worlds, reading their settings, and what settings tell of a world before it is built.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::environment::{Environment, FrameShape, StepEnd};
use crate::playing::{fails, frames, step};
use crate::plugin::CustomKind;
use crate::worlds::{chain, exec, ising, pacman, procgen};

#[test]
fn names_go_there_and_back() {
    for name in WorldName::all() {
        assert_eq!(name.to_string().parse(), Ok(name));
        assert_eq!(name.foreign_code(), None, "{name}");
    }
}

#[test]
fn names_may_hold_a_person_s_own_code() {
    let command = "python3 my world.py --at 'a:b'";
    let name: WorldName = format!("exec:{command}").parse().unwrap();
    assert_eq!(name.to_string(), format!("exec:{command}"));
    assert_eq!(name.foreign_code(), Some(command));
    let found: Vec<_> = name.settings().collect();
    assert_eq!((name.kind(), found), ("exec", vec![("command", command)]));

    let text = "libenv:/builds/a:b/libenv.so:coinrun";
    let name: WorldName = text.parse().unwrap();
    assert_eq!(name.to_string(), text);
    assert_eq!(name.kind(), "procgen");
    assert_eq!(name.foreign_code(), Some("/builds/a:b/libenv.so"));
    let found: Vec<_> = name.settings().collect();
    let library = ("library", "/builds/a:b/libenv.so");
    assert_eq!(found, [("game", "coinrun"), library]);
    assert_eq!(name.without_library(), "procgen:coinrun".parse().unwrap());
    for wrong in [
        "exec:",
        "exec: ",
        "libenv:coinrun",
        "libenv::coinrun",
        "libenv:/a.so:pong",
    ] {
        assert!(wrong.parse::<WorldName>().is_err(), "{wrong}");
    }
}

#[test]
fn a_machine_s_own_code_is_that_of_the_same_world() {
    let [exec, chain, ..] = configs();
    let other = "exec:somewhere/else".parse().unwrap();
    let here = exec.with_code_of(other).unwrap();
    assert_eq!(here.name(), other);
    assert_eq!(here.action_names(), exec.action_names());
    assert_eq!(chain.with_code_of(chain.name()).unwrap(), chain);
    let coinrun = procgen(0, 500);
    let build = "libenv:/builds/libenv.so:coinrun".parse().unwrap();
    assert_eq!(coinrun.with_code_of(build).unwrap().name(), build);
    for (world, name) in [
        (&exec, "chain"),
        (&chain, "exec:somewhere/else"),
        (&coinrun, "libenv:/builds/libenv.so:maze"),
    ] {
        fails(world.with_code_of(name.parse().unwrap()), &["and not"]);
    }
}

#[test]
fn a_world_that_a_program_adds_is_as_the_others() {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Flat {
        reward: f32,
    }
    impl WorldSettings for Flat {
        fn validate(&self) -> Result<(), EnvError> {
            Ok(())
        }
        fn frame_shape(&self) -> FrameShape {
            FrameShape::new(self.reward as usize, 2, 1)
        }
        fn action_names(&self) -> Vec<&str> {
            vec!["only"]
        }
        fn build(&self, _: usize, _: u64, _: usize) -> Result<Box<dyn Environment>, EnvError> {
            Err(EnvError::Config("flat".into()))
        }
    }
    let text = "kind = 'flat'\nreward = 3.5\n";
    assert!(toml::from_str::<WorldConfig>(text).is_err());
    // A registered kind does not replace this crate's world of the same name.
    let kinds = ["flat", "chain"].map(|name| CustomKind::new::<Flat>(name, "# preset"));
    plugin::register(kinds.into());
    let config: WorldConfig = toml::from_str(text).unwrap();
    assert_eq!(config.name(), "flat".parse().unwrap());
    assert_eq!(config.frame_shape().height, 3);
    assert!(config.validate().is_ok() && config.build(1, 1, 0).is_err());
    check_round_trip(&config);
    assert!(config.with_single_levels().is_err());
    assert_eq!(plugin::preset("flat"), Some("# preset"));
    let wrong = text.replace("3.5", "3.5\ncolour = 1");
    fails(toml::from_str::<WorldConfig>(&wrong), &["colour"]);
    assert!(WorldName::all().any(|name| name.to_string() == "flat"));
    let [_, chain, ..] = configs();
    check_round_trip(&chain);
}

/// Checks that settings that are written are read back unchanged.
fn check_round_trip(config: &WorldConfig) {
    let text = toml::to_string(config).unwrap();
    assert_eq!(&toml::from_str::<WorldConfig>(&text).unwrap(), config);
}

#[test]
fn settings_are_read_by_kind_and_unknown_keys_are_rejected() {
    let chain = "kind = 'chain'\ncells = 8\nheight = 12\nwidth = 12\nstep_limit = 30\nreward_left = 0.1\nreward_right = 1\n";
    let config: WorldConfig = toml::from_str(chain).unwrap();
    assert_eq!(config.name(), "chain".parse().unwrap());
    check_round_trip(&config);

    let pacman = "kind = 'mspacman'\nepsilon = 0\nswitch_probability = 0.5\nlethal = [true, false, false, false]\n\
        boost_steps = 10\nstep_limit = 500\nreward_pellet = 1\nreward_boost = 0\nreward_ghost = 5\n\
        reward_death = -10\nreward_cleared = 50\nlethal_schedule = { episodes_per_task = 10, order = [0, 1] }\n\
        ising = { temperature = 0.4, sweeps_per_step = 1 }\n";
    let config: WorldConfig = toml::from_str(pacman).unwrap();
    assert_eq!(config.name(), "mspacman".parse().unwrap());
    check_round_trip(&config);

    let config = procgen(0, 500);
    check_round_trip(&config);
    let coinrun = toml::to_string(&config).unwrap();
    for line in ["game = \"coinrun\"", "distribution_mode = \"easy\""] {
        assert!(coinrun.lines().any(|it| it == line), "{coinrun}");
    }

    let no_count = "missing field `num_levels`";
    for (wrong, word) in [
        (coinrun.replace("num_levels = 500\n", ""), no_count),
        (format!("{coinrun}\nlevels = 1"), "unknown field `levels`"),
        (coinrun.replace("coinrun", "coinrum"), "variant `coinrum`"),
        (coinrun.replace("\"easy\"", "\"medium\""), "medium"),
        (format!("{chain}colour = 1"), "colour"),
        (chain.replace("cells = 8\n", ""), "cells"),
        (chain.replace("'chain'", "'chian'"), "chian"),
        (pacman.replace("order", "ordre"), "ordre"),
    ] {
        fails(toml::from_str::<WorldConfig>(&wrong), &[word]);
    }
}

/// Settings of each world that needs no engine.
fn configs() -> [WorldConfig; 4] {
    let numbered = exec::tests::numbered("");
    [
        WorldConfig::Exec(exec::tests::config(numbered)),
        WorldConfig::Chain(chain::tests::config()),
        WorldConfig::Ising(ising::tests::paper_config()),
        WorldConfig::MsPacman(pacman::tests::config()),
    ]
}

#[test]
fn a_world_of_wrong_settings_is_not_built() {
    let mut config = ising::tests::paper_config();
    config.patch_size = 2;
    fails(WorldConfig::Ising(config).build(1, 1, 0), &["patch_size"]);
}

#[test]
fn a_built_world_is_as_its_settings_say_and_rejects_wrong_buffers_and_actions() {
    let count = KIND_NAMES.len();
    assert_eq!(configs().len() + 1, count, "`configs` lacks a new world");
    let with_engine = procgen::tests::engine().map(|_| procgen(0, 500));
    for config in configs().into_iter().chain(with_engine) {
        assert!(config.build(0, 1, 0).is_err());
        let mut world = config.build(2, 1, 0).unwrap();
        assert_eq!(world.num_envs(), 2);
        assert_eq!(world.frame_shape(), config.frame_shape());
        assert_eq!(world.num_actions(), config.num_actions());
        frames(&mut *world);
        let (mut rewards, mut ends) = ([0.0; 2], [Default::default(); 2]);
        let few = "actions has 1 entries, but the world has 2 environments";
        fails(world.step(&[0], &mut rewards, &mut ends), &[few]);
        assert!(world.step(&[0; 2], &mut rewards[..1], &mut ends).is_err());
        assert!(world.step(&[0; 2], &mut rewards, &mut ends[..1]).is_err());
        let actions = world.num_actions();
        let unknown = format!(
            "action {actions} of environment 1 is out of range: this world has {actions} actions"
        );
        let stepped = world.step(&[0, actions as u8], &mut rewards, &mut ends);
        fails(stepped, &[&unknown]);
    }
}

#[test]
fn an_environment_depends_on_seed_and_index_only() {
    let [_, _, ising, pacman] = configs();
    for (config, steps) in [(ising, 20), (pacman, 2_000)] {
        let played = |num_envs, seed| {
            let mut world = config.build(num_envs, seed, 0).unwrap();
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let mut take_step = || {
                // The same action in every environment, so that environments differ by their generators alone.
                let actions = vec![rng.random_range(0..config.num_actions() as u8); num_envs];
                (frames(&mut *world), step(&mut *world, &actions))
            };
            (0..steps).map(|_| take_step()).collect::<Vec<_>>()
        };
        let (one, three) = (played(1, 3), played(3, 3));
        assert!(one == played(1, 3));
        assert!(one != played(1, 4), "seeds differ");
        let ended = |ends: &[StepEnd]| ends[0] != StepEnd::Running;
        assert!(one.iter().any(|(_, (_, ends))| ended(ends)));
        let bytes = config.frame_shape().bytes();
        let mut frames = one.iter().zip(&three);
        assert!(frames.all(|((one, _), (three, _))| one[..] == three[..bytes]));
        let mut frames = three.iter().map(|(frames, _)| frames.split_at(bytes));
        assert!(frames.any(|(first, rest)| first[..] != rest[..bytes]));
    }
}

fn procgen(start_level: u32, num_levels: u32) -> WorldConfig {
    WorldConfig::Procgen(ProcgenConfig {
        num_levels,
        start_level,
        ..procgen::tests::config(procgen_sys::Game::Coinrun)
    })
}

#[test]
fn unseen_levels_are_none_of_those_trained_on() {
    for (start, count) in [(0, 500), (70, 1), (1000, 200)] {
        let world = procgen(start, count);
        let levels = [world.with_single_levels(), world.with_unseen_levels()];
        let [single, unseen] = levels.map(|world| match world {
            Ok(WorldConfig::Procgen(it)) if !it.use_sequential_levels => it,
            other => panic!("{other:?}"),
        });
        assert_eq!((single.start_level, single.num_levels), (start, count));
        assert!(unseen.start_level >= start + count, "{unseen:?}");
        assert_eq!(unseen.num_levels, 100_000);
    }
}

#[test]
fn levels_that_a_world_does_not_have_are_refused() {
    fails(procgen(0, 0).with_unseen_levels(), &["none is unseen"]);
    let [_, chain, ..] = configs();
    for wrong in [chain.with_single_levels(), chain.with_unseen_levels()] {
        fails(wrong, &["has no levels"]);
    }
}
