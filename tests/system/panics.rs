//! A panic in any thread of any process: the process ends, the launcher says which process and thread it was, nothing is left.
//! The panics are asked for with `DRIML_TEST_PANIC`, which debug builds have (`driml_protocol::fail_point`).

use driml_protocol::fail_point;
use driml_tests::{Ended, Outcome, TestSystem};

use crate::{LONG, PRIORITISED, system};

/// The process's name in the launcher, the point that one of its threads passes, and the flags of a run that has this thread.
static THREADS: [(&str, &str, &str); 26] = [
    ("replay-server", "insert", ""),
    ("replay-server", "poll", ""),
    ("replay-server", "admit", ""),
    ("replay-server", "request", ""),
    ("replay-server", "sample", ""),
    ("replay-server", "affinity", ""),
    ("replay-server", "run-info", ""),
    ("replay-server", "join-actor", ""),
    ("replay-server", "join-learner", ""),
    ("replay-server", "leave", ""),
    ("replay-server", "weights-upload", ""),
    ("replay-server", "weights", ""),
    ("replay-server", "status", ""),
    ("replay-server", "report", ""),
    ("replay-server", "episodes", ""),
    ("replay-server", "missing", ""),
    ("replay-server", "members", ""),
    ("learner", "batches", ""),
    ("learner", "weights-sender", ""),
    ("learner", "affinity-sender", ""),
    ("learner", "learner-status", ""),
    ("actor-0", "weights-watch", ""),
    ("actor-0", "delivery", ""),
    ("replay-server", "priorities", PRIORITISED),
    ("learner", "priorities-sender", PRIORITISED),
    ("replay-server", "replay-fsync", "--durable"),
];

/// Runs with a panic at `point`, to the end.
fn panicking(system: &TestSystem, point: &str, flags: &str) -> Ended {
    let run = format!("local --agent driml-ada {LONG} {flags} --run-dir run");
    let ended = system.start_with(fail_point::VARIABLE, point, &run).wait();
    assert_eq!(system.survivors(), [], "{point}");
    let said = format!(": the thread {point}");
    let line = ended.stderr.lines().find(|line| line.contains(&said));
    let asked = format!(": {}={point}; this is a fault", fail_point::VARIABLE);
    assert!(
        line.is_some_and(|it| it.contains(" panicked at ") && it.contains(&asked)),
        "{point}: {ended:#?}"
    );
    ended
}

/// A thread that panics at `point`, after which the launcher names the process.
fn ends_the_run((process, point, flags): (&str, &str, &str)) {
    let system = system();
    let ended = panicking(&system, point, flags);
    assert_eq!(ended.code, Some(1), "{point}: {ended:#?}");
    let said = format!("error: {process} was killed by signal 6 SIGABRT (log: ");
    assert!(ended.stderr.contains(&said), "{said:?} in {ended:#?}");
    assert_eq!(system.run_folder("run").summary().outcome, Outcome::Failed);
}

/// Only debug builds can be asked to panic; a line says that a test is skipped in others.
fn skipped() -> bool {
    if !cfg!(debug_assertions) {
        driml_tests::skip("a release build");
    }
    !cfg!(debug_assertions)
}

#[test]
fn a_panic_in_a_process_ends_it_and_the_launcher_names_it() {
    if skipped() {
        return;
    }
    // These runs wait for each other's ends more than they compute.
    std::thread::scope(|scope| {
        for some in THREADS.chunks(5) {
            scope.spawn(|| some.iter().copied().for_each(ends_the_run));
        }
    });
}

/// More than one process has these threads, so any may be the first.
#[test]
fn a_panic_in_a_thread_of_several_processes_ends_the_run() {
    if skipped() {
        return;
    }
    for point in ["signals", "reporter", "connecting"] {
        let ended = panicking(&system(), point, "");
        assert_eq!(ended.code, Some(1), "{point}: {ended:#?}");
        ended.expect_said("was killed by signal 6 SIGABRT");
    }
}

/// The launcher itself, after whose death the other processes exit.
#[test]
fn a_panic_in_the_launcher_ends_the_run() {
    if skipped() {
        return;
    }
    for point in ["interrupts", "log of learner"] {
        let system = system();
        let run = format!("local --agent driml-ada {LONG} --run-dir run");
        let ended = system.start_with(fail_point::VARIABLE, point, &run).wait();
        assert_eq!(
            (ended.code, ended.signal),
            (None, Some(6)),
            "{point}: {ended:#?}"
        );
        let said = format!("error: the thread {point} panicked");
        assert!(ended.stderr.contains(&said), "{point}: {ended:#?}");
        system.wait_until_all_have_ended();
    }
}
