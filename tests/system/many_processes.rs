//! Many processes at once: actors that wait at a closed limiter, and two processes with the same role.
//! One server with one actor is in `by_hand`; dying processes are in `failures`.

use std::time::{Duration, Instant};

use driml_tests::{Outcome, wait_until};

use crate::{LONG, PATIENT, chain, system};

/// A replay ratio of 64 makes the learner so slow that every actor waits nearly all of the time.
#[test]
fn twenty_four_actors_wait_for_one_learner() {
    let system = system();
    let chain = chain(2_400);
    let flags = format!("--agent c51 {chain} {PATIENT} --actors 24 --set replay.replay_ratio=64");
    // Pause the learner, so that even on a fast machine the run does not end before the last actor waits.
    system.pause_learners_at(100);
    let process = system.start(&system.local_args(&flags));
    system
        .connect()
        .wait_for_replay("24 actors that wait", |replay| replay.actors_waiting == 24);
    system.release_learners();
    let ended = process.wait_ok();
    let summary = system.run_folder("run").check_finished();
    assert_eq!(summary.replay.chunks_retried, 0, "{summary:#?}");
    // While the machine stalls, the learner may lose a batch, and warns of it.
    let is_of_actors = |it: &&str| it.contains("WARN") && !it.contains("a batch");
    assert_eq!(ended.stderr.lines().find(is_of_actors), None);
}

/// The limiter stays closed for twice the time-out for an unreachable server, and no actor times out. After Ctrl-C the replay server
/// stores what all actors still have.
#[test]
fn actors_wait_for_as_long_as_they_must_and_then_deliver_what_they_have() {
    const UNREACHABLE_MAX: Duration = Duration::from_millis(3_000);
    let system = system();
    let waiting = "--set replay.replay_ratio=65536 --set actor.unreachable_max_ms=3000";
    let flags = format!("--agent c51 {LONG} {PATIENT} --actors 32 {waiting}");
    let process = system.start(&system.local_args(&flags));
    let client = system.connect();
    let before = client.wait_for_replay("32 that wait", |replay| replay.actors_waiting == 32);
    // The warm-up, the slack by which actors may run ahead of the learner, and the chunk that overshoots.
    assert!(before.transitions_inserted <= 200 + 256 + 32, "{before:#?}");
    let started = Instant::now();
    wait_until("twice the time that an actor bears silence", || {
        started.elapsed() > 2 * UNREACHABLE_MAX
    });
    let after = client.replay_status().unwrap();
    assert_eq!(after.actors_waiting, 32, "{after:#?}");
    assert_eq!(after.transitions_inserted, before.transitions_inserted);
    drop(client);
    process.interrupt().expect_code(130);
    let summary = system.run_folder("run").check(Outcome::Interrupted);
    assert!(summary.frames > after.transitions_inserted, "{summary:#?}");
    assert_eq!(summary.replay.chunks_retried, 0, "{summary:#?}");
    assert_eq!(system.running_processes(), []);
}

#[test]
fn of_two_processes_with_one_role_the_second_waits_for_the_first_one_s_end() {
    let system = system();
    let _server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    let learner = system.start_learner("first");
    let actor = system.start_actor(3);
    let client = system.connect();
    client.wait_for_updates(10);
    let mut second = system.start_learner("second");
    second.wait_for_stderr("another learner takes part in this run, which has only one");
    second.stop(130);
    assert!(system.run_folder("second").checkpoints().is_empty());

    let mut second = system.start_actor(3);
    second.wait_for_stderr(
        "another process is actor 3 of this run: give each actor another number (--id)",
    );
    // The first actor still plays.
    let before = client.replay_status().unwrap();
    client.wait_for_transitions(before.transitions_inserted);
    actor.stop(130).expect_stderr("leaves: ");
    second.wait_for_stderr("actor 3 steps 4 environments");
    second.stop(130);
    let status = client.replay_status().unwrap();
    assert_eq!((status.transitions_lost, status.messages_refused), (0, 0));
    learner.stop(130);
}
