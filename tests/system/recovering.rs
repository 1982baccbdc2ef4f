//! A replay server that reads back a long log: all processes receive the progress, wait, and continue; nothing is lost or stored twice.
//! The log is real, and its server gets little processor time, as on a slow machine. The program contains no delay for these tests.

use std::{fs, path::Path, thread, time::Duration};

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, End, InsertReply, ReplayStatus, RunInfo, RunSpec, Shutdown,
    WeightsUpload, config::Settings,
};
use driml_replay_server::{Config, PersistArgs, Replay};
use driml_tests::{Client, Process, TestSystem, check_has, new_learner, wait_for, wait_until};
use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};
use serde_json::Value;

use crate::{
    refusals::{Row, batch_request, check_replies, upload},
    status::status_text,
    system, tiny_replay, tls_system,
};

/// Transitions in a log, one record each. A slow machine reads them for longer than the time-out for an unreachable server.
const KEPT: u64 = 400_000;
const WARMUP: u64 = 192;
/// The updates of a run that continues with the log: one of 16 rows for 1,024 transitions after the warm-up.
const PLANNED_UPDATES: u64 = KEPT / 1024 + 15;
const PLANNED_FRAMES: u64 = WARMUP + 1024 * PLANNED_UPDATES;
/// The time-out for an unresponsive server in these runs, in seconds.
const UNREACHABLE_MAX_S: f64 = 5.0;
/// What a waiting process logs.
const WAITING_LOG: &str =
    "waiting for as long as it takes: the replay server reads its replay back from disk, ";

/// Returns flags without shared memory: a slow process would hold the lock of `/dev/shm` for seconds, for which other tests wait.
fn flags() -> String {
    let capacity = KEPT + 100_000;
    format!(
        "--agent c51 --env chain --preset smoke --frames {PLANNED_FRAMES} --set replay.replay_ratio=0.015625 \
         --set replay.warmup_transitions={WARMUP} --set replay.capacity_transitions={capacity} --set replay.slack_transitions=2048 \
         --set actor.unreachable_max_ms=5000 --set learner.unreachable_max_ms=5000 --set transport.shared_memory=false"
    )
}

/// Writes [`KEPT`] transitions of another actor into the log in `folder`, for a run with these settings. Returns the run spec.
fn write_log(folder: &Path, config_toml: &str) -> RunSpec {
    let settings = Settings::parse(config_toml).unwrap();
    let spec: RunSpec = settings.table("run").unwrap();
    let mut config: Config = settings.table("replay").unwrap();
    // Lets the inserts run ahead of the learner.
    (config.slack_transitions, config.transitions_max) = (1 << 40, None);
    let args = PersistArgs {
        dir: folder.to_owned(),
        segment_bytes: Some(1 << 18),
        ..PersistArgs::default()
    };
    let (mut replay, _) = Replay::open(&args, &spec, &config, 16).unwrap();
    tiny_replay::join_actor(&mut replay, 9);
    let mut header = tiny_replay::header(&spec, 9, 1, 1);
    for sequence in 0..KEPT {
        (header.sequence, header.first_transition) = (sequence, sequence);
        let mut chunk = Chunk::zeroed(header);
        chunk.set(0, 0, 0.0, End::Running);
        let reply = replay.insert(&chunk);
        assert!(matches!(reply, InsertReply::Stored { .. }), "{reply:?}");
    }
    spec
}

/// Makes a log in the folder `replay`. Returns the run spec, and the flags of a replay server that reads the log.
fn prepare_log(system: &TestSystem) -> (RunSpec, String) {
    let flags = flags();
    let server = system.start_replay_server(&flags);
    let client = system.connect();
    let spec = write_log(&system.path("replay"), &client.config_toml);
    drop(client);
    server.stop(130);
    (spec, format!("{flags} --replay-dir replay"))
}

/// Keeps a process slow until this value is dropped: it is stopped for 98 of 100 ms.
struct SlowMachine(Shutdown);

impl SlowMachine {
    fn for_process(pid: i32) -> Self {
        let done = Shutdown::default();
        let until = done.clone();
        let signal = move |signal| {
            // The process may have ended.
            let _ = kill(Pid::from_raw(pid), signal);
        };
        thread::spawn(move || {
            loop {
                signal(Signal::SIGSTOP);
                let is_done = until.wait_timeout(Duration::from_millis(98));
                signal(Signal::SIGCONT);
                if is_done || until.wait_timeout(Duration::from_millis(2)) {
                    return;
                }
            }
        });
        Self(done)
    }
}

