//! A world in its own process against one whose every frame says which one it is (`tests/worlds/numbered.py`), and each way in
//! which a process can fail. Needs `python3`, without any package; what needs Gymnasium is in `tests/system/own_worlds.rs`.

use std::fs;
use std::time::{Duration, Instant};

use super::protocol::SavedExec;
use super::world::seeds;
use super::*;
use crate::environment::{Environment, StepEnd};
use crate::error::EnvError;
use crate::playing::{frames, step};
use crate::saved::tests::continues;
use crate::settings::WorldSettings;

/// The command of the world that numbers its frames.
pub(crate) fn numbered(arguments: &str) -> String {
    format!(
        "exec python3 {}/../../tests/worlds/numbered.py {arguments}",
        env!("CARGO_MANIFEST_DIR")
    )
}

pub(crate) fn config(command: String) -> ExecConfig {
    ExecConfig {
        command,
        height: 12,
        width: 12,
        channels: 1,
        actions: ["no-op", "left", "right"].map(str::to_owned).to_vec(),
        start_timeout_ms: 60_000,
        step_timeout_ms: 60_000,
    }
}

fn said(error: EnvError) -> String {
    error.to_string()
}

#[test]
fn a_command_declares_what_it_is() {
    let command = numbered("");
    let declared = declaration(&command, 60_000, 60_000).unwrap();
    assert_eq!(declared, config(command));
    assert_eq!(declared.action_names(), ["no-op", "left", "right"]);
    assert!(declared.is_resumable());
}

/// The first four pixels of each copy's frame and the fifth: copy, episode, seed and step.
fn numbers(frames: &[u8]) -> Vec<[u16; 4]> {
    let numbers = |frame: &[u8]| {
        assert!(frame[5..].iter().all(|&byte| byte == frame[4]));
        let seed = u16::from_be_bytes([frame[2], frame[3]]);
        [frame[0].into(), frame[1].into(), seed, frame[4].into()]
    };
    frames.chunks_exact(144).map(numbers).collect()
}

#[test]
fn every_frame_reward_and_end_is_the_one_that_the_process_made() {
    const COPIES: usize = 3;
    let config = config(numbered(""));
    let mut world = ExecWorld::new(&config, COPIES, 7).unwrap();
    assert_eq!((world.num_envs(), world.num_actions()), (COPIES, 3));
    assert_eq!(world.frame_shape(), config.frame_shape());
    let seeds: Vec<u16> = seeds(7, COPIES)
        .into_iter()
        .map(|seed| (seed % 65_536) as u16)
        .collect();
    let (mut episodes, mut steps) = ([0; COPIES], [0; COPIES]);
    for round in 0..100 {
        let expected: Vec<_> = (0..COPIES)
            .map(|copy| [copy as u16, episodes[copy], seeds[copy], steps[copy]])
            .collect();
        assert_eq!(numbers(&frames(&mut world)), expected, "round {round}");
        let actions = [0, 1, 2].map(|copy| ((copy + round) % 3) as u8);
        let (rewards, ends) = step(&mut world, &actions);
        for copy in 0..COPIES {
            steps[copy] += 1;
            let last = steps[copy] == 3 + copy as u16;
            let end = match (last, episodes[copy] % 2) {
                (false, _) => StepEnd::Running,
                (true, 0) => StepEnd::Terminal,
                (true, _) => StepEnd::TimedOut,
            };
            let reward = f32::from(actions[copy]) + f32::from(steps[copy]) / 100.0;
            assert_eq!(ends[copy], end, "round {round}, copy {copy}");
            let reward = if last { 1000.0 } else { reward };
            assert!((rewards[copy] - reward).abs() < 1e-6, "{rewards:?}");
            if last {
                (steps[copy], episodes[copy]) = (0, episodes[copy] + 1);
            }
        }
    }
}

#[test]
fn an_environment_s_seed_does_not_depend_on_how_many_environments_there_are() {
    let many = seeds(7, 64);
    assert_eq!(seeds(7, 3), many[..3]);
    assert_ne!(seeds(8, 3), many[..3]);
    assert!(many.iter().all(|&seed| seed < 1 << 31));
    let different: std::collections::BTreeSet<_> = many.iter().collect();
    assert_eq!(different.len(), 64);
}

/// The error of a world that fails in its third step.
fn fault(arguments: &str, step_timeout_ms: u64) -> String {
    let config = ExecConfig {
        step_timeout_ms,
        ..config(numbered(&format!("{arguments} 3")))
    };
    let mut world = ExecWorld::new(&config, 2, 1).unwrap();
    let (mut rewards, mut ends) = ([0.0; 2], [StepEnd::Running; 2]);
    let mut step = || world.step(&[0, 1], &mut rewards, &mut ends);
    step().unwrap();
    step().unwrap();
    said(step().unwrap_err())
}

