//! Too little shared memory, at the start or later: a run warns once, sends its messages through sockets, and succeeds.
//! Mounting a small `/dev/shm` needs root; without root the tests are skipped by name.

use std::process::Command;

use driml_tests::{Exit, succeeds};
use nix::sys::signal::Signal;

use crate::{LONG, chain, disk_full::fill_disk, system};

/// Returns a call of the program that gives it a `/dev/shm` of this size. If that is not permitted, reports the test as skipped.
fn with_shared_memory(size: &str, call: &str) -> Option<String> {
    let mount = format!("mount -t tmpfs -o size={size} tmpfs /dev/shm");
    let mut tried = Command::new("unshare");
    tried.args(["-m", "sh", "-c", &mount]);
    succeeds(&mut tried)
        .then(|| format!("unshare -m sh -c '{mount} && exec \"$0\" \"$@\"' DRIML {call}"))
}

/// Returns the number of warnings that there is too little, or that messages sent through shared memory do not arrive.
fn warnings(ended: &Exit) -> usize {
    let lines = ended.stderr.lines();
    lines.filter(|line| line.contains("shared memory")).count()
}

#[test]
fn too_little_for_all_processes_is_said_once_and_sockets_serve() {
    // zenoh alone takes 1.3 MB for each process.
    for (size, actors, enough) in [
        ("512k", 2, false),
        ("1m", 2, false),
        ("2m", 2, false),
        ("4m", 2, false),
        ("9m", 8, false),
        ("64m", 2, true),
    ] {
        let chain = chain(640);
        let run = format!("local --agent c51 {chain} --actors {actors} --run-dir run");
        let Some(run) = with_shared_memory(size, &run) else {
            return;
        };
        let system = system();
        let ended = system.run_ok(&run);
        assert_eq!(warnings(&ended), usize::from(!enough), "{size}: {ended:#?}");
        if !enough {
            ended
                .expect_stderr("no shared memory, so messages go through sockets, which is slower: /dev/shm has ")
                .expect_stderr(" MiB are needed: make it larger")
                .expect_stderr("--shm-size=1g")
                .expect_stderr("--set transport.shared_memory=false asks for none");
        }
        system.run_folder("run").check_finished();
    }
}

#[test]
fn a_run_continues_when_others_fill_it_up() {
    let system = system();
    let run = system.local_args(&format!("--agent c51 {LONG} --actors 2"));
    let Some(run) = with_shared_memory("64m", &run) else {
        return;
    };
    let mut process = system.start(&run);
    let client = system.connect();
    client.wait_for_updates(100);
    // Wait for all processes, because one that starts when shared memory is full warns, too.
    client.wait_for_replay("both actors", |replay| replay.actors_acting == 2);
    fill_disk(format!("/proc/{}/root/dev/shm/filler", process.pid()));
    let then = client.learner_status().unwrap().updates;
    client.wait_for_updates(then + 200);
    // A process that starts now finds no room.
    system.find_process("actor").signal(Signal::SIGKILL);
    process.wait_for_stderr("(restart 1 of at most 16)");
    process.wait_for_stderr("no shared memory, so messages go through sockets");
    client.wait_for_replay("both actors", |replay| replay.actors == 2);
    client.wait_for_updates(client.learner_status().unwrap().updates + 200);
    drop(client);
    let ended = process.interrupt().expect_code(130);
    assert_eq!(warnings(&ended), 1, "{ended:#?}");
    let log = system.run_folder("run").log("replay-server");
    assert!(!log.contains("panicked"), "{log}");
}
