//! What a run leaves outside its folder, in the temporary folder and in shared memory: nothing, however it ended; or until the
//! next run starts, if all its processes were killed. A killed launcher's learner saves what it has learned.

use std::{fs, path::PathBuf};

use driml_tests::{Process, Survivor, TestSystem};
use nix::sys::signal::Signal;

use crate::{LONG, PROCESSES, SHORT, disk_full::NEVER, launched, system};

/// A run whose temporary folder is `tmp` in the system's.
fn local(system: &TestSystem, flags: &str) -> String {
    let folder = system.path("tmp");
    format!("env TMPDIR={} DRIML local {flags}", folder.display())
}

/// A run of [`local`] that has learned something and saved nothing, and its processes.
fn started(system: &TestSystem) -> (Process, [Survivor; 3]) {
    fs::create_dir(system.path("tmp")).unwrap();
    let never = format!("--set learner.checkpoint_period_updates={NEVER}");
    let flags = format!("--agent driml-ada {LONG} {never} --run-dir run");
    let process = system.start(&local(system, &flags));
    let run = system.run_folder("run");
    run.wait_for_updates(100);
    (process, PROCESSES.map(|role| system.find_process(role)))
}

fn temporary(system: &TestSystem) -> Vec<PathBuf> {
    let entries = fs::read_dir(system.path("tmp")).unwrap();
    entries.map(|entry| entry.unwrap().path()).collect()
}

#[test]
fn a_killed_launcher_leaves_its_checkpoints_and_nothing_else() {
    let system = system();
    let (process, processes) = started(&system);
    let segments = all_shared_memory_of(&processes);
    assert_eq!(temporary(&system).len(), 1);
    process.kill();
    system.wait_until_all_have_ended();
    assert!(system.run_folder("run").saved_updates() > 100);
    assert_eq!(temporary(&system), [] as [PathBuf; 0]);
    check_gone(&segments);
}

#[test]
fn the_next_run_sweeps_what_killed_processes_left() {
    let system = system();
    let (process, processes) = started(&system);
    let segments = all_shared_memory_of(&processes);
    system.kill_all();
    process.wait();
    system.wait_until_all_have_ended();
    assert_eq!(temporary(&system).len(), 1, "nothing could remove it");
    let next = format!("--agent c51 {SHORT} --run-dir next");
    system.run_ok(&local(&system, &next));
    assert_eq!(temporary(&system), [] as [PathBuf; 0]);
    check_gone(&segments);
}

#[test]
fn processes_started_by_hand_leave_no_shared_memory() {
    let system = system();
    let server = system.start_replay_server(&format!("--agent driml-ada {LONG}"));
    let learner = system.start_learner("run");
    let actor = system.start_actor(0);
    let client = system.connect();
    client.wait_for_updates(100);
    let segments = all_shared_memory_of(&PROCESSES.map(|role| system.find_process(role)));
    // A client may hold what it has seen.
    drop(client);
    for process in [actor, learner, server] {
        process.stop_ok();
    }
    check_gone(&segments);
}

#[test]
fn shared_memory_of_killed_processes_is_removed() {
    let system = system();
    let process = launched(&system, 100);
    let processes = PROCESSES.map(|role| system.find_process(role));
    let segments = all_shared_memory_of(&processes);
    processes.iter().for_each(|it| it.signal(Signal::SIGKILL));
    process.wait().expect_code(1);
    check_gone(&segments);
}

/// The shared memory that the processes have open.
fn all_shared_memory_of(processes: &[Survivor]) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for process in processes {
        let maps = fs::read_to_string(format!("/proc/{}/maps", process.pid)).unwrap();
        let paths = maps
            .lines()
            .filter_map(|line| line.split_whitespace().nth(5));
        files.extend(paths.filter(|it| it.ends_with(".zenoh")).map(PathBuf::from));
    }
    files.dedup();
    assert!(files.len() > 1, "the processes share memory: {files:?}");
    files
}

fn check_gone(files: &[PathBuf]) {
    let left: Vec<&PathBuf> = files.iter().filter(|file| file.exists()).collect();
    assert!(left.is_empty(), "{left:?}");
}