impl Drop for SlowMachine {
    fn drop(&mut self) {
        self.0.set();
    }
}

/// Slows a server down, and waits until it has begun to read.
fn slow_down(server: &mut Process) -> SlowMachine {
    let slow = SlowMachine::for_process(server.pid());
    server.wait_for_stderr("reads the replay in ");
    slow
}

/// Starts a replay server that is stopped until it is slowed down, so that it cannot have read everything before.
fn start_stopped(system: &TestSystem, flags: &str) -> Process {
    let server = system.replay_server_args(flags);
    system.start_process(&format!(
        "sh -c 'kill -STOP $$; exec \"$0\" \"$@\"' DRIML {server}"
    ))
}

/// Returns the server's progress as `driml status --json` prints it; `None` once the server has read everything.
fn recovery_progress(system: &TestSystem) -> Option<Value> {
    let answer = system.run(&system.connect_args("status --json")).json();
    let recovering = answer["servers"][0]["recovering"].clone();
    if recovering.is_null() {
        return None;
    }
    assert_eq!(answer["healthy"], true);
    Some(recovering)
}

/// Checks that the server puts off every kind of request.
fn check_postponed(system: &TestSystem, spec: &RunSpec) {
    let run = system.run_client(spec);
    let client = Client {
        session: run.session().clone(),
        keys: run.keys().clone(),
        spec: spec.clone(),
        config_toml: String::new(),
    };
    let postponed = "the replay server reads its replay back from disk, ";
    let chunk = client.encode_chunk(&Chunk::zeroed(tiny_replay::header(spec, 5, 1, 1)));
    let weights = upload(spec.hash(), 99, 1, b"weights");
    let rows = [
        Row::new(client.keys.actor_key::<ChunkHeader>(5), chunk, postponed),
        Row::new(client.keys.key::<WeightsUpload>(), weights, postponed),
        Row::of(&client, &batch_request(99, 16), postponed),
        Row::of(&client, &ActorJoin::new(5, 1), postponed),
        Row::of(&client, &new_learner(99), postponed),
        Row::new(client.keys.key::<RunInfo>(), [], postponed),
        Row::new(client.keys.key::<ReplayStatus>(), [], postponed),
    ];
    check_replies(&client, rows);
}

/// All checks share one log, which the last check damages.
#[test]
fn a_long_log_is_read_back() {
    let system = system();
    let (spec, serve) = prepare_log(&system);
    let server = a_server_that_reads_is_stopped_and_started_again(&system, &serve);
    all_processes_wait_for_a_server_that_reads_its_replay_back(&system, &spec, &serve, server);
    a_server_with_an_unreadable_log_ends(&system, &serve);
}

