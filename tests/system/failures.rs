//! Runs that end early: Ctrl-C, a process that dies, a launcher that dies. No process is ever left.
//! Successors of dead processes are in `by_hand` (actors) and `successors` (learners); a single Ctrl-C is in `resume`.

use std::{fs, process::Command};

use driml_tests::{Exit, Outcome, Process, wait_until};
use nix::sys::signal::Signal;

use crate::{
    LONG, PROCESSES, SHORT,
    leftovers::{check_removed, shared_memory},
    start_run, system,
};

#[test]
fn a_second_interrupt_ends_at_once() {
    let system = system();
    let mut process = start_run(&system, 100);
    // After the first interrupt, the launcher would wait for minutes for this unresponsive learner.
    system.find_process("learner").signal(Signal::SIGSTOP);
    process.signal(Signal::SIGINT);
    process.wait_for_stderr("Ctrl-C again exits at once");
    interrupt_until_it_ends(process)
        .expect_code(1)
        .expect_stderr("stopped at once by a second interrupt: what was not saved is lost");
    system.check_outcome(Outcome::Failed);
}

/// Sends SIGINT until the process ends, because signals at nearly the same time count as one request.
pub(crate) fn interrupt_until_it_ends(mut process: Process) -> Exit {
    wait_until("the launcher's end", || {
        let is_over = !process.is_running();
        if !is_over {
            process.signal(Signal::SIGINT);
        }
        is_over
    });
    process.wait()
}

/// The interrupt comes before any process handles signals.
#[test]
fn an_interrupt_at_the_start_is_an_interrupt() {
    let system = system();
    for _ in 0..3 {
        let process = system.start(&format!("local --agent c51 {SHORT} --run-dir run"));
        system.find_process("replay-server");
        let ended = process.interrupt().expect_code(130);
        assert!(!ended.stderr.contains("error:"), "{}", ended.stderr);
        ended.expect_stdout("no episode ended");
        system.check_outcome(Outcome::Interrupted);
        // On a busy machine the learner has saved its first weights, and the next round must not use the folder.
        fs::remove_dir_all(system.path("run")).unwrap();
    }
}

#[test]
fn a_run_whose_folder_is_gone_says_what_is_lost() {
    let system = system();
    let process = start_run(&system, 100);
    fs::rename(system.path("run"), system.path("elsewhere")).unwrap();
    let ended = process.fails("missing: run/config.toml, run/metrics.csv, run/episodes.csv");
    assert!(!ended.stderr.contains("resumes it"), "{}", ended.stderr);
    assert_eq!(system.running_processes(), []);

    // A run in lockstep looks at its files, too.
    let system = crate::system();
    system.pause_learners_at(100);
    let process = system.start(&format!("local --lockstep {SHORT} --run-dir run"));
    system.run_folder("run").wait_for_updates(10);
    fs::remove_file(system.path("run/metrics.csv")).unwrap();
    system.release_learners();
    let ended = process.fails("start the run again; missing: run/metrics.csv");
    assert!(!ended.stderr.contains("episodes.csv"), "{}", ended.stderr);
}

#[test]
fn dead_processes_end_the_run_and_leave_no_shared_memory() {
    for (dead, named) in [
        (&["learner"][..], "error: learner"),
        (&["replay-server"], "error: replay-server"),
        (&PROCESSES, ""),
    ] {
        let system = system();
        let process = start_run(&system, 100);
        let segments = shared_memory(&system);
        let dead = dead.iter().map(|role| system.find_process(role));
        let dead: Vec<_> = dead.collect();
        dead.iter().for_each(|it| it.signal(Signal::SIGKILL));
        process
            .fails(&format!("{named} was killed by signal 9 SIGKILL (log: "))
            .expect_stderr("`driml train --resume run` resumes it");
        system.check_outcome(Outcome::Failed);
        check_removed(&segments);
    }
}

/// The launcher is stopped until the learner has saved and exited.
#[test]
fn updates_count_that_the_learner_saved_and_could_not_report() {
    let system = system();
    let process = start_run(&system, 100);
    process.signal(Signal::SIGSTOP);
    let client = system.connect();
    client.wait_for_updates(client.learner_status().unwrap().updates + 100);
    system.find_process("learner").signal(Signal::SIGTERM);
    let has_ended = || system.find_process_now("learner").is_none();
    wait_until("the learner's end", has_ended);
    process.signal(Signal::SIGCONT);
    process.fails("error: learner exited with code 130");
    let run = system.run_folder("run");
    assert_eq!(run.summary().updates, run.saved_updates());
}

/// A successor would count episodes from zero, and have other ghosts than the run's schedule.
#[test]
fn a_dead_actor_whose_ghosts_change_ends_the_run() {
    let system = system();
    let flags = "--env mspacman --agent c51 --preset smoke --frames 100000 --actors 1";
    let changing = "--set world.lethal_schedule={episodes_per_task=5,order=[0,1]}";
    let process = system.start(&system.local_args(&format!("{flags} {changing}")));
    system.connect().wait_for_transitions(0);
    system.find_process("actor").signal(Signal::SIGKILL);
    process
        .fails("error: actor-0 was killed by signal 9 SIGKILL (log: ")
        .expect_stderr("actor-0 cannot be restarted, so start the run again: the ghosts");
    system.check_outcome(Outcome::Failed);
}

/// All processes notice the launcher's death at once. The replay server stays until the others have delivered what they have and left.
#[test]
fn processes_whose_launcher_died_deliver_what_they_have() {
    /// A launcher of three processes, each with a file for its output.
    const LAUNCHER: &str = "sh -c '
        driml=$1 endpoint=$2; shift 2
        $driml replay-server --listen $endpoint $* --exit-with-parent $$ 2> server &
        $driml learner --connect $endpoint --run-dir run --exit-with-parent $$ 2> learner &
        $driml actor --connect $endpoint --id 0 --exit-with-parent $$ 2> actor &
        wait' sh";
    let system = system();
    let args = format!("{} --agent c51 {LONG}", system.endpoint());
    let launcher = system.start(&format!("{LAUNCHER} DRIML {args}"));
    system.connect().wait_for_updates(100);
    launcher.signal(Signal::SIGKILL);
    system.wait_until_all_have_ended();
    for (role, words) in [
        ("actor", "actor 0 leaves: "),
        ("learner", "stopped after "),
        ("server", "told to stop; processes still connected: 0"),
    ] {
        let stderr = system.read(role);
        assert!(stderr.contains(words), "{stderr}");
        assert!(!stderr.contains("did not receive this actor's"), "{stderr}");
    }
}

#[test]
fn a_process_whose_launcher_died_before_it_looked_ends() {
    let mut launcher = Command::new("true").spawn().unwrap();
    launcher.wait().unwrap();
    let system = system();
    let parent = launcher.id();
    let server = format!("replay-server {SHORT} --exit-with-parent {parent}");
    system
        .run(&system.listen_args(&server))
        .expect_code(130)
        .expect_stderr("replay server stops");
}
