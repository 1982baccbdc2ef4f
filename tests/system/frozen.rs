//! One suspended process (Ctrl-Z, a debugger, a paused container): the others continue, and wait for it only for a limited time.
//! A run that is suspended as a whole is in `closed_terminal`, an actor whose launcher died in `durable`.

use std::time::{Duration, Instant};

use driml_protocol::Silence;
use driml_tests::{Exit, Outcome, Process, in_parallel, wait_until};
use nix::sys::signal::Signal;

use crate::{LONG, SHORT, failures::interrupt_until_it_ends, system};

/// Runs all checks at the same time, because each waits for time-outs of up to a minute.
#[test]
fn a_frozen_process_does_not_hold_the_others_up() {
    let checks: [fn(); 4] = [
        || {
            let killed = "did not exit within 1 min 0 s and was killed";
            a_complete_run_is_finished(|run| run.wait().expect_stderr(killed));
        },
        // After the first interrupt the launcher waits for the actor, after the second it does not.
        || a_complete_run_is_finished(interrupt_until_it_ends),
        a_replay_server_ends_without_its_actor,
        a_frozen_actor_does_not_stop_the_others,
    ];
    in_parallel(checks, |check| check());
}

/// Suspends one of two actors, and ends the run once the learner has made its last update.
fn a_complete_run_is_finished(end: impl FnOnce(Process) -> Exit) {
    let system = system();
    // Pause the learner, so that the run does not end before its second actor plays. An actor that has only joined may hold the lock under
    // which all processes of the machine allocate shared memory, and frozen it would keep it.
    system.pause_learners_at(100);
    let flags = format!("--agent c51 {SHORT} --actors 2");
    let process = system.start(&system.local_args(&flags));
    let client = system.connect();
    client.wait_for_replay("both actors", |replay| replay.actors_acting == 2);
    system.find_process("actor").signal(Signal::SIGSTOP);
    system.release_learners();
    client.wait_for_the_last_update();
    end(process).expect_code(0).expect_stdout("finished: ");
    system.check_outcome(Outcome::Finished);
}

fn a_replay_server_ends_without_its_actor() {
    let system = system();
    let server = format!("replay-server --agent c51 {SHORT}");
    let server = system.start_process(&system.listen_args(&server));
    let mut frozen = system.start_actor(1);
    frozen.wait_for_stderr("waiting for the learner's first weights");
    frozen.signal(Signal::SIGSTOP);
    let learner = system.start_process(&system.connect_args("learner --run-dir run"));
    system.start_actor(0).wait_ok();
    learner.wait_ok();
    server.wait_ok().expect_stderr("the run is over; processes");
    frozen.kill();
}

/// Makes the weights 5 MB and publishes them after each update, so that a frozen process is likely in the middle of a pull.
const LARGE: &str = "--set model.hidden=4096 --set learner.publish_period_updates=1";

/// An actor that is suspended during its work delays the others only for seconds, and continues when it receives SIGCONT.
fn a_frozen_actor_does_not_stop_the_others() {
    let system = system();
    let _server = system.start_replay_server(&format!("--agent c51 {LONG} {LARGE}"));
    let mut learner = system.start_learner("run");
    let [mut healthy, mut frozen] = [0, 1].map(|id| system.start_actor(id));
    let client = system.connect();
    client.wait_for_replay("both actors", |replay| replay.actors_acting == 2);
    let version = client.wait_for_updates(0).weights_version;
    client.wait_for_learner("weights to pull", |it| it.weights_version > version + 5);
    frozen.signal(Signal::SIGSTOP);
    // Wait well beyond the time-out of a blocked link, but less than the session's lease, which would end the session anyway. Of a time in
    // which the whole machine stood still, at most 5 s count.
    let mut waited = Silence::with_gap_max(Duration::from_secs(5));
    let mut late = |after_s| waited.record_failure() > Duration::from_secs(after_s);
    let rows = || {
        let asked = Instant::now();
        let status = client.replay_status().expect("an answer");
        assert!(asked.elapsed() < Duration::from_secs(10), "a late answer");
        status.rows_sampled
    };
    wait_until("the time that a link may stand still", || late(12));
    let before = rows();
    wait_until("batches while an actor is frozen", || {
        assert!(!late(25), "none after {before} rows");
        rows() > before
    });
    assert!(learner.is_running() && healthy.is_running() && frozen.is_running());
    frozen.signal(Signal::SIGCONT);
    let others = client.replay_status().unwrap().transitions_inserted;
    client.wait_for_transitions(others + 500);
    for actor in [healthy, frozen] {
        actor.stop(130).expect_stderr("leaves: ");
    }
    client.check_nothing_lost();
    learner.stop(130);
}
