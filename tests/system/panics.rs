//! A panic in any thread of any process: the process ends, the launcher says which process and thread it was, nothing is left.
//! The panics are asked for with `DRIML_TEST_PANIC`, which debug builds have (`driml_protocol::fail_point`).

use driml_protocol::fail_point;
use driml_tests::Outcome;

use crate::{LONG, PRIORITISED, system};

/// The launcher itself, after whose death the other processes exit.
const LAUNCHER: &str = "launcher";

/// The process's name in the launcher, the point that one of its threads passes, and the flags of a run that has this thread. Where
/// several processes have it, any may be the first.
static THREADS: [(&str, &str, &str); 31] = [
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
    ("", "signals", ""),
    ("", "reporter", ""),
    ("", "connecting", ""),
    (LAUNCHER, "interrupts", ""),
    (LAUNCHER, "log of learner", ""),
];

/// A run with a panic at `point`, to the end.
fn ends_the_run((process, point, flags): (&str, &str, &str)) {
    let system = system();
    let run = format!("local --agent driml-ada {LONG} {flags} --run-dir run");
    let ended = system.start_with(fail_point::VARIABLE, point, &run).wait();
    let contains = |line: &str, words: &str| {
        assert!(line.contains(words), "{point}: {words:?} in {ended:#?}");
    };
    if process == LAUNCHER {
        assert_eq!((ended.code, ended.signal), (None, Some(6)), "{point}");
        contains(
            &ended.stderr,
            &format!("error: the thread {point} panicked"),
        );
        return system.wait_until_all_have_ended();
    }
    assert_eq!(system.survivors(), [], "{point}");
    assert_eq!(ended.code, Some(1), "{point}: {ended:#?}");
    let said = format!(": the thread {point}");
    let line = ended.stderr.lines().find(|line| line.contains(&said));
    let line = line.unwrap_or_else(|| panic!("{point}: {ended:#?}"));
    contains(line, " panicked at ");
    contains(
        line,
        &format!(": {}={point}; this is a fault", fail_point::VARIABLE),
    );
    let killed = "was killed by signal 6 SIGABRT";
    if process.is_empty() {
        return contains(&ended.stderr, killed);
    }
    contains(&ended.stderr, &format!("error: {process} {killed} (log: "));
    assert_eq!(system.run_folder("run").summary().outcome, Outcome::Failed);
}

#[test]
fn a_panic_in_any_thread_ends_the_run_and_is_named() {
    // Only debug builds can be asked to panic.
    if !cfg!(debug_assertions) {
        return driml_tests::skip("a release build");
    }
    // These runs wait for each other's ends more than they compute.
    std::thread::scope(|scope| {
        for some in THREADS.chunks(6) {
            scope.spawn(|| some.iter().copied().for_each(ends_the_run));
        }
    });
}
