//! A learner that ends, however it ends, has saved what it learned; one that comes after it makes the updates that were planned.
//! How the launcher sees it is in `failures` and `resume`.

use driml_tests::{Client, Process, TestSystem};
use nix::sys::signal::Signal;

use crate::{LONG, SHORT, system};

/// Versions that a learner may have named and not sent when it is killed.
const UNSENT_MAX: u64 = 5;

/// A learner that was killed between two checkpoints has forgotten updates; its successor makes them again.
#[test]
fn killed_learners_cost_no_update_of_the_plan() {
    let system = system();
    let longer = SHORT.replace("--frames 1280", "--frames 5120");
    let server = system.start_replay_server(&format!(
        "--agent driml-ada {longer} --set learner.checkpoint_period_updates=200"
    ));
    let mut learner = system.start_learner("run");
    let actor = system.start_actor(0);
    let client = system.connect();
    let (mut version, mut forgotten) = (0, 0);
    for updates in [250, 300, 350] {
        client.wait_for_learner("updates", |it| it.updates > updates);
        let killed = client.learner().unwrap();
        learner.signal(Signal::SIGKILL);
        learner.wait();
        learner = system.start_learner("run");
        let next = client.wait_for_learner("the successor", |it| it.weights_version > version);
        // A learner names a version when it hands it over: the last ones may not have left the one that was killed, and what
        // nobody has seen may come again. Its checkpoint's version is far below.
        assert!(
            next.weights_version + UNSENT_MAX > killed.weights_version,
            "actors take the successor's weights: {killed:#?} {next:#?}"
        );
        version = next.weights_version;
        // Versions of A count updates: it is the successor's that is in use.
        let replay = client.wait_for_replay("the successor's affinity", |replay| {
            (200..killed.updates).contains(&replay.affinity_version)
        });
        assert!(replay.rows_unlearned > forgotten, "{replay:#?}");
        forgotten = replay.rows_unlearned;
    }
    let learned = client.wait_for_learner("the last update", |it| it.finished);
    let replay = client.replay().unwrap();
    let planned = (replay.transitions_inserted - 200) * 8 / 16;
    assert_eq!(learned.updates, planned, "{replay:#?}");
    assert_eq!(replay.rows_sampled, 16 * planned);
    actor.wait().expect_code(0);
    learner.stop().expect_code(0);
    drop(client);
    server.stop().expect_code(0);
}

/// A run by hand whose learner has made more than 75 updates since its last checkpoint.
fn between_checkpoints(system: &TestSystem, flags: &str) -> (Process, Process, Client) {
    let server = system.start_replay_server(&format!(
        "--agent c51 {LONG} --set learner.checkpoint_period_updates=1000 {flags}"
    ));
    let learner = system.start_learner("run");
    let client = system.connect();
    let actor = system.start_actor(0);
    client.wait_for_learner("updates", |it| it.updates > 75);
    actor.stop();
    (server, learner, client)
}

fn newest_checkpoint(system: &TestSystem) -> u64 {
    let newest = system.run_folder("run").checkpoints().pop().unwrap();
    let name = newest.file_name().unwrap().to_str().unwrap().to_owned();
    name.strip_prefix("checkpoint-").unwrap().parse().unwrap()
}

#[test]
fn a_learner_whose_replay_server_is_gone_saves() {
    let system = system();
    let patience = "--set learner.unreachable_max_ms=1000";
    let (server, learner, client) = between_checkpoints(&system, patience);
    drop(client);
    server.signal(Signal::SIGKILL);
    server.wait();
    learner
        .wait()
        .expect_code(1)
        .expect_said("no batch and no answer for 1s");
    assert!(newest_checkpoint(&system) > 75);
}

/// A new replay server at the same place knows nothing of the run: nobody may go on with it as if it were the old one.
#[test]
fn a_learner_whose_replay_server_was_started_anew_saves_and_says_so() {
    let system = system();
    let (server, learner, client) = between_checkpoints(&system, "");
    let actor = system.start_actor(1);
    // One without weights would wait for these, and hear nothing of a new server.
    client.wait_for_replay("a second actor", |replay| {
        (replay.actors, replay.actors_acting) == (1, 2)
    });
    drop(client);
    server.signal(Signal::SIGKILL);
    server.wait();
    let server = system.start_replay_server(&format!(
        "--agent c51 {LONG} --set learner.checkpoint_period_updates=1000"
    ));
    learner
        .wait()
        .expect_code(1)
        .expect_said("this replay server does not know the learner: it was started anew");
    let saved = newest_checkpoint(&system);
    assert!(saved > 75);
    actor
        .wait()
        .expect_code(1)
        .expect_said("does not know this life of actor 1: it was started anew");

    // Its successor would count the updates twice, and says what to do.
    system
        .run(&format!(
            "learner --stay --connect {} --run-dir run",
            system.endpoint()
        ))
        .expect_code(1)
        .expect_said(&format!(
            "start the replay server with --after-updates {saved}"
        ));
    server.stop().expect_code(0);
}
