//! Custom worlds in whole runs: the actor starts the world's process. Also the errors if that process fails.
//! The protocol between an actor and such a process is tested with the code of the worlds.

use std::{fs, path::Path, process::Command};

use driml_tests::{check_has, python, skipped_offline, succeeds, wait_until};
use nix::sys::signal::Signal;

use crate::{
    failures::interrupt_until_it_ends, lockstep::continues_exactly, repo_rules::root, system,
};

/// The preset `smoke`, and the settings that a world with frames of 12 x 12 needs.
const SMALL_WORLD: &str =
    "--preset smoke --set run.frame_stack=2 --set model.conv=[{out=8,kernel=4,stride=2}]";

/// Returns the path of a file of this repository.
fn repo_file(name: &str) -> String {
    root().join(name).display().to_string()
}

/// Returns the command of a world whose frames contain their own number. Needs only `python3`.
fn numbered_world(fault: &str) -> String {
    let script = repo_file("tests/worlds/numbered.py");
    format!("exec:exec python3 {script} {fault}")
}

/// Returns the flags of a run of `c51` in this world.
fn c51_in(env: &str, frames: u32) -> String {
    format!("{SMALL_WORLD} --agent c51 --frames {frames} --env '{env}'")
}

#[test]
fn a_process_of_one_s_own_trains_repeats_and_is_evaluated() {
    let system = system();
    let env = numbered_world("hang $HANG_AT");
    let flags = format!("{SMALL_WORLD} --agent driml-ada --frames 1280 --env '{env}'");
    let limit = "--set world.step_timeout_ms=50000";
    let summary = system.train(&format!("{flags} {limit} --actors 2"), "run");
    assert_eq!(summary.frames, 1280);
    // Each episode of a copy lasts three to six steps.
    assert!(summary.episodes > 200, "{summary:#?}");
    let run = system.run_folder("run");
    let config = run.config();
    assert_eq!(config["run"]["world"].as_str(), Some(env.as_str()));
    assert_eq!(config["world"]["actions"].as_array().unwrap().len(), 3);
    let limit = &config["world"]["step_timeout_ms"];
    assert_eq!(limit.as_integer(), Some(50_000));
    // One actor may play all frames before the other's world has started.
    let logs = ["actor-0", "actor-1"].map(|actor| run.log(actor)).concat();
    check_has(&logs, &["a line on stdout does no harm"]);

    let lockstep = |args: &str, name: &str| {
        let run = system.train(&format!("--lockstep {args}"), name);
        run.weights_sha256
    };
    let first = lockstep(&flags, "first");
    assert_eq!(first, lockstep("--config first/config.toml", "again"));
    let ended = system.run_ok("evaluate run --episodes 8");
    // Each episode ends with a reward of 1000; each step before gives at most 2.
    let agent = ended.stdout.lines().nth(1).unwrap();
    assert!(agent.contains("mean return 10"), "{agent}");
    assert_eq!(system.running_processes(), []);
    let mut hanging = system.start("env HANG_AT=2 DRIML evaluate run --record play.gif");
    hanging.wait_for_stderr("sleeping");
    hanging.stop(130);
    assert!(!system.path("play.gif.tmp").exists());
    system.wait_until_all_have_ended();
}

/// The interrupted round waits for the world until `world.step_timeout_ms`.
#[test]
fn a_run_in_lockstep_whose_world_hangs_says_how_to_exit_at_once() {
    let system = system();
    let flags = format!("{SMALL_WORLD} --env '{}'", numbered_world("hang 25"));
    let mut process = system.start(&format!("local --lockstep {flags} --agent c51"));
    process.wait_for_stderr("sleeping");
    process.signal(Signal::SIGINT);
    process.wait_for_stderr("Ctrl-C again exits at once");
    let stopped = interrupt_until_it_ends(process).expect_code(1);
    stopped.expect_stderr("stopped at once by a second interrupt");
}

#[test]
fn a_process_that_saves_its_state_continues_exactly_in_lockstep() {
    let env = numbered_world("saves");
    continues_exactly(&format!("{SMALL_WORLD} --agent driml-ada --env '{env}'"));
}

