//! Presets, flags, `--set` and files: what they resolve to, and the errors of those that cannot work.
//! `tests/snapshots/refusals.txt` has the sentences.

use driml_envs::WorldConfig;
use driml_model::TorsoName;
use driml_protocol::{Horizon, Sampling};
use expect_test::{expect, expect_file};

use super::*;
use crate::presets::{AGENTS, PRESETS};

const MACHINE: Machine = Machine {
    cores: 2,
    memory_bytes: 16 << 30,
    fast_bf16: false,
};

fn source(preset: &str, world: &str, agent: &str) -> Source {
    let agent = presets::agent(agent).unwrap();
    let preset = presets::preset(preset).unwrap();
    Source::Layers(preset, world.parse().unwrap(), agent.name)
}

fn sets(sets: &[&str]) -> Flags {
    Flags {
        sets: sets.iter().map(|&set| set.into()).collect(),
        ..Flags::default()
    }
}

fn frames(frames: u64, set: &[&str]) -> Flags {
    Flags {
        frames: Some(frames),
        ..sets(set)
    }
}

fn of_file(name: &str, text: String, set: &[&str]) -> Result<RunConfig, String> {
    let file = Source::File(name.into(), text);
    resolve(&file, &sets(set), &MACHINE).map_err(|e| e.to_string())
}

fn with(world: &str, agent: &str, set: &[&str]) -> Result<RunConfig, String> {
    resolve(&source("paper", world, agent), &sets(set), &MACHINE).map_err(|e| e.to_string())
}

#[test]
fn every_preset_in_every_world_for_every_agent_resolves_and_reads_back() {
    let mut resolved = 0;
    for preset in PRESETS {
        for world in WorldName::all() {
            for agent in AGENTS {
                let source = Source::Layers(preset, world, agent.name);
                let config = match resolve(&source, &Flags::default(), &MACHINE) {
                    Ok(config) => config,
                    Err(e) if e.0.contains("take --preset paper") => continue,
                    Err(e) => panic!("{} {world} {}: {e}", preset.name, agent.name),
                };
                let text = config.to_toml();
                let again = of_file("config.toml", text.clone(), &[]).unwrap();
                assert_eq!(again.run.hash(), config.run.hash());
                assert_eq!(again.to_toml(), text);
                let mut read = RunConfig::parse("config.toml", &text).unwrap();
                assert_eq!(read.to_toml(), text);
                read.notes.clone_from(&config.notes);
                assert_eq!(read, config);
                driml_actor::ActorSettings::from_toml(&text).unwrap();
                resolved += 1;
            }
        }
    }
    // Five presets are for all worlds, three for Procgen's games.
    let all = WorldName::all().count();
    let is_game = |world: &WorldName| world.kind() == "procgen";
    let games = WorldName::all().filter(is_game).count();
    assert_eq!(resolved, (5 * all + 3 * games) * AGENTS.len());
}

