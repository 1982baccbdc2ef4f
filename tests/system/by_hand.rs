//! Processes started by hand in terminals: they share only an endpoint, and signals end them.
//! These runs have no launcher.

use std::fs;

use driml_protocol::Waiting;
use driml_tests::{Process, TestSystem, check_nothing_lost};
use nix::sys::signal::Signal::{SIGHUP, SIGINT, SIGTERM};

use crate::{
    LONG, SHORT,
    closed_terminal::skipped_under_nohup,
    failures::interrupt_until_it_ends,
    leftovers::{check_removed, shared_memory},
    system, tls_system,
};

/// Starts a run by hand, and checks that its processes find each other and exit in order.
fn check_whole_run(system: &TestSystem) {
    let server = system.start_replay_server(&format!("--agent driml-ada {SHORT}"));
    let client = system.connect();
    let learner = system.start_learner("run");
    // Actors learn from the replay server that the run is complete, and exit.
    for (id, actor) in [0, 2].map(|id| (id, system.start_actor(id))) {
        let leaves = format!("actor {id} leaves: ");
        actor.wait_ok().expect_stderr(&leaves);
    }
    let status = client.wait_for_the_last_update();
    let replay = client.check_nothing_lost();
    assert_eq!(replay.waiting, Waiting::Finished);
    // No process asked for more than its role allows.
    assert_eq!((status.updates, replay.messages_refused), (540, 0));
    let counts = (replay.transitions_inserted, replay.rows_sampled);
    assert_eq!(counts, (1280, 8640));
    let affinity = replay.affinity_version;
    assert!(affinity > 0, "the learner's affinity arrived");
    let run = system.run_folder("run");
    assert_eq!(run.checkpoint_sha256(), status.weights_sha256);

    learner.stop(0).expect_stderr("finished after 540 updates");
    // The learner's run folder can be evaluated like that of a launched run.
    system.run_ok("evaluate run --episodes 5");
    // The learner stayed alive after the end of the run, so its stop does not make the run unfinished.
    client.wait_for_replay("the end of the run", |it| it.learner_finished);
    drop(client);
    let exit = server.stop(0);
    exit.expect_stderr("stops with 1280 transitions stored");
    assert_eq!(system.running_processes(), []);
}

#[test]
fn processes_find_each_other_and_end_in_order() {
    check_whole_run(&system());
}

#[test]
fn so_they_do_over_tls() {
    if let Some(system) = tls_system() {
        check_whole_run(&system);
    }
}

/// Two shards; a run of one replay server is in `watch`.
#[test]
fn processes_end_by_themselves_when_the_run_is_over() {
    let system = system();
    let endpoints = [0, 1].map(|shard| system.socket_endpoint(&format!("e\u{301}{shard}")));
    let flags = format!("--agent driml-ada --replay-shards 2 --actors 2 {SHORT}");
    // Pause the learner, so that the run does not end before both actors play.
    system.pause_learners_at(100);
    let mut calls = Vec::new();
    for (shard, endpoint) in endpoints.iter().enumerate() {
        calls.push(format!(
            "replay-server --listen {endpoint} --shard {shard} {flags}"
        ));
        calls.push(format!("actor --connect {endpoint} --id {shard}"));
    }
    let all = endpoints.join(" --connect ");
    calls.push(format!("learner --connect {all} --run-dir run"));
    let mut processes: Vec<_> = calls.iter().map(|it| system.start_process(it)).collect();
    for actor in [1, 3] {
        processes[actor].wait_for_stderr("steps 4 environments");
    }
    system.release_learners();
    for process in processes {
        process.wait_ok();
    }
    assert_eq!(system.running_processes(), []);
    system.run_ok("evaluate run --episodes 2");
}

#[test]
fn a_second_interrupt_ends_a_process_at_once() {
    let system = system();
    let server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    let learner = system.start_learner("run");
    // Without `--exit-with-parent`: a launcher signals its processes more than once.
    let mut actor = system.start(&system.connect_args("actor --id 0"));
    actor.wait_for_stderr("steps 4 environments");
    system.connect().wait_for_updates(1);
    server.kill();
    learner.kill();
    // It tries for 20 s to deliver its chunks.
    actor.signal(SIGTERM);
    let ended = interrupt_until_it_ends(actor).expect_code(130);
    ended.expect_stderr("stopped at once by a second signal");
}

/// Tests each signal that a shell, a service manager or a closed ssh session sends.
#[test]
fn processes_that_are_told_to_stop_lose_nothing_and_leave_no_shared_memory() {
    for signal in [SIGTERM, SIGINT, SIGHUP] {
        if signal == SIGHUP && skipped_under_nohup() {
            continue;
        }
        let system = system();
        let mut server = system.start_replay_server(&format!("--agent c51 {LONG}"));
        let mut learner = system.start_learner("run");
        let mut actors = [0, 1].map(|id| system.start_actor(id));
        for actor in &mut actors {
            actor.wait_for_stderr("steps 4 environments");
        }
        let client = system.connect();
        client.wait_for_updates(100);
        client.wait_for_replay("both actors", |replay| replay.actors == 2);
        let segments = shared_memory(&system);
        let ends = |process: Process, says: &str| {
            process.signal(signal);
            process.wait().expect_code(130).expect_stderr(says)
        };
        for (id, actor) in (0..).zip(actors) {
            ends(actor, &format!("actor {id} leaves: "));
        }
        let replay = client.wait_for_replay("the actors' absence", |replay| replay.actors == 0);
        check_nothing_lost(&replay);
        let continue_alone = learner.is_running() && server.is_running();
        assert!(continue_alone, "they do not depend on actors");
        // The learner makes the updates that the replay ratio allows, then waits. On a signal it saves a checkpoint.
        client.wait_for_replay("a waiting learner", |replay| {
            replay.waiting == Waiting::LearnerWaitsForActors
        });
        // A client may hold shared memory that it has received.
        drop(client);
        ends(learner, "saved run/checkpoints/checkpoint-").expect_stderr("stopped after ");
        assert!(!system.run_folder("run").checkpoints().is_empty());
        ends(server, "replay server stops");
        check_removed(&segments);
    }
}

/// A process started by hand also sets the environment variables that candle and the C library read. Variables set by the user stay.
#[test]
fn a_process_by_hand_settles_its_environment() {
    let system = system();
    let server = system.replay_server_args("--env chain --preset smoke");
    let variables = "env -u MALLOC_ARENA_MAX CANDLE_NUM_THREADS=3";
    let mut server = system.start_process(&format!("{variables} DRIML {server}"));
    server.wait_for_stderr("replay server listens on ");
    let environ = fs::read_to_string(format!("/proc/{}/environ", server.pid())).unwrap();
    let has = |variable: &str| environ.split('\0').any(|it| it == variable);
    assert!(has("MALLOC_ARENA_MAX=2") && has("MALLOC_TRIM_THRESHOLD_=10000000000"));
    assert!(has("CANDLE_NUM_THREADS=3"));
    server.stop(130);
}