#[test]
fn a_process_that_cannot_save_its_state_says_so_and_is_repeated() {
    let run = |fault| {
        let flags = c51_in(&numbered_world(fault), 640);
        format!("local --lockstep {flags} --run-dir run")
    };
    let never = "cannot save its state: the dragon sits on it";
    for (fault, sentence) in [
        ("", "this world's state cannot be saved"),
        ("saves never", never),
    ] {
        let system = system();
        let ended = system.run_ok(&run(fault));
        assert!(!ended.stdout.contains("--resume"), "{}", ended.stdout);
        ended
            .expect_stderr(sentence)
            .expect_stderr(": the run cannot be resumed, only repeated");
        let cannot =
            "the run in run cannot be resumed, because the state of its world cannot be saved";
        system.rejects("local --resume run --frames 1280", cannot);
        let run = system.run_folder("run");
        run.check_finished();
        assert!(!run.path().join("replay").exists());
    }
    // A world that fails to save its state ends the run.
    let why = "wrote a state of 67108865 bytes; 67108864 are possible";
    system().fails(&run("saves large"), why);
}

/// The last chunk, of eight steps of four copies, waits for thousands of updates when the world fails. The worlds' own tests have the
/// sentences of other faults.
#[test]
fn a_world_that_fails_ends_the_run_with_a_sentence_and_what_was_played_is_stored() {
    let system = system();
    let flags = c51_in(&numbered_world("raise 25"), 100_000);
    let slow_learner = "--set replay.replay_ratio=8192 --set replay.warmup_transitions=32 --set replay.slack_transitions=1";
    let run = format!("local {flags} {slow_learner} --run-dir run");
    system.fails(&run, "the dragon got out");
    assert_eq!(system.running_processes(), []);
    // On a slow machine the actor is restarted, and plays the same number of frames again.
    let frames = system.run_folder("run").summary().frames;
    assert!(frames > 0 && frames.is_multiple_of(3 * 8 * 4), "{frames}");
}

#[test]
fn an_actor_starts_no_command_that_was_not_named_on_its_machine() {
    let system = system();
    let env = numbered_world("");
    let server = system.start_replay_server(&c51_in(&env, 1280));
    let learner = system.start_learner("run");
    system
        .start_actor(0)
        .wait()
        .expect_code(64)
        .expect_stderr("an actor starts no program that only the replay server names")
        .expect_stderr("--env \"exec:exec python3 ");
    let actor = |flags: &str| system.start_process(&system.connect_args(&format!("actor {flags}")));
    let rejected = actor("--env chain").wait().expect_code(64);
    rejected.expect_stderr("and not chain");
    // An actor whose world takes long to start stops at once, and with the run.
    let slow = "--env 'exec:echo starts >&2; exec sleep 1000'";
    let [mut stopped, mut starting] = [2, 3].map(|id| actor(&format!("--id {id} {slow}")));
    stopped.wait_for_stderr("starts");
    stopped.stop(130);
    // The same world by another command, as another machine may have it. This world will hang.
    let mut hanging = actor(&format!("--id 1 --env '{}'", numbered_world("hang 50")));
    let client = system.connect();
    client.wait_for_replay("the actor", |replay| replay.actors == 2);
    hanging.wait_for_stderr("sleeping");
    // A world's process that ignores its pipes does not outlive its actor, however the actor ends.
    let worlds = || {
        let is_world = |word: &String| word.ends_with("numbered.py");
        let all = system.running_processes().into_iter();
        all.filter(|it| it.args.iter().any(is_world)).count()
    };
    assert_eq!(worlds(), 1);
    hanging.kill();
    wait_until("the world's end", || worlds() == 0);
    starting.wait_for_stderr("starts");
    actor(&format!("--id 1 --env '{env}'")).wait_ok();
    starting.wait_ok();
    client.wait_for_the_last_update();
    drop(client);
    learner.stop(0);
    server.stop(0);
    system.wait_until_all_have_ended();
}

