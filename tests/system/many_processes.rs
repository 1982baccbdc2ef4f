//! Many processes at once: actors that wait at a closed limiter, and two processes with the same role.
//! One server with one actor is in `by_hand`; dying processes are in `failures`.

use std::time::{Duration, Instant};

use driml_actor::DeliveryLimits;
use driml_protocol::Shutdown;
use driml_tests::{Outcome, wait_until};

use crate::{LONG, PATIENT, chain, synthetic::SyntheticActor, system, tiny_replay};

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

/// After Ctrl-C while all actors wait, the replay server stores what they still have.
#[test]
fn actors_that_wait_deliver_what_they_have_when_they_are_told_to_stop() {
    let system = system();
    let waiting = "--set replay.replay_ratio=512 --set replay.warmup_transitions=2000";
    let flags = format!("--agent c51 {LONG} {PATIENT} --actors 32 {waiting}");
    let process = system.start(&system.local_args(&flags));
    system
        .connect()
        .wait_for_replay("32 actors that wait", |replay| replay.actors_waiting == 32);
    process.interrupt().expect_code(130);
    let summary = system.run_folder("run").check(Outcome::Interrupted);
    assert_eq!(summary.replay.chunks_retried, 0, "{summary:#?}");
    assert_eq!(system.running_processes(), []);
}

/// The limiter never opens, as without a learner, for longer than the time-out for an unreachable server. Waiting actors do not time out.
#[test]
fn an_actor_waits_for_as_long_as_it_must() {
    let system = system();
    let _server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    let client = system.connect();
    let (unreachable_max, stop) = (Duration::from_secs(3), Shutdown::default());
    let limits = DeliveryLimits {
        chunks_in_flight_max: 4,
        ack_timeout: Duration::from_secs(60),
        unreachable_max,
    };
    let synthetic = |actor| {
        client.join_as_actor(actor, 1);
        let first = tiny_replay::header(&client.spec, actor, 4, 8);
        SyntheticActor::start(system.run_client(&client.spec), first, limits, &stop)
    };
    let actors: Vec<_> = (0..16).map(synthetic).collect();
    let produced: u64 = std::thread::scope(|scope| {
        // Each actor sends as fast as it may, then delivers the rest, although nothing makes room.
        let run = |mut actor: SyntheticActor| {
            while !stop.is_set() {
                actor.send(0);
            }
            actor.finish()
        };
        let runs = actors
            .into_iter()
            .map(|actor| scope.spawn(move || run(actor)));
        let runs: Vec<_> = runs.collect();
        let before = client.wait_for_replay("16 that wait", |replay| replay.actors_waiting == 16);
        // The warm-up, the slack by which actors may run ahead of the learner, and the chunk that overshoots.
        assert!(before.transitions_inserted <= 200 + 256 + 32, "{before:#?}");
        let started = Instant::now();
        wait_until("twice the time that an actor bears silence", || {
            started.elapsed() > 2 * unreachable_max
        });
        let after = client.replay_status().unwrap();
        assert_eq!((after.actors_waiting, after.chunks_retried), (16, 0));
        assert_eq!(after.transitions_inserted, before.transitions_inserted);
        stop.set();
        runs.into_iter().map(|run| run.join().unwrap()).sum()
    });
    let status = client.replay_status().unwrap();
    assert_eq!(status.transitions_inserted, produced, "{status:#?}");
    assert_eq!((status.transitions_lost, status.messages_refused), (0, 0));
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
