//! How presets, flags, `--set` and files resolve, and the errors of settings that cannot work.
//! `tests/snapshots/refusals.txt` has the error messages.

use driml_envs::WorldName;
use driml_protocol::Sampling;
use expect_test::{expect, expect_file};

use super::*;
use crate::{
    menu::settings_with_sources,
    overrides::find,
    presets::{AGENTS, PRESETS},
};

const MACHINE: Machine = Machine {
    cores: 2,
    memory_bytes: 16 << 30,
    fast_bf16: false,
};

fn source(preset: &str, world: &str, agent: &str) -> Source {
    Source::Presets(Choice::new(Some(preset), Some(world), Some(agent)).unwrap())
}

fn sets(sets: &[&str]) -> Flags {
    Flags {
        sets: sets.iter().map(|&set| set.into()).collect(),
        ..Flags::default()
    }
}

fn resolve_file(name: &str, text: String, set: &[&str]) -> Result<RunConfig, String> {
    let file = Source::File(name.into(), text);
    file.resolve(&sets(set), &MACHINE)
        .map_err(|e| e.to_string())
}

fn paper(world: &str, agent: &str, set: &[&str]) -> Result<RunConfig, String> {
    resolve_names("paper", world, agent, set, &MACHINE).map_err(|e| e.to_string())
}

/// `driml presets > FILE; driml train --config FILE` with changed settings.
#[test]
fn what_follows_from_the_settings_of_a_file_follows_from_changed_ones_too() {
    let longer = "replay.transitions_max=401000";
    let own_beta = "replay.sampling.beta_updates=500";
    let ladder = "local.actors=2 actor.epsilon_ladder={base=0.4,alpha=7.0}";
    let (packed, plain) = ("replay.compression=lz4", "replay.compression=none");
    let beta = "replay.sampling.beta_updates";
    let rungs = "actor.epsilon_ladder.actors";
    for (agent, before, after, path, expected) in [
        ("rainbow", "run.seed=1", longer, beta, "12500"),
        ("rainbow", own_beta, longer, beta, "500"),
        ("c51", ladder, "local.actors=4", rungs, "4"),
        ("c51", packed, plain, COMPRESSED_MAX, "-"),
    ] {
        let before: Vec<_> = before.split(' ').collect();
        let file = paper("mspacman", agent, &before).unwrap().to_toml();
        let source = Source::of_another_run("config.toml", &file).unwrap();
        let resolved = source.resolve(&sets(&[after]), &MACHINE).unwrap();
        let resolved = resolved.to_table();
        let value = find(&resolved, path).map_or("-".into(), Value::to_string);
        assert_eq!(value, expected, "{agent}: {before:?}, then {after}");
    }
}

