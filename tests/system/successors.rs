//! A learner saves its updates when it exits, unless it is killed; the successor of any learner makes the updates that were planned.
//! `failures` and `resume` test such learners with the launcher.

use driml_tests::{Client, Process, TestSystem};

use crate::{LONG, SHORT, chain, system};

/// The number of versions that a learner may have reported and not sent when it is killed.
const UNSENT_MAX: u64 = 5;

/// A learner that was killed between two checkpoints loses updates; its successor makes them again.
#[test]
fn killed_learners_cost_no_update_of_the_plan() {
    let system = system();
    let longer = chain(1_600);
    let server = system.start_replay_server(&format!(
        "--agent driml-ada {longer} --set learner.checkpoint_period_updates=200"
    ));
    // Pause the learner between two checkpoints: whether it saves one before the kill must not depend on who is faster.
    system.pause_learners_at(390);
    let mut learner = system.start_learner("run");
    let actor = system.start_actor(0);
    let client = system.connect();
    let (mut version, mut forgotten) = (0, 0);
    // Each learner is paused at the first number of updates; its successor, which starts from the checkpoint, at the second.
    for (updates, successor) in [(390, 300), (300, 250), (250, 225)] {
        let killed = client.wait_for_learner("updates", |it| it.updates == updates);
        learner.kill();
        system.pause_learners_at(successor);
        learner = system.start_learner("run");
        let next = client.wait_for_learner("the successor", |it| it.weights_version > version);
        // A learner reports a version when it queues it: a killed learner may not have sent the last ones, and versions that no actor has
        // seen may come again. The version in its checkpoint is far lower.
        let is_taken = next.weights_version + UNSENT_MAX > killed.weights_version;
        assert!(is_taken, "{killed:#?} {next:#?}");
        version = next.weights_version;
        // The version of an affinity counts updates, so the successor's affinity is in use.
        let replay = client.wait_for_replay("the successor's affinity", |replay| {
            (200..killed.updates).contains(&replay.affinity_version)
        });
        assert!(replay.rows_unlearned > forgotten, "{replay:#?}");
        forgotten = replay.rows_unlearned;
    }
    system.release_learners();
    let learned = client.wait_for_the_last_update();
    let replay = client.check_nothing_lost();
    let planned = (replay.transitions_inserted - 200) * 8 / 16;
    assert_eq!(learned.updates, planned, "{replay:#?}");
    assert_eq!(replay.rows_sampled, 16 * planned);
    actor.wait_ok();
    learner.stop(0).expect_stderr("resumed after ");
    drop(client);
    server.stop(0);

    // A run with other settings cannot resume from the checkpoint in the folder.
    let server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    let learner = system.start_learner("run");
    learner.fails("resume with the settings it was made with");
    server.stop(130);
}

/// Starts a run by hand, and waits until the learner has made more than 75 updates; the first checkpoint is due after 1,000.
fn start_between_checkpoints(system: &TestSystem, flags: &str) -> (Process, Process, Client) {
    let server = system.start_replay_server(&format!(
        "--agent c51 {LONG} --set learner.checkpoint_period_updates=1000 {flags}"
    ));
    let learner = system.start_learner("run");
    let client = system.connect();
    let actor = system.start_actor(0);
    client.wait_for_updates(75);
    actor.stop(130);
    (server, learner, client)
}

#[test]
fn a_learner_whose_replay_server_is_gone_saves() {
    let system = system();
    let patience = "--set learner.unreachable_max_ms=1000";
    let (server, learner, client) = start_between_checkpoints(&system, patience);
    drop(client);
    server.kill();
    learner.fails("no batch and no answer for 1s");
    assert!(system.run_folder("run").saved_updates() > 75);
}

/// A new replay server at the same endpoint knows nothing of the run: all processes exit, and a learner with a checkpoint resumes its counts.
#[test]
fn a_run_whose_replay_server_was_started_again_is_resumed_by_its_learner() {
    let system = system();
    let (server, learner, client) = start_between_checkpoints(&system, "");
    let actor = system.start_actor(1);
    // An actor without weights would wait for them, and not notice the new server.
    client.wait_for_replay("a second actor", |replay| {
        (replay.actors, replay.actors_acting) == (1, 2)
    });
    drop(client);
    server.kill();
    let server = system.start_replay_server(&format!(
        "--agent c51 {LONG} --set learner.checkpoint_period_updates=1000"
    ));
    learner.fails("this replay server does not know the learner: the server has restarted");
    let saved = system.run_folder("run").saved_updates();
    assert!(saved > 75);
    actor.fails("does not know this incarnation of actor 1: the server has restarted");

    let learner = system.start_learner("run");
    let actor = system.start_actor(0);
    let client = system.connect();
    client.wait_for_updates(saved);
    let replay = client.replay_status().unwrap();
    assert_eq!(replay.transitions_refilled, 200, "the warm-up: {replay:#?}");
    assert!(replay.transitions_inserted > 200 + 2 * saved, "{replay:#?}");
    assert!(replay.rows_sampled >= 16 * saved, "{replay:#?}");
    assert_eq!(replay.updates_relearned, 0, "{replay:#?}");
    for process in [actor, learner, server] {
        process.stop(130);
    }
}

/// If the run has made updates, a learner without its checkpoint is rejected unless it is told to restart. A finished run admits none.
#[test]
fn a_learner_without_the_runs_checkpoint_is_rejected_and_may_restart() {
    let system = system();
    let (server, learner, client) = start_between_checkpoints(&system, "");
    learner.kill();
    let args = |flags: &str| system.connect_args(&format!("learner --run-dir elsewhere {flags}"));
    let why = "and the learner has no checkpoint of it: start the learner with the --run-dir that holds its checkpoints";
    system.fails(&args(""), why);
    let before = client.replay_status().unwrap();
    assert!(before.updates > 75, "{before:#?}");
    let restarted = system.start(&args("--keep-alive --restart"));
    let replay = client.wait_for_replay("updates that are learned again", |replay| {
        replay.updates_relearned > 75
    });
    assert!(replay.rows_unlearned >= 16 * 75, "{replay:#?}");
    restarted.stop(130);
    server.stop(130);
    drop(client);

    let server = system.start_replay_server(&format!("--agent c51 {SHORT}"));
    let learner = system.start(&system.connect_args("learner --run-dir short"));
    let actor = system.start_actor(0);
    let client = system.connect();
    let replay = client.wait_for_replay("the run's end", |replay| replay.learner_finished);
    assert_eq!(replay.updates, 540);
    system.fails(&args(""), "the run is finished, with 540 updates");
    learner.wait_ok();
    actor.wait_ok();
    server.stop(0);
}