/// Processes wait beyond the time-out for an unreachable server: some were there when the server died, others start while it reads. One of
/// these takes the place of an actor that died with the server.
fn all_processes_wait_for_a_server_that_reads_its_replay_back(
    system: &TestSystem,
    spec: &RunSpec,
    serve: &str,
    server: Process,
) {
    let mut learner = system.start_learner("run");
    let mut actors = vec![system.start_actor(0)];
    let dies_too = system.start_actor(1);
    let client = system.connect();
    client.wait_for_replay("both actors", |replay| replay.actors == 2);
    client.wait_for_updates(50);
    drop(client);
    server.kill();
    dies_too.kill();

    let mut server = start_stopped(system, serve);
    let slow = slow_down(&mut server);
    let first = recovery_progress(system).expect("it has a long log");
    check_postponed(system, spec);
    let words = [
        "chain, c51: frames ?/",
        "replay-server recovering ",
        "recovering: the run continues once its replay is read back from disk",
    ];
    check_has(&status_text(system), &words);
    system.run_ok(&system.connect_args("status"));
    let mut watched =
        system.start(&system.connect_args("watch --run-dir seen --prometheus run.prom"));
    watched.wait_for_stderr(": reads its replay back from disk, ");
    let prometheus = system.path("run.prom");
    fs::remove_file(&prometheus).unwrap();
    wait_until("the file again", || prometheus.exists());
    assert!(recovery_progress(system).is_some(), "it still reads");
    actors.push(system.start_actor(1));
    actors[1].wait_for_stderr(WAITING_LOG);
    actors[0].wait_for_stderr("the replay server reads its replay back from disk, ");
    learner.wait_for_stderr("the replay server reads its replay back from disk, ");
    let last = wait_for("more than the limit for an absent server", || {
        let now = recovery_progress(system).expect("the log is long enough");
        (now["since_s"].as_f64() > Some(UNREACHABLE_MAX_S + 3.0)).then_some(now)
    });
    let read = |it: &Value| it["bytes_read"].as_u64();
    assert!(read(&last) > read(&first) && last["bytes"] == first["bytes"]);
    assert!(read(&last) < last["bytes"].as_u64(), "{last}");
    drop(slow);

    for actor in actors {
        actor.wait_ok();
    }
    let client = system.connect();
    let status = client.wait_for_the_last_update();
    let replay = client.check_nothing_lost();
    assert_eq!(status.updates, PLANNED_UPDATES);
    assert_eq!(replay.rows_sampled, 16 * PLANNED_UPDATES);
    assert_eq!(replay.transitions_inserted, PLANNED_FRAMES);
    assert_eq!(replay.actors_acting, 3, "9, 0 and 1, and never 5");
    watched.wait_ok();
    check_has(&system.read("run.prom"), &["\ndriml_updates_total{"]);
    let seen = system.run_folder("seen").summary();
    assert_eq!(seen.updates, PLANNED_UPDATES);
    learner.stop(0);
    drop(client);
    let exit = server.stop(0);
    exit.expect_stderr("continues with the replay in replay");
}

/// A server that is told to stop exits, however much is left to read. The next server reads everything, and is returned.
fn a_server_that_reads_is_stopped_and_started_again(system: &TestSystem, serve: &str) -> Process {
    let mut server = start_stopped(system, serve);
    let slow = slow_down(&mut server);
    let mut actor = system.start_actor(0);
    actor.wait_for_stderr(WAITING_LOG);
    let exit = server.stop(130);
    exit.expect_stderr("it was stopped while it read its replay back");
    drop(slow);
    actor.stop(130);
    let server = system.start_replay_server(serve);
    let replay = system.connect().replay_status().unwrap();
    assert_eq!(replay.transitions_inserted, KEPT);
    server
}

/// The server exits with an error, and no process waits for it any more.
fn a_server_with_an_unreadable_log_ends(system: &TestSystem, serve: &str) {
    for entry in fs::read_dir(system.path("replay")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|it| it == "log") {
            fs::write(path, "no log").unwrap();
        }
    }
    let server = system.start_replay_server(serve);
    let ended = server.wait().expect_code(64);
    ended.expect_stderr("no segment can be read");
}

#[test]
fn a_resumed_run_shows_how_far_its_server_is() {
    let system = system();
    let mut process = system.start(&system.local_args(&format!("--durable {}", flags())));
    system.connect().wait_for_updates(10);
    process.stop(130);
    let run = system.run_folder("run");
    let config = system.read("run/config.toml");
    write_log(&run.path().join("replay"), &config);
    let stored = run.summary().replay.transitions_inserted + KEPT;
    let frames = WARMUP + (stored + 2_000).next_multiple_of(1024);

    process = system.start(&format!("local --resume run --frames {frames}"));
    let slow = SlowMachine::for_process(system.find_process("replay-server").pid);
    process.wait_for_stderr("replay-server: reads its replay back from disk, ");
    drop(slow);
    process.wait_ok();
    let summary = run.check_finished();
    let updates = (frames - WARMUP) / 1024;
    assert_eq!((summary.frames, summary.updates), (frames, updates));
    assert_eq!(system.running_processes(), []);
}

/// Each role receives the progress in place of the reply.
#[test]
fn roles_are_told_too() {
    let Some(system) = tls_system() else { return };
    let (_, serve) = prepare_log(&system);
    let mut server = system.start_replay_server(&serve);
    let slow = slow_down(&mut server);
    let [mut actor, mut learner] = [system.start_actor(0), system.start_learner("run")];
    for role in [&mut actor, &mut learner] {
        role.wait_for_stderr(WAITING_LOG);
    }
    check_has(&status_text(&system), &["replay-server recovering "]);
    drop(slow);
    actor.wait_ok();
    system.connect().wait_for_the_last_update();
    learner.stop(0);
    server.stop(0);
}