/// What `driml presets` prints reads back too, and has a source for each setting.
#[test]
fn every_preset_in_every_world_for_every_agent_resolves_and_reads_back() {
    let mut resolved = 0;
    for preset in PRESETS {
        for world in WorldName::all() {
            for agent in AGENTS {
                let (preset, agent, name) = (preset.name, agent.name, world.to_string());
                let choice = Choice::new(Some(preset), Some(&name), Some(agent)).unwrap();
                let source = Source::Presets(choice);
                let config = match source.resolve(&Flags::default(), &MACHINE) {
                    Ok(config) => config,
                    Err(e) if e.0.contains("take --preset paper") => continue,
                    Err(e) => panic!("{preset} {world} {agent}: {e}"),
                };
                let printed = settings_with_sources(choice, &[]).unwrap();
                assert!(!printed.contains("not said"), "{printed}");
                RunConfig::parse("printed", &printed).unwrap();
                let text = config.to_toml();
                let again = resolve_file("config.toml", text.clone(), &[]).unwrap();
                assert_eq!(again.to_toml(), text);
                let mut read = RunConfig::parse("config.toml", &text).unwrap();
                assert_eq!(read.to_toml(), text);
                (read.notes, read.accuracy_note) =
                    (config.notes.clone(), config.accuracy_note.clone());
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

/// Settings of earlier versions have whole frames and keep them.
#[test]
fn frames_that_are_whole_stay_whole() {
    let sizes = |config: &RunConfig| {
        let (run, model) = (&config.run, &config.model);
        let frame = (run.frame_height, run.frame_width);
        (frame, (model.height, model.width))
    };
    let cut = paper("procgen:bigfish", "driml-ada", &[]).unwrap();
    let old = cut.with_whole_frames().unwrap();
    assert_eq!(sizes(&old), ((64, 64), (64, 64)));
    assert_eq!(old.run.seed, cut.run.seed);
    let text = old.to_toml();
    assert!(!text.contains("[input.frame]"), "{text}");
    assert_eq!(RunConfig::parse("old.toml", &text).unwrap(), old);
    let again = resolve_file("old.toml", text, &["run.seed=7"]).unwrap();
    assert_eq!((sizes(&again), again.run.seed), (sizes(&old), 7));
    let size = ["input.height=104", "input.width=80"];
    let again = resolve_file("new.toml", cut.to_toml(), &size).unwrap();
    assert_eq!(sizes(&again), ((62, 61), (100, 76)));
    let text = cut.to_toml();
    let wrong = text.replace("frame_height = 60", "frame_height = 64");
    expect!["wrong.toml: run.frame_height = 64, but it follows from the world and what the torso reads and is 60; correct one of the two"]
        .assert_eq(&RunConfig::parse("wrong.toml", &wrong).unwrap_err().to_string());
}

/// Settings of earlier versions do not name the set of actions.
#[test]
fn an_agent_has_all_actions_unless_it_chooses_among_those_that_differ() {
    let all = paper("procgen:plunder", "driml-ada", &[]).unwrap();
    assert_eq!(all.action_names().len(), all.world.num_actions());
    let old = all.to_toml().replace("actions = \"all\"\n", "");
    assert_eq!(RunConfig::parse("old.toml", &old).unwrap(), all);
    let names = paper("procgen:plunder", "c51", &["actor.actions=visible"]).unwrap();
    assert_eq!(names.action_names(), ["left", "no-op", "right", "d"]);
}

/// Returns the comments of a file, and its rows that begin with `> `, each with its answer below.
fn fill_in_answers(text: &str, answer: impl Fn(&str) -> String) -> String {
    let lines = text.lines().filter_map(|row| match row.strip_prefix("> ") {
        Some(question) => Some(format!("{row}\n{}\n", answer(question))),
        None => row.starts_with('#').then(|| format!("{row}\n")),
    });
    lines.collect()
}

/// A row of the file has a world, an agent and the `--set` values; the error stands below it.
#[test]
fn settings_that_cannot_work_are_answered_with_what_to_do() {
    let text = include_str!("../../tests/snapshots/refusals.txt");
    let answers = fill_in_answers(text, |row| {
        let words: Vec<_> = row.split(' ').collect();
        paper(words[0], words[1], &words[2..]).unwrap_err()
    });
    expect_file!["../../tests/snapshots/refusals.txt"].assert_eq(&answers);
}

/// A row of the file has a preset, a world, an agent, the `--set` values, and after a question mark the settings or notes to print below
/// it. `@bf16` means a machine that is fast in bf16, `@8` one with 8 GiB of memory.
#[test]
fn settings_follow_from_one_another() {
    let text = include_str!("../../tests/snapshots/resolved.txt");
    let answers = fill_in_answers(text, |row| {
        let (row, asked) = row.split_once(" ? ").unwrap();
        let (at, words): (Vec<_>, Vec<_>) = row.split(' ').partition(|it| it.starts_with('@'));
        let mut machine = MACHINE;
        for at in at {
            match at.trim_start_matches('@') {
                "bf16" => machine.fast_bf16 = true,
                gib => machine.memory_bytes = gib.parse::<u64>().unwrap() << 30,
            }
        }
        let [preset, world, agent] = [words[0], words[1], words[2]];
        let config = resolve_names(preset, world, agent, &words[3..], &machine).unwrap();
        let text = config.to_toml();
        assert_eq!(RunConfig::parse("it", &text).unwrap().to_toml(), text);
        let names = config.action_names().len();
        assert_eq!(names, config.run.num_actions as usize);
        let table = config.to_table();
        let value = |path| match find(&table, path) {
            Some(value) => format!("{path} = {value}"),
            None if path == "notes" => format!("notes: {:?}", config.notes),
            None if path == "accuracy_note" => format!("{:?}", config.accuracy_note),
            None => format!("{path} is not set"),
        };
        asked.split(' ').map(value).collect::<Vec<_>>().join("\n")
    });
    // A setting without a value in any row may be misspelt.
    let unset = answers.lines().map(|line| line.strip_suffix(" is not set"));
    for path in unset.flatten() {
        let is_set = answers.contains(&format!("\n{path} = "));
        assert!(is_set, "{path} has a value in no row");
    }
    expect_file!["../../tests/snapshots/resolved.txt"].assert_eq(&answers);
}

#[test]
fn a_file_at_odds_with_itself_is_refused() {
    let text = paper("mspacman", "c51", &[]).unwrap().to_toml();
    let layers =
        format!("{text}\n[[model.loss_layers]]\nname = \"next\"\ninputs = 1\noutputs = 1\n");
    let said = [
        text.replace("num_actions = 5", "num_actions = 6"),
        layers,
        text.replace("[input]", "[inputs]"),
        text.replace("world = \"mspacman\"", "world = \"chain\""),
        "[run]\n= 3".into(),
        String::new(),
        text.replace("envs = 16", "envs = 16\nepsilon_stat = 1"),
    ]
    .map(|text| resolve_file("x.toml", text, &[]).unwrap_err() + "\n");
    expect![[r#"
        x.toml: run.num_actions = 6, but it follows from the world and actor.actions and is 5; correct one of the two
        x.toml: model.loss_layers = [{ inputs = 1, name = "next", outputs = 1 }], but it follows from learner.update and is not there; correct one of the two
        x.toml: the settings lack input.height: use a config.toml that driml wrote
        x.toml: in the settings' [world] table: unknown field `boost_steps`, expected one of `cells`, `height`, `width`, `step_limit`, `reward_left`, `reward_right`
        x.toml is not TOML: line 2: unquoted keys cannot be empty, expected letters, numbers, `-`, `_`
        x.toml: the settings lack run.world, a word: use a config.toml that driml wrote
        x.toml: in the settings: unknown field `epsilon_stat` (did you mean "epsilon_start"?), expected one of `envs`, `steps_per_chunk`, `round_transitions_max`, `chunks_in_flight_max`, `precision`, `actions`, `world_threads`, `epsilon_start`, `epsilon_end`, `epsilon_decay_frames`, `epsilon_ladder`, `ack_timeout_ms`, `unreachable_max_ms`, in `actor`
    "#]]
    .assert_eq(&said.concat());
}

#[test]
fn flags_come_before_set_and_both_before_the_machine() {
    let flags = Flags {
        seed: Some(5),
        actors: Some(3),
        envs: Some(2),
        frames: Some(7_000),
        ..sets(&["run.seed=6"])
    };
    let source = source("paper", "chain", "c51");
    let config = source.resolve(&flags, &MACHINE).unwrap();
    let (run, local) = (&config.run, &config.local);
    let found = (config.frames(), run.seed, local.actors, config.actor.envs);
    assert_eq!(found, (7_000, 6, 3, 2));
    let too_many = Flags {
        frames: Some(u64::MAX),
        ..Flags::default()
    };
    let said = source.resolve(&too_many, &MACHINE).unwrap_err();
    expect![
        "replay.transitions_max = 18446744073709551615: the largest number is 9223372036854775807"
    ]
    .assert_eq(&said.to_string());
}

#[test]
fn a_replay_server_of_its_own_counts_nothing_that_runs_elsewhere() {
    let size = |server_alone, actors, replay_shards, set: &[&str]| {
        let flags = Flags {
            actors: Some(actors),
            replay_shards: Some(replay_shards),
            server_alone,
            frames: Some(50_000_000),
            ..sets(set)
        };
        let config = source("paper", "procgen:heist", "c51").resolve(&flags, &MACHINE);
        let capacity = config.map(|it| it.replay.capacity_transitions);
        capacity.map_err(|e| e.to_string())
    };
    // Actors on other machines take none of the server's memory, and two shards have the memory of two machines.
    assert!(size(false, 64, 1, &[]).unwrap_err().contains("64 actors"));
    let [one, two] = [1, 2].map(|shards| size(true, 64, shards, &[]).unwrap());
    assert_eq!((one, two), (793_014, 1_000_000));
    // A restarted server keeps the size that fitted beside actors and learner, which now run.
    let most = "replay.capacity_transitions=1400000";
    let said = size(false, 4, 1, &[most]).unwrap_err();
    expect!["replay.capacity_transitions = 1400000 needs 14.1 GiB, and may take 13.8 GiB, as 16.0 GiB are free: --set replay.capacity_transitions=793014"].assert_eq(&said);
    assert_eq!(size(true, 4, 1, &[most]), Ok(1_400_000));
}

/// The sampling rule does not change the hash of the run's settings, so checkpoints stay valid.
#[test]
fn by_which_rule_rows_are_drawn_is_for_replay_and_learner_alone() {
    let all = "replay.sampling={rule=\"prioritised\",alpha=0.5,beta_start=0.4,beta_end=1.0}";
    let [uniform, prioritised] = [&[][..], &[all]].map(|it| paper("chain", "c51", it).unwrap());
    assert_eq!(uniform.replay.sampling, Sampling::Uniform {});
    assert!(prioritised.replay.sampling.is_prioritised());
    let learner = driml_learner::LearnerConfig::from_toml(&prioritised.to_toml()).unwrap();
    assert_eq!(learner.sampling, prioritised.replay.sampling);
    assert_eq!(prioritised.run, uniform.run);
}

#[test]
fn a_file_s_torso_is_switched_with_its_settings() {
    let nature = paper("procgen:bigfish", "c51", &[]).unwrap();
    let resolve_nature = |set: &[&str]| resolve_file("it.toml", nature.to_toml(), set);
    let switched = resolve_nature(&["model.torso=impala", "model.channels=[8]"]).unwrap();
    assert!(switched.model.conv.is_empty() && switched.run.frame_height == 64);
    expect!["model configuration: channels is empty, and torso = impala is made of it: set model.channels, or set model.torso to nature"]
        .assert_eq(&resolve_nature(&["model.torso=impala"]).unwrap_err());
}

#[test]
fn a_setting_that_makes_another_task_is_named() {
    let chain = |sets: &[&str]| paper("chain", "driml-fix", sets).unwrap();
    let loss = "learner.update.auxiliary_loss";
    for (sets, expected) in [
        ("learner.batch_size=32", "-"),
        ("run.gamma=0.5", "run.gamma"),
        (&format!("{loss}=cpc"), loss),
        ("run.gamma=0.5 world.step_limit=77", "world.step_limit"),
    ] {
        let changed = chain(&sets.split(' ').collect::<Vec<_>>());
        let found = chain(&[]).first_change_of_task(&changed);
        assert_eq!(found.unwrap_or("-".into()), expected, "{sets}");
    }
    let exec = |timeout_ms: u32| RunConfig {
        world: toml::from_str(&format!(
            "kind = 'exec'\ncommand = 'x'\nheight = 4\nwidth = 4\nchannels = 1\nactions = ['a']\n\
             start_timeout_ms = 9\nstep_timeout_ms = {timeout_ms}"
        ))
        .unwrap(),
        ..chain(&[])
    };
    assert_eq!(exec(1).first_change_of_task(&exec(2)), None);
}