#[test]
fn the_default_run_is_the_papers() {
    let config = with("procgen:bigfish", "driml-ada", &[]).unwrap();
    let table: Table = config.to_toml().parse().unwrap();
    expect![[r#"
        [actor]
        ack_timeout_ms = 10000
        actions = "all"
        chunks_in_flight_max = 4
        envs = 16
        epsilon_decay_frames = 100000
        epsilon_end = 0.01
        epsilon_start = 0.1
        precision = "f32"
        round_transitions_max = 1024
        steps_per_chunk = 16
        unreachable_max_ms = 300000
        world_threads = 0
    "#]]
    .assert_eq(&format!("[actor]\n{}", table["actor"].as_table().unwrap()));
    assert_eq!(config.model.dim.psi4, config.model.dim.phi4);
    assert!(!config.model.dim.psi3 && config.model.dim.action);
    // 199_000 transitions after the warm-up at 8 rows each, in batches of 256.
    assert_eq!(config.updates(), 6_218);
}

/// Frames are recorded and sent as far as the network reads them; settings of earlier versions have them whole, and stay as they are.
#[test]
fn frames_are_cut_where_nothing_reads_them() {
    let sizes = |config: &RunConfig| {
        let (run, model) = (&config.run, &config.model);
        let frame = (run.frame_height, run.frame_width);
        (frame, (model.height, model.width))
    };
    let cut = with("procgen:bigfish", "driml-ada", &[]).unwrap();
    assert_eq!(sizes(&cut), ((60, 60), (60, 60)));
    let large = source("paper-observation", "procgen:bigfish", "driml-ada");
    let large = resolve(&large, &sets(&[]), &MACHINE).unwrap();
    assert_eq!(sizes(&large), ((62, 61), (100, 76)));
    let pacman = with("mspacman", "driml-ada", &[]).unwrap();
    assert_eq!(sizes(&pacman), ((21, 19), (84, 84)));
    // A random crop reads all of a state.
    let augmented = with("procgen:bigfish", "curl", &[]).unwrap();
    assert_eq!(sizes(&augmented), ((64, 64), (64, 64)));

    let old = cut.with_whole_frames().unwrap();
    assert_eq!(sizes(&old), ((64, 64), (64, 64)));
    assert_eq!(old.run.seed, cut.run.seed);
    let text = old.to_toml();
    assert!(!text.contains("[input.frame]"), "{text}");
    assert_eq!(RunConfig::parse("old.toml", &text).unwrap(), old);
    let again = of_file("old.toml", text, &["run.seed=7"]).unwrap();
    assert_eq!((sizes(&again), again.run.seed), (sizes(&old), 7));
    let size = ["input.height=104", "input.width=80"];
    let again = of_file("new.toml", cut.to_toml(), &size).unwrap();
    assert_eq!(sizes(&again), sizes(&large));
    let wrong = cut
        .to_toml()
        .replace("frame_height = 60", "frame_height = 64");
    expect!["wrong.toml: run.frame_height = 64, but it follows from the world and what the torso reads and is 60; correct the one or the other"]
        .assert_eq(&RunConfig::parse("wrong.toml", &wrong).unwrap_err().to_string());
}

/// Everything that has an entry for each action follows from which actions there are.
#[test]
fn an_agent_may_choose_among_the_actions_that_differ_alone() {
    let visible = "actor.actions=visible";
    for (world, count) in [
        ("procgen:plunder", 4),
        ("procgen:maze", 5),
        ("procgen:coinrun", 9),
        ("procgen:starpilot", 15),
        ("mspacman", 5),
        ("chain", 3),
    ] {
        let config = with(world, "driml-ada", &[visible]).unwrap();
        assert_eq!(config.run.num_actions, count, "{world}");
        assert_eq!(config.model.num_actions, count as usize);
        assert_eq!(config.action_names().len(), count as usize);
        let read = RunConfig::parse("config.toml", &config.to_toml()).unwrap();
        assert_eq!(read, config);
        let both = [visible, "learner.affinity.alphabet=visible"];
        let merged = with(world, "driml-ada", &both).unwrap();
        let visible = merged.learner.affinity.visible.unwrap();
        assert_eq!(visible.len(), count as usize);
        let all = with(world, "driml-ada", &[]).unwrap();
        assert_eq!(all.run.num_actions as usize, all.world.num_actions());
        // Settings of earlier versions say nothing of it.
        let old = all.to_toml().replace("actions = \"all\"\n", "");
        assert_eq!(RunConfig::parse("old.toml", &old).unwrap(), all);
    }
    let names = with("procgen:plunder", "c51", &[visible]).unwrap();
    assert_eq!(names.action_names(), ["left", "no-op", "right", "d"]);
}

#[test]
fn settings_that_are_not_used_are_left_out() {
    let config = with("mspacman", "c51", &[]).unwrap();
    assert_eq!(config.run.horizon, Horizon::None);
    assert_eq!(config.model.dim, driml_model::DimHeads::NONE);
    assert_eq!(config.learner.affinity.learned, None);
    let curl = with("mspacman", "curl", &[]).unwrap();
    assert_eq!(curl.run.horizon, Horizon::None);
    let heads = driml_model::DimHeads {
        psi4: true,
        ..driml_model::DimHeads::NONE
    };
    assert_eq!(curl.model.dim, heads);
    assert!(!with("mspacman", "cpc", &[]).unwrap().model.dim.action);
    // Nothing to tell apart in a world with a single action.
    assert!(!with("ising", "driml-fix", &[]).unwrap().model.dim.action);
}

/// A row of the file is a world, an agent and what is set; the answer stands below it.
#[test]
fn settings_that_cannot_work_are_answered_with_what_to_do() {
    let rows = include_str!("../../tests/snapshots/refusals.txt").lines();
    let answered = rows.filter_map(|row| {
        let Some(words) = row.strip_prefix("> ") else {
            return row.starts_with('#').then(|| format!("{row}\n"));
        };
        let words: Vec<_> = words.split(' ').collect();
        let said = with(words[0], words[1], &words[2..]).unwrap_err();
        Some(format!("{row}\n{said}\n"))
    });
    expect_file!["../../tests/snapshots/refusals.txt"].assert_eq(&answered.collect::<String>());
}

#[test]
fn any_agent_that_looks_ahead_may_look_at_another_state_and_augment() {
    let five = with("procgen:heist", "driml-noact", &["run.horizon.k=5"]).unwrap();
    assert_eq!(five.run.horizon, Horizon::Fixed { k: 5 });
    assert!(!five.model.dim.action && five.model.dim.psi4);
    // Any agent that looks at later states can augment.
    let augment =
        "learner.augment={crop_side=0.9,brightness=0.1,contrast=0.0,saturation=0,hue=0.2}";
    let augmented = with("procgen:heist", "driml-noact", &[augment]).unwrap();
    assert_eq!(augmented.learner.augment.unwrap().crop_side, 0.9);
}

#[test]
fn optional_settings_can_be_set_though_no_preset_has_them() {
    let ising = "world.ising={temperature=0.4,sweeps_per_step=1}";
    let config = with("mspacman", "c51", &[ising]).unwrap();
    assert!(matches!(config.world, WorldConfig::MsPacman(world) if world.ising.is_some()));
    let visible = ["learner.affinity.alphabet=visible"];
    let map = with("procgen:maze", "driml-ada", &visible).unwrap();
    assert_eq!(map.learner.affinity.visible.unwrap()[..3], [1, 1, 1]);
}

#[test]
fn a_ladder_of_epsilons_is_for_the_actors_of_the_run() {
    let ladder = "actor.epsilon_ladder={base=0.4,alpha=7}";
    let of = |sets: &[&str]| with("mspacman", "c51", sets).map(|it| it.actor.epsilon_ladder);
    assert_eq!(of(&[]).unwrap(), None);
    let actors = |sets: &[&str]| of(sets).unwrap().unwrap().actors;
    assert_eq!(actors(&[ladder, "local.actors=3"]), 3);
    assert_eq!(actors(&["local.actors=3", ladder]), 3);
    // For actors that are started by hand.
    assert_eq!(actors(&[ladder, "actor.epsilon_ladder.actors=64"]), 64);
}

#[test]
fn a_file_at_odds_with_itself_is_refused() {
    let text = with("mspacman", "c51", &[]).unwrap().to_toml();
    let said = |text: String| of_file("x.toml", text, &[]).unwrap_err();
    expect!["x.toml: run.num_actions = 6, but it follows from the world and actor.actions and is 5; correct the one or the other"].assert_eq(&said(text.replace("num_actions = 5", "num_actions = 6")));
    expect![
        "x.toml: the settings lack input.height, a whole number: use a config.toml that driml wrote"
    ]
    .assert_eq(&said(text.replace("[input]", "[inputs]")));
    expect!["x.toml: in the settings' [world] table: unknown field `boost_steps`, expected one of `cells`, `height`, `width`, `step_limit`, `reward_left`, `reward_right`"].assert_eq(&said(
        text.replace("world = \"mspacman\"", "world = \"chain\""),
    ));
    expect![
        "x.toml is not TOML: unquoted keys cannot be empty, expected letters, numbers, `-`, `_`"
    ]
    .assert_eq(&said("= 3".into()));
    expect!["x.toml: the settings lack run.world, a word: use a config.toml that driml wrote"]
        .assert_eq(&said(String::new()));
    expect!["x.toml: in the settings' [actor] table: unknown field `colour`, expected one of `envs`, `steps_per_chunk`, `round_transitions_max`, `chunks_in_flight_max`, `precision`, `actions`, `world_threads`, `epsilon_start`, `epsilon_end`, `epsilon_decay_frames`, `epsilon_ladder`, `ack_timeout_ms`, `unreachable_max_ms`"].assert_eq(&said(text.replace("envs = 16", "envs = 16\ncolour = 1")));
}

#[test]
fn a_run_prints_what_its_preset_gives_up() {
    let printed = |preset| {
        let source = source(preset, "mspacman", "c51");
        let notes = resolve(&source, &Flags::default(), &MACHINE).unwrap().notes;
        notes.join("\n")
    };
    assert!(!printed("exact").contains("results/tradeoff"));
    for (preset, price) in [("balanced", "6%"), ("fast", "15%")] {
        let said = printed(preset);
        let all = [price, "results/tradeoff"]
            .iter()
            .all(|it| said.contains(it));
        assert!(said.starts_with(preset) && all, "{said}");
    }
}

#[test]
fn flags_come_before_set_and_both_before_the_machine() {
    let flags = Flags {
        seed: Some(5),
        actors: Some(3),
        envs: Some(2),
        ..frames(7_000, &["run.seed=6"])
    };
    let config = resolve(&source("paper", "chain", "c51"), &flags, &MACHINE).unwrap();
    let (run, local) = (&config.run, &config.local);
    let found = (config.frames(), run.seed, local.actors, config.actor.envs);
    assert_eq!(found, (7_000, 6, 3, 2));
}

#[test]
fn an_automatic_precision_is_the_processors_fastest_and_f32_on_a_gpu() {
    let of = |fast_bf16, set: &[&str]| {
        let machine = Machine {
            fast_bf16,
            ..MACHINE
        };
        let source = source("tuned", "procgen:maze", "c51");
        let config = resolve(&source, &sets(set), &machine).unwrap();
        [config.actor.precision, config.learner.precision].map(|it| it.to_string())
    };
    let cuda = "local.learner_device=cuda:0";
    assert_eq!(of(true, &[]), ["bf16", "bf16"]);
    assert_eq!(of(false, &[]), ["f32", "f32"]);
    assert_eq!(of(true, &[cuda]), ["bf16", "f32"]);
    assert_eq!(of(true, &["learner.precision=f32"]), ["bf16", "f32"]);
    assert_eq!(of(false, &["actor.precision=bf16"]), ["bf16", "f32"]);
}

#[test]
fn the_replay_fits_the_memory_and_says_so() {
    let of = |world, gib: u64| {
        let machine = Machine {
            memory_bytes: gib << 30,
            ..MACHINE
        };
        let source = source("paper", world, "driml-fix");
        resolve(&source, &frames(50_000_000, &[]), &machine).unwrap()
    };
    let config = of("procgen:bigfish", 8);
    expect!["the replay holds the newest 348617 transitions instead of 1000000: 8.0 GiB of memory are free, and it takes half, or what actors and learner leave"].assert_eq(&config.notes.join("\n"));
    assert!(config.replay.capacity_transitions < 400_000);
    let config = of("procgen:heist", 64);
    let capacity = config.replay.capacity_transitions;
    assert_eq!((capacity, config.notes.len()), (1_000_000, 0));
}

#[test]
fn a_compressed_replay_is_bounded_in_bytes_instead() {
    let lz4 = "replay.compression=lz4";
    let million = "replay.transitions_max=1000000";
    let config = with("procgen:bigfish", "c51", &[lz4, million]).unwrap();
    let replay = &config.replay;
    let sizes = (replay.capacity_transitions, replay.compressed_bytes_max);
    assert_eq!(sizes, (1_000_000, Some((8 << 30) - 128_000_000)));
    expect!["compressed frames may take 7.9 GiB, as 16.0 GiB of memory are free; if they compress badly, the replay holds fewer than 1000000 transitions"].assert_eq(&config.notes.join("\n"));
    // What fits without compressing at all needs no bound.
    let capacity = "replay.capacity_transitions=100000";
    let config = with("procgen:bigfish", "c51", &[lz4, capacity]).unwrap();
    assert_eq!(config.replay.compressed_bytes_max, None);
}

#[test]
fn rows_are_drawn_by_the_rule_that_is_set() {
    let all = "replay.sampling={rule=\"prioritised\",alpha=0.5,beta_start=0.4,beta_end=1.0}";
    let config = with("chain", "c51", &[]).unwrap();
    assert_eq!(config.replay.sampling, Sampling::Uniform);
    // Rainbow's numbers; beta rises over the whole run.
    let flags = frames(33_000, &[all]);
    let config = resolve(&source("paper", "chain", "c51"), &flags, &MACHINE).unwrap();
    let updates = (33_000 - config.replay.warmup_transitions) as f64 * config.replay.replay_ratio
        / f64::from(config.learner.batch_size);
    let expected = Sampling::Prioritised {
        alpha: 0.5,
        beta_start: 0.4,
        beta_end: 1.0,
        beta_updates: updates as u64,
    };
    assert_eq!(config.replay.sampling, expected);
    let text = config.to_toml();
    assert_eq!(RunConfig::parse("it", &text).unwrap().to_toml(), text);
    let learner = driml_learner::LearnerConfig::from_toml(&text).unwrap();
    assert_eq!(learner.sampling, expected);
    // The hash of the run's settings is that of every other rule: checkpoints stay valid.
    assert_eq!(config.run, with("chain", "c51", &[]).unwrap().run);
}

#[test]
fn a_torso_has_settings_of_its_own() {
    let with = |sets: &[&str]| with("procgen:bigfish", "c51", sets);
    let nature = with(&[]).unwrap();
    assert_eq!(nature.model.torso, TorsoName::Nature);
    assert!(nature.model.channels.is_empty() && !nature.model.scale_blocks);
    let impala = with(&["model.torso=impala"]).unwrap();
    let model = &impala.model;
    assert_eq!(model.channels, [16, 32, 32]);
    assert!(model.scale_blocks && model.conv.is_empty());
    // Every pixel is read.
    assert_eq!((impala.run.frame_height, model.width), (64, 64));
    assert_eq!(RunConfig::parse("it", &impala.to_toml()).unwrap(), impala);
    let wide = with(&["model.channels=[32,64]", "model.torso=impoola"]).unwrap();
    assert_eq!(wide.model.torso, TorsoName::Impoola);
    assert_eq!(wide.model.channels.len(), 2);

    let of_nature = |set: &[&str]| of_file("it.toml", nature.to_toml(), set);
    let switched = of_nature(&["model.torso=impala", "model.channels=[8]"]).unwrap();
    assert!(switched.model.conv.is_empty() && switched.run.frame_height == 64);
    expect!["model configuration: channels is empty, and torso = impala is made of it: set model.channels, or set model.torso to nature"]
        .assert_eq(&of_nature(&["model.torso=impala"]).unwrap_err());
}
