//! Limits of the operating system on open files, file sizes and socket names: a run keeps to them, or reports before it starts that it
//! cannot. Shared memory is in `small_shared_memory`.

use std::fs;

use crate::{LONG, SHORT, system};

/// Returns a call of the program under a limit of the shell's `ulimit`, which its children inherit.
fn with_ulimit(limit: &str, call: &str) -> String {
    format!("sh -c 'ulimit {limit} && exec \"$0\" \"$@\"' DRIML {call}")
}

#[test]
fn a_run_with_more_actors_than_files_may_be_open_does_not_start() {
    let system = system();
    let run = |actors| format!("local --agent c51 {SHORT} --actors {actors} --run-dir run");
    let why = "the replay server of a run with 20 actors needs 128 open files, and the system allows 60: raise the limit";
    system.rejects(&with_ulimit("-n 60", &run(20)), why);
    assert!(!system.path("run").exists());
    system.run_ok(&with_ulimit("-n 60", &run(2)));
    // A soft limit is raised if the hard limit permits it.
    let more = run(4).replace("--run-dir run", "--run-dir more");
    system.run_ok(&with_ulimit("-S -n 60", &more));
}

#[test]
fn a_replay_server_warns_if_it_may_not_open_enough_files() {
    let system = system();
    let server = system.replay_server_args(&format!("--agent c51 {LONG} --actors 20"));
    let mut server = system.start_process(&with_ulimit("-n 60", &server));
    server.wait_for_stderr(
        "a replay server for 20 actors needs 128 open files, and the system allows 60: ",
    );
    server.wait_for_stderr("replay server listens on ");
    server.stop(130);
}

#[test]
fn a_file_that_may_not_grow_is_an_error_and_no_end() {
    let system = system();
    let server = system.replay_server_args(&format!("--agent c51 {LONG} --replay-dir replay"));
    // This size is also too small for a segment of shared memory.
    let mut server = system.start_process(&with_ulimit("-f 64", &server));
    server.wait_for_stderr("replay server listens on ");
    let (_learner, _actor) = (system.start_learner("run"), system.start_actor(0));
    server.wait_for_stderr("cannot be written: File too large (os error 27)");
    server.stop(130);
}

#[test]
fn a_temporary_folder_may_have_a_name_too_long_for_a_socket() {
    let system = system();
    let start = system.path("t");
    let folder = format!(
        "{}{}",
        start.display(),
        "t".repeat(95 - start.as_os_str().len())
    );
    fs::create_dir(&folder).unwrap();
    system.run_ok(&format!(
        "env TMPDIR={folder} DRIML local --agent c51 {SHORT} --run-dir run"
    ));
}