#[test]
fn each_way_a_step_can_fail_has_its_sentence() {
    for (arguments, sentences) in [
        (
            "raise",
            vec![
                "ended in the middle of a step (exit status: 1)",
                "RuntimeError: the dragon got out",
            ],
        ),
        ("kill", vec!["ended in the middle of a step (signal: 9"]),
        ("small", vec!["(exit status: 1)", "Error: "]),
        ("nan", vec!["gave copy 1 the reward NaN"]),
        ("end", vec!["ended the step of copy 1 with 7; 0 runs on"]),
        ("hang", vec!["--set world.step_timeout_ms=N", "sleeping"]),
    ] {
        let limit = if arguments == "hang" { 700 } else { 60_000 };
        let started = Instant::now();
        let text = fault(arguments, limit);
        assert!(
            text.starts_with("the world `exec python3 "),
            "{arguments}: {text}"
        );
        for sentence in sentences {
            assert!(text.contains(sentence), "{arguments}: {text}");
        }
        assert!(started.elapsed() < Duration::from_secs(50), "{arguments}");
    }
}

#[test]
fn each_way_a_start_can_fail_has_its_sentence() {
    let answer = |json: &str| format!("read -r line; echo '{json}'; read -r line");
    let whole = r#""copies": 1, "height": 12, "width": 12, "channels": 1, "actions": ["a"]"#;
    for (command, sentence) in [
        (
            "no-such-command --now".into(),
            "exit status 127: the shell found no such command",
        ),
        (
            "exit 3".into(),
            "ended before it declared itself (exit status: 3)",
        ),
        (
            "echo the ROM is missing >&2; exit 4".into(),
            "Its last words:\n  the ROM is missing",
        ),
        ("sleep 60".into(), "--set world.start_timeout_ms=N"),
        (
            "exec >&-; sleep 60".into(),
            "closed its stdout before it declared itself",
        ),
        (
            "echo hello; read -r line".into(),
            "does not declare itself as a world: its first line on stdout is \"hello\"",
        ),
        (answer("{}"), "\"driml_env\" is missing"),
        (answer(r#"{"driml_env": 1, "copies": 1}"#), "missing field"),
        (
            answer(r#"{"driml_env": 2, "colour": 3}"#),
            "speaks version 2 of the protocol, and this driml speaks version 1",
        ),
        (
            answer(&format!(
                "{{\"driml_env\": 1, {}}}",
                whole.replace("12", "0")
            )),
            "declares frames of 0 x 0 x 1",
        ),
        (
            answer(&format!(
                "{{\"driml_env\": 1, {}}}",
                whole.replace("\"a\"", "")
            )),
            "declares 0 actions",
        ),
    ] {
        // Long enough for everything that answers at all.
        let limit = if command == "sleep 60" { 500 } else { 60_000 };
        let error = declaration(&command, limit, 1000).unwrap_err().to_string();
        assert!(error.contains(sentence), "{command}: {error}");
    }
}

#[test]
fn a_world_that_is_another_than_the_settings_say_is_refused() {
    let other = |change: fn(&mut ExecConfig)| {
        let mut config = config(numbered(""));
        change(&mut config);
        said(ExecWorld::new(&config, 2, 1).map(drop).unwrap_err())
    };
    let text = other(|config| config.height = 13);
    assert!(
        text.contains("declares frames of 12 x 12 x 1 and the 3 actions no-op, left, right, but the run's settings say frames of 13 x 12 x 1"),
        "{text}"
    );
    let text = other(|config| config.actions.swap(0, 1));
    assert!(text.contains("settings say"), "{text}");
    let one = r#"{"driml_env": 1, "copies": 1, "height": 12, "width": 12, "channels": 1, "actions": ["no-op", "left", "right"]}"#;
    let text = other(|config| config.command = String::new());
    assert!(text.contains("without a command"), "{text}");
    let config = config(format!("read -r line; echo '{one}'; read -r line"));
    let text = said(ExecWorld::new(&config, 2, 1).map(drop).unwrap_err());
    assert!(
        text.contains("has 1 copies where 2 were asked for"),
        "{text}"
    );
}

#[test]
fn what_is_printed_into_the_protocol_is_named() {
    let one = r#"{"driml_env": 1, "copies": 1, "height": 12, "width": 12, "channels": 1, "actions": ["no-op", "left", "right"]}"#;
    let command = format!("read -r line; echo '{one}'; read -r line; echo ready");
    let text = said(
        ExecWorld::new(&config(command), 1, 1)
            .map(drop)
            .unwrap_err(),
    );
    assert!(text.contains("the byte 0x72 and not with `.`"), "{text}");
}

#[test]
fn a_world_that_offers_it_continues_where_it_was_saved() {
    let config = config(numbered("saves"));
    let mut worlds = Vec::new();
    // Another seed each: what a world is, is in its state alone.
    let ended = continues("a process", 60, || {
        worlds.push(());
        Box::new(ExecWorld::new(&config, 3, worlds.len() as u64).unwrap())
    });
    assert!(ended > 20, "{ended}");
    // The frames that its next actions are taken in are those that there were.
    let mut world = ExecWorld::new(&config, 2, 1).unwrap();
    step(&mut world, &[0, 1]);
    let mut other = ExecWorld::new(&config, 2, 2).unwrap();
    other.load(&world.save().unwrap()).unwrap();
    assert_eq!(frames(&mut other), frames(&mut world));
}

/// The error of a world that offers to save its state, when it is asked to.
fn save_fault(kind: &str) -> EnvError {
    let config = ExecConfig {
        step_timeout_ms: if kind == "hang" { 700 } else { 60_000 },
        ..config(numbered(&format!("saves {kind}")))
    };
    let mut world = ExecWorld::new(&config, 2, 1).unwrap();
    let state = world.save();
    match kind {
        "lost" => world.load(&state.unwrap()).unwrap_err(),
        _ => state.unwrap_err(),
    }
}

#[test]
fn each_way_in_which_saving_can_fail_has_its_sentence() {
    for (kind, sentences) in [
        (
            "never",
            vec!["cannot save its state: the dragon sits on it"],
        ),
        ("nothing", vec!["wrote no state"]),
        (
            "large",
            vec!["wrote a state of 67108865 bytes; 67108864 are possible"],
        ),
        (
            "byte",
            vec!["answered in the middle of saving its state with the byte 0x3f"],
        ),
        (
            "raise",
            vec![
                "ended in the middle of saving its state (exit status: 1)",
                "RuntimeError: the dragon ate it",
            ],
        ),
        (
            "hang",
            vec![
                "has not answered for 0.7 s in the middle of saving its state",
                "--set world.step_timeout_ms=N",
            ],
        ),
        (
            "lost",
            vec![
                "ended in the middle of loading its state",
                "the dragon does not give it back",
            ],
        ),
    ] {
        let error = save_fault(kind);
        let not_saved = matches!(error, EnvError::NotSaved(_));
        assert_eq!(not_saved, kind == "never", "{kind}");
        let text = said(error);
        assert!(
            text.starts_with("the world `exec python3 "),
            "{kind}: {text}"
        );
        for sentence in sentences {
            assert!(text.contains(sentence), "{kind}: {text}");
        }
    }
}

#[test]
fn a_world_that_does_not_offer_it_is_not_asked() {
    let mut world = ExecWorld::new(&config(numbered("")), 2, 1).unwrap();
    assert!(matches!(world.save(), Err(EnvError::NotSaved(_))));
    // It is not told, and continues.
    step(&mut world, &[0, 1]);
}

#[test]
fn a_state_of_another_world_is_refused_by_name() {
    let world =
        |arguments: &str, copies| ExecWorld::new(&config(numbered(arguments)), copies, 1).unwrap();
    let state = world("saves", 2).save().unwrap();
    let refused = |arguments: &str, copies, state: &[u8]| {
        said(world(arguments, copies).load(state).unwrap_err())
    };
    let text = refused("saves none other", 2, &state);
    assert!(text.contains("it is of the world `exec python3 "), "{text}");
    assert!(text.contains("numbered.py saves`, and this is `"), "{text}");
    assert!(
        text.contains("saves none other`: give the command"),
        "{text}"
    );
    let text = refused("saves", 3, &state);
    assert!(
        text.contains("2 environments, and this world has 3"),
        "{text}"
    );
    for wrong in [
        &state[..state.len() - 1],
        &[state.clone(), vec![0]].concat(),
        &[],
    ] {
        let text = refused("saves", 2, wrong);
        assert!(text.contains("no state of this world"), "{text}");
    }
    // The same command, which is another world now.
    let config = ExecConfig {
        height: 13,
        ..config(numbered("saves"))
    };
    let why = SavedExec::from_bytes(&state, &config, 2).unwrap_err();
    assert!(said(why).contains("the shape of its frames or its actions"));
}

/// Processes with this word in their command line.
fn alive(mark: &str) -> Vec<String> {
    let Ok(processes) = fs::read_dir("/proc") else {
        return Vec::new();
    };
    let lines = processes
        .filter_map(Result::ok)
        .filter_map(|process| fs::read_to_string(process.path().join("cmdline")).ok());
    lines.filter(|line| line.contains(mark)).collect()
}

#[test]
fn nothing_is_left_of_a_world_and_of_what_it_started() {
    let mark = format!("mark-{}-left", std::process::id());
    // A child that closes no pipe and handles no signal, as a worker may be.
    let command = format!(
        "sh -c 'sleep 600; : {mark}' & {}",
        numbered(&format!("none 0 {mark}"))
    );
    let world = ExecWorld::new(&config(command), 2, 1).unwrap();
    assert!(alive(&mark).len() >= 2, "{:?}", alive(&mark));
    drop(world);
    assert_eq!(alive(&mark), [""; 0]);

    // One that leads another group ends as well.
    let command = "exec timeout 600 sleep 590.5";
    declaration(command, 200, 1000).unwrap_err();
    assert_eq!(alive("590.5"), [""; 0]);

    let command = format!("sh -c 'sleep 600; : {mark}' & exit 5");
    declaration(&command, 60_000, 1000).unwrap_err();
    assert_eq!(alive(&mark), [""; 0]);
}
