//! A run leaves nothing outside its folder, neither in the temporary folder nor in shared memory, however it ended.
//! If all its processes were killed, the next run removes what they left. After a killed launcher, the learner still saves a checkpoint.
//! The shared memory of single processes that end is also checked in `failures` and `by_hand`.

use std::{fs, path::PathBuf};

use driml_tests::{Process, TestSystem};

use crate::{LONG, PROCESSES, SHORT, disk_full::PERIOD_NEVER, system};

/// Returns the call of a run whose temporary folder is `tmp` in the system's folder.
fn local_call(system: &TestSystem, flags: &str) -> String {
    let folder = system.path("tmp");
    format!("env TMPDIR={} DRIML local {flags}", folder.display())
}

/// Starts a run of [`local_call`] that has made updates and saved no checkpoint. Returns the run and its shared memory files.
fn start_without_checkpoint(system: &TestSystem) -> (Process, Vec<PathBuf>) {
    fs::create_dir(system.path("tmp")).unwrap();
    let never = format!("--set learner.checkpoint_period_updates={PERIOD_NEVER}");
    let flags = format!("--agent driml-ada {LONG} {never} --run-dir run");
    let process = system.start(&local_call(system, &flags));
    system.run_folder("run").wait_for_updates(100);
    assert_eq!(system.file_names("tmp").len(), 1);
    (process, shared_memory(system))
}

#[test]
fn a_killed_launcher_leaves_its_checkpoints_and_nothing_else() {
    let system = system();
    let (process, segments) = start_without_checkpoint(&system);
    process.kill();
    system.wait_until_all_have_ended();
    assert!(system.run_folder("run").saved_updates() > 100);
    assert_eq!(system.file_names("tmp"), [] as [&str; 0]);
    check_removed(&segments);
}

/// The next run finishes, and leaves nothing outside its folder either.
#[test]
fn the_next_run_sweeps_what_killed_processes_left() {
    let system = system();
    let (process, segments) = start_without_checkpoint(&system);
    system.kill_all();
    process.wait();
    system.wait_until_all_have_ended();
    assert_eq!(system.file_names("tmp").len(), 1, "nothing could remove it");
    let next = format!("--agent c51 {SHORT} --run-dir next");
    system.pause_learners_at(100);
    let process = system.start(&local_call(&system, &next));
    system.run_folder("next").wait_for_updates(50);
    let own = shared_memory(&system);
    system.release_learners();
    process.wait_ok();
    assert_eq!(system.file_names("tmp"), [] as [&str; 0]);
    check_removed(&[segments, own].concat());
}

/// Returns the shared memory files that the processes of a run have open.
pub(crate) fn shared_memory(system: &TestSystem) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for role in PROCESSES {
        let process = system.find_process(role).pid;
        let maps = fs::read_to_string(format!("/proc/{process}/maps")).unwrap();
        let paths = maps
            .lines()
            .filter_map(|line| line.split_whitespace().nth(5));
        files.extend(paths.filter(|it| it.ends_with(".zenoh")).map(PathBuf::from));
    }
    files.dedup();
    assert!(files.len() > 1, "the processes share memory: {files:?}");
    files
}

pub(crate) fn check_removed(files: &[PathBuf]) {
    let left: Vec<&PathBuf> = files.iter().filter(|file| file.exists()).collect();
    assert!(left.is_empty(), "{left:?}");
}
