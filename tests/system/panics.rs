//! A panic in any thread of any process: the process exits, the launcher names the process and the thread, and nothing is left.
//! In debug builds `DRIML_TEST_PANIC` triggers the panics (`driml_protocol::fail_point`).

use driml_protocol::fail_point;
use driml_tests::{Outcome, in_parallel};

use crate::{LONG, PRIORITISED, system};

/// The launcher itself; the other processes exit after its death.
const LAUNCHER: &str = "launcher";

/// The process's name in the launcher, the fail points in its threads, and the flags of a run with these threads, perhaps in several processes.
static FAIL_POINTS: [(&str, &str, &str); 8] = [
    (
        "replay-server",
        "insert, poll, admit, request, sample, affinity, run-info, join-actor, join-learner, leave, weights-upload, weights, status, \
         report, episodes, missing, members",
        "",
    ),
    ("replay-server", "priorities", PRIORITISED),
    ("replay-server", "replay-fsync", "--durable"),
    (
        "learner",
        "batches, weights-sender, affinity-sender, learner-status",
        "",
    ),
    ("learner", "priorities-sender", PRIORITISED),
    ("actor-0", "weights-watch, delivery", ""),
    ("", "signals, reporter, connecting", ""),
    (LAUNCHER, "interrupts, log of learner", ""),
];

/// Checks that a panic at `point` ends a run.
fn check_panic_ends_run((process, point, flags): (&str, &str, &str)) {
    let system = system();
    let variable = format!("{}={point}", fail_point::PANIC_VAR);
    let run = format!("local --agent driml-ada {LONG} {flags} --run-dir run");
    let ended = system.run(&format!("env '{variable}' DRIML {run}"));
    let contains = |line: &str, words: &str| {
        assert!(line.contains(words), "{point}: {words:?} in {ended:#?}");
    };
    if process == LAUNCHER {
        assert_eq!((ended.code, ended.signal), (None, Some(6)), "{point}");
        let said = format!("error: the thread {point} panicked");
        contains(&ended.stderr, &said);
        return system.wait_until_all_have_ended();
    }
    assert_eq!(system.running_processes(), [], "{point}");
    assert_eq!(ended.code, Some(1), "{point}: {ended:#?}");
    let thread = format!(": the thread {point}");
    let line = ended.stderr.lines().find(|line| line.contains(&thread));
    let line = line.unwrap_or_else(|| panic!("{point}: {ended:#?}"));
    contains(line, " panicked at ");
    let said = format!(": {variable}; this is a bug in the program");
    contains(line, &said);
    let killed = "was killed by signal 6 SIGABRT";
    if process.is_empty() {
        return contains(&ended.stderr, killed);
    }
    contains(&ended.stderr, &format!("error: {process} {killed} (log: "));
    assert_eq!(system.run_folder("run").summary().outcome, Outcome::Failed);
}

#[test]
fn a_panic_in_any_thread_ends_the_run_and_is_named() {
    // Only debug builds have fail points.
    if !cfg!(debug_assertions) {
        return driml_tests::skip("a release build");
    }
    let threads = FAIL_POINTS.iter().flat_map(|(process, points, flags)| {
        let points = points.split(", ");
        points.map(move |point| (*process, point, *flags))
    });
    let threads: Vec<_> = threads.collect();
    // These runs spend more time waiting for processes to end than computing.
    in_parallel(threads.chunks(6), |some| {
        some.iter().copied().for_each(check_panic_ends_run);
    });
}
