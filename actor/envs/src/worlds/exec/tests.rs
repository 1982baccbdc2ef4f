//! Tests a world in its own process with one that numbers its frames (`tests/worlds/numbered.py`), and each way in which a process
//! can fail. Needs `python3`, without any package; what needs Gymnasium is in `tests/system/own_worlds.rs`.

use std::fs;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use super::process::log_stderr;
use super::protocol::ExecState;
use super::world::seeds;
use super::*;
use crate::environment::{Environment, StepEnd};
use crate::error::EnvError;
use crate::playing::{fails, frames, step};
use crate::saved::tests::check_restore;
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

/// The declaration of a world of these settings, with one copy.
const ONE: &str = r#"{"driml_env": 1, "copies": 1, "height": 12, "width": 12, "channels": 1, "actions": ["no-op", "left", "right"]}"#;

/// The command of a process that declares itself with this line, and nothing else.
fn declares(line: &str) -> String {
    format!("read -r line; echo '{line}'; read -r line")
}

#[test]
fn a_command_declares_what_it_is() {
    let command = numbered("");
    let declared = probe_command(&command, 60_000, 60_000).unwrap();
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
    let seeds = seeds(7, COPIES).into_iter();
    let seeds: Vec<u16> = seeds.map(|seed| (seed % 65_536) as u16).collect();
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

/// Runs a world that fails as its arguments say: when its state is saved or loaded, or in its third step.
fn faulty(arguments: &str) -> Result<(), EnvError> {
    let hangs = arguments.contains("hang");
    let config = ExecConfig {
        step_timeout_ms: if hangs { 700 } else { 60_000 },
        ..config(numbered(arguments))
    };
    let mut world = ExecWorld::new(&config, 2, 1).unwrap();
    if arguments.starts_with("saves") {
        let state = world.save()?;
        return world.load(&state);
    }
    for _ in 0..2 {
        step(&mut world, &[0, 1]);
    }
    world.step(&[0, 1], &mut [0.0; 2], &mut [StepEnd::Running; 2])
}

/// The world stops the actor for longer than a step may take, as if the whole run were stopped and continued, and answers afterwards.
#[test]
fn a_step_in_which_the_run_was_stopped_is_not_late() {
    let stop = "kill -STOP $PPID; sleep 3; kill -CONT $PPID; sleep 0.2; printf .; read -r line";
    let command = declares(ONE) + "; printf .; dd bs=1 count=1 status=none >/dev/null; " + stop;
    let config = ExecConfig {
        step_timeout_ms: 2500,
        ..config(command)
    };
    let mut world = ExecWorld::new(&config, 1, 1).unwrap();
    step(&mut world, &[0]);
}

/// Splits lines of the form `what => sentence | sentence ..`.
fn rows(table: &'static str) -> impl Iterator<Item = (&'static str, Vec<&'static str>)> {
    table.trim().lines().map(|line| {
        let (what, sentences) = line.split_once("=>").unwrap();
        let sentences = sentences.split('|').map(str::trim);
        (what.trim(), sentences.collect())
    })
}

/// How a world fails by its arguments, and the sentences that say so.
const FAULTS: &str = "
raise 3       => ended in the middle of a step (exit status: 1) | RuntimeError: the dragon got out
kill 3        => ended in the middle of a step (signal: 9
small 3       => (exit status: 1) | Error:
nan 3         => gave copy 1 the reward NaN
end 3         => ended the step of copy 1 with 7; 0 runs on
hang 3        => has not answered for 0.7 s in the middle of a step | --set world.step_timeout_ms=N | sleeping
saves never   => cannot save its state: the dragon sits on it
saves nothing => wrote no state
saves large   => wrote a state of 67108865 bytes; 67108864 are possible
saves byte    => answered in the middle of saving its state with the byte 0x3f
saves raise   => ended in the middle of saving its state (exit status: 1) | RuntimeError: the dragon ate it
saves hang    => has not answered for 0.7 s in the middle of saving its state | --set world.step_timeout_ms=N
saves lost    => ended in the middle of loading its state | the dragon does not give it back
";

#[test]
fn each_way_a_process_can_fail_has_its_sentence() {
    for (arguments, sentences) in rows(FAULTS) {
        let started = Instant::now();
        let failed = faulty(arguments);
        assert!(started.elapsed() < Duration::from_secs(50), "{arguments}");
        let not_saved = matches!(failed, Err(EnvError::NotSaved(_)));
        assert_eq!(not_saved, arguments == "saves never", "{arguments}");
        let text = fails(failed, &sentences);
        assert!(text.starts_with("the world `exec python3 "), "{text}");
    }
}

/// Commands that declare no world, and the error of each.
const NO_WORLDS: &str = r#"
no-such-command --now               => exit status 127: the shell found no such command
exit 3                              => ended before it declared itself (exit status: 3)
sleep 60                            => --set world.start_timeout_ms=N
exec >&-; sleep 60                  => closed its stdout before it declared itself
echo hello; read -r line            => does not declare itself as a world: its first line on stdout is "hello"
"#;

#[test]
fn each_way_a_start_can_fail_has_its_sentence() {
    let says = |command: &str, sentences: &[&str]| {
        // Long enough for every command that replies at all.
        let limit = if command == "sleep 60" { 500 } else { 60_000 };
        fails(probe_command(command, limit, 1000), sentences);
    };
    for (command, sentences) in rows(NO_WORLDS) {
        says(command, &sentences);
    }
    // The error quotes the command, too.
    let said = "Its last output:\n  the ROM is missing";
    says("echo the ROM is missing >&2; exit 4", &[said]);
    let refused = |line: &str, sentence| says(&declares(line), &[sentence]);
    refused("{}", "\"driml_env\" is missing");
    refused(r#"{"driml_env": 1, "copies": 1}"#, "missing field");
    let versions = "speaks version 2 of the protocol, and this driml speaks version 1";
    refused(r#"{"driml_env": 2, "colour": 3}"#, versions);
    refused(&ONE.replace("12", "0"), "declares frames of 0 x 0 x 1");
    let no_actions = ONE.replace(r#""no-op", "left", "right""#, "");
    refused(&no_actions, "declares 0 actions");
}

#[test]
fn a_world_that_is_another_than_the_settings_say_is_refused() {
    let refused = |sentence: &str, change: fn(&mut ExecConfig)| {
        let mut config = config(numbered(""));
        change(&mut config);
        fails(ExecWorld::new(&config, 2, 1), &[sentence]);
    };
    refused(
        "declares frames of 12 x 12 x 1 and the 3 actions no-op, left, right, but the run's settings say frames of 13 x 12 x 1",
        |config| config.height = 13,
    );
    refused("settings say", |config| config.actions.swap(0, 1));
    refused("without a command", |config| config.command.clear());
    refused("has 1 copies, and 2 were requested", |config| {
        config.command = declares(ONE);
    });
}

#[test]
fn what_is_printed_into_the_protocol_is_named() {
    let config = config(declares(ONE) + "; echo ready");
    let sentence = "the byte 0x72 and not with `.`";
    fails(ExecWorld::new(&config, 1, 1), &[sentence]);
    // A second reply, which the next step would read as the reply to its own request.
    let twice = self::config(declares(ONE) + "; printf ..; read -r line");
    let mut world = ExecWorld::new(&twice, 1, 1).unwrap();
    let stepped = world.step(&[0], &mut [0.0], &mut [StepEnd::Running]);
    fails(stepped, &["wrote to stdout between two steps"]);
}

#[test]
fn a_flood_on_stderr_is_logged_in_part_and_its_last_lines_are_kept() {
    let flood: String = (0..1000).map(|number| format!("{number}\n")).collect();
    let (tail, mut logged) = (Mutex::default(), Vec::new());
    log_stderr(flood.as_bytes(), &tail, |line| logged.push(line.to_owned()));
    assert_eq!(logged[49], "49");
    assert_eq!(logged[50..], ["950 more lines left out"]);
    let tail = tail.into_inner().unwrap();
    assert!(tail.into_iter().eq((988..1000).map(|it| it.to_string())));
}

#[test]
fn a_world_that_offers_it_continues_where_it_was_saved() {
    let config = config(numbered("saves"));
    let mut worlds = Vec::new();
    // Each world has another seed: its state alone must determine how it continues.
    let ended = check_restore("a process", 60, || {
        worlds.push(());
        Box::new(ExecWorld::new(&config, 3, worlds.len() as u64).unwrap())
    });
    assert!(ended > 20, "{ended}");
    // The frames in which the next actions are taken are restored.
    let mut world = ExecWorld::new(&config, 2, 1).unwrap();
    step(&mut world, &[0, 1]);
    let mut other = ExecWorld::new(&config, 2, 2).unwrap();
    other.load(&world.save().unwrap()).unwrap();
    assert_eq!(frames(&mut other), frames(&mut world));
}

#[test]
fn a_state_of_another_world_is_refused_by_name() {
    let world =
        |arguments: &str, copies| ExecWorld::new(&config(numbered(arguments)), copies, 1).unwrap();
    let state = world("saves", 2).save().unwrap();
    let refused = |arguments: &str, copies, state: &[u8], sentences: &[&str]| {
        fails(world(arguments, copies).load(state), sentences);
    };
    let sentences = [
        "it is of the world `exec python3 ",
        "numbered.py saves`, and this is `",
        "saves none other`: give the command",
    ];
    refused("saves none other", 2, &state, &sentences);
    let sentence = "2 environments, and this world has 3";
    refused("saves", 3, &state, &[sentence]);
    for wrong in [
        &state[..state.len() - 1],
        &[state.clone(), vec![0]].concat(),
        &[],
    ] {
        refused("saves", 2, wrong, &["not a state of this world"]);
    }
    // The same command, but the settings of another world.
    let config = ExecConfig {
        height: 13,
        ..config(numbered("saves"))
    };
    let sentence = "the shape of its frames or its actions";
    fails(ExecState::from_bytes(&state, &config, 2), &[sentence]);
}

/// Waits until the system has ended the processes with `mark` in their command line.
fn wait_until_gone(mark: &str) {
    let started = Instant::now();
    while !alive(mark).is_empty() {
        assert!(started.elapsed().as_secs() < 60, "{:?}", alive(mark));
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Returns the processes with `mark` in their command line.
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
    wait_until_gone(&mark);

    // A process that leads another group ends as well.
    let command = "exec timeout 600 sleep 590.5";
    fails(probe_command(command, 200, 1000), &["start_timeout_ms=N"]);
    wait_until_gone("590.5");

    let command = format!("sh -c 'sleep 600; : {mark}' & exit 5");
    probe_command(&command, 60_000, 1000).unwrap_err();
    wait_until_gone(&mark);
}