/// An actor that its replay server no longer knows does not ask on until its world has started.
#[test]
fn an_actor_that_is_unknown_when_its_world_starts_exits() {
    let system = system();
    let flags = c51_in(&numbered_world(""), 1280);
    let server = system.start_replay_server(&flags);
    let _learner = system.start_learner("run");
    let slow = "actor --env 'exec:echo starts >&2; exec sleep 1000'";
    let mut actor = system.start_process(&system.connect_args(slow));
    actor.wait_for_stderr("starts");
    server.kill();
    let _server = system.start_replay_server(&flags);
    actor.fails("does not know this incarnation of actor 0");
}

/// The log tells a server that is started again the size of its replay, and the first settings what the world declares and the preset costs.
#[test]
fn a_replay_server_that_is_started_again_starts_its_world_once() {
    let system = system();
    let env = numbered_world("").replace("exec:", "exec:echo >>starts; ");
    let kept = "--replay-dir replay --set replay.compression=lz4";
    let flags = c51_in(&env, 1280).replace("smoke", "fast");
    for (starts, limit) in [(1, "--set replay.compressed_bytes_max=50000"), (2, "")] {
        let server = system.start_replay_server(&format!("{flags} {kept} {limit}"));
        let config = &system.connect().config_toml;
        check_has(config, &["compressed_bytes_max = 50000\n"]);
        check_has(&server.stderr(), &["WARN fast: "]);
        assert_eq!(system.read("starts").lines().count(), starts);
        server.kill();
    }
}

/// Returns a Python with Gymnasium and ALE, installed once into cargo's folder for tests. If pip fails, reports the test as skipped.
fn gymnasium() -> Option<String> {
    if skipped_offline() {
        return None;
    }
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("gymnasium");
    let python = folder.join("bin/python").display().to_string();
    let ready = folder.join("ready");
    fs::create_dir_all(&folder).unwrap();
    let lock = fs::File::create(folder.join("lock")).unwrap();
    lock.lock().unwrap();
    if !ready.exists() {
        let requirements = repo_file("deploy/python/requirements.txt");
        let script = format!(
            "python3 -m venv {0} && {0}/bin/pip install --quiet --disable-pip-version-check -r {requirements}",
            folder.display()
        );
        if !succeeds(Command::new("sh").args(["-c", &script])) {
            return None;
        }
        fs::write(&ready, "").unwrap();
    }
    Some(python)
}

#[test]
fn atari_by_gymnasium_trains() {
    let Some(python) = gymnasium() else { return };
    let system = system();
    let script = repo_file("deploy/python/driml_env.py");
    let env = format!("exec:{python} {script} ALE/Pong-v5 --atari");
    let flags = format!("--preset smoke --agent c51 --frames 480 --env '{env}'");
    assert_eq!(system.train(&flags, "run").frames, 480);
    let config = system.run_folder("run").config();
    let names = config["world"]["actions"].as_array().unwrap();
    assert_eq!((names.len(), names[0].as_str()), (6, Some("NOOP")));
    for side in ["height", "width"] {
        assert_eq!(config["world"][side].as_integer(), Some(84));
    }
    assert_eq!(config["world"]["channels"].as_integer(), Some(1));
    assert_eq!(system.running_processes(), []);
}

/// The states of ALE's emulator, wrappers and random generators are restored.
#[test]
fn atari_continues_exactly_in_lockstep() {
    let Some(python) = gymnasium() else { return };
    let script = repo_file("deploy/python/driml_env.py");
    let env = format!("exec:{python} {script} ALE/Breakout-v5 --atari --clip --size 20");
    continues_exactly(&format!("{SMALL_WORLD} --agent driml-ada --env '{env}'"));
}

/// Runs the adapter's own test, which needs Gymnasium: all autoreset modes of vector environments, seeds, shapes, and rejected worlds.
#[test]
fn the_adapter_keeps_gymnasium_s_episodes() {
    let Some(python) = gymnasium() else { return };
    python::run_script(&python, &[&repo_file("tests/worlds/check_adapter.py")], &[]);
}
