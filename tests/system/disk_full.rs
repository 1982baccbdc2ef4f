//! Run folders and replays on disks that are full or read-only: the run continues, logs the error once, and exits with the first error.
//! The disk is a small one in memory. Mounting it needs root; without root the tests are skipped by name.

use std::{
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
    process::Command,
};

use driml_protocol::ActorJoin;
use driml_tests::{Outcome, Process, TestSystem, check_has, succeeds, wait_for, wait_until};
use nix::sys::signal::Signal;

use crate::{
    LONG, SHORT,
    refusals::{Row, check_replies},
    status::{status_text, wait_for_status},
    system,
};

/// A small disk. Dropping the value unmounts it.
struct Disk {
    folder: PathBuf,
}

impl Disk {
    /// Mounts a disk of `kib` KiB at `folder`. If that fails, returns `None` and reports the test as skipped.
    fn mount(folder: PathBuf, kib: u32) -> Option<Self> {
        fs::create_dir(&folder).unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &format!("size={kib}k"), "tmpfs"]);
        succeeds(mount.arg(&folder)).then(|| Self { folder })
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount")
            .arg("--lazy")
            .arg(&self.folder)
            .status();
    }
}

/// Writes a file until the disk is full.
pub(crate) fn fill_disk(file: impl AsRef<Path>) {
    let mut file = File::create(file).unwrap();
    while file.write_all(&[0; 4096]).is_ok() {}
}

/// A checkpoint period that no run reaches, in updates.
pub(crate) const PERIOD_NEVER: u32 = 100_000_000;

/// Calls `test` with a run that has made updates and has logged that its disk is full; the path is that of the file that fills the disk.
/// The run saves a checkpoint every `checkpoint_period` updates. Then checks that no process and no temporary file is left.
fn with_full_disk(checkpoint_period: u32, test: impl FnOnce(&TestSystem, Process, PathBuf)) {
    let system = system();
    let Some(_disk) = Disk::mount(system.path("disk"), 3_000) else {
        return;
    };
    let period = format!("--set learner.checkpoint_period_updates={checkpoint_period}");
    let run = format!("local --agent c51 {LONG} {period} --run-dir disk/run");
    let mut process = system.start(&system.listen_args(&run));
    system.connect().wait_for_updates(100);
    let filler = system.path("disk/filler");
    fill_disk(&filler);
    process.wait_for_stderr("No space left");
    test(&system, process, filler);
    assert_eq!(system.running_processes(), []);
    for folder in ["disk/run", "disk/run/checkpoints"] {
        let names = system.file_names(folder);
        let temporary = names.iter().find(|name| name.contains("tmp"));
        assert_eq!(temporary, None);
    }
}

/// Rows of metrics wait until there is room, and a checkpoint that finds none is tried again.
#[test]
fn a_run_continues_while_the_disk_is_full() {
    with_full_disk(200, |system, process, filler| {
        let client = system.connect();
        let then = client.learner_status().unwrap().updates;
        client.wait_for_updates(then + 600);
        fs::remove_file(filler).unwrap();
        let run = system.run_folder("disk/run");
        let now = client.learner_status().unwrap().updates;
        run.wait_for_updates(now);
        wait_until("a checkpoint after that", || {
            let newest = run.checkpoints().pop();
            newest.is_some_and(|(updates, _)| updates > now)
        });
        let ended = process.interrupt().expect_code(130);
        let count = |words: &str| ended.stderr.matches(words).count();
        let counts = ["No space left", "\nlost "].map(count);
        assert_eq!(counts, [1, 0], "{ended:#?}");
        run.check(Outcome::Interrupted);
        // Times increase strictly, and frames never decrease.
        let [seconds, frames] = ["seconds", "frames"].map(|name| run.numeric_column(name));
        assert!(seconds.is_sorted_by(|a, b| a < b), "{seconds:?}");
        assert!(frames.is_sorted(), "{frames:?}");
    });
}

/// The launcher waits for the learner, which retries its last save.
#[test]
fn the_last_checkpoint_is_saved_once_there_is_room() {
    with_full_disk(PERIOD_NEVER, |system, mut run, filler| {
        run.signal(Signal::SIGINT);
        run.wait_for_stderr("(no storage space): make room or make it writable");
        wait_until("a save", || status_text(system).contains("saves its last"));
        fs::remove_file(filler).unwrap();
        run.wait().expect_code(130);
        assert!(system.run_folder("disk/run").saved_updates() >= 100);
    });
}

#[test]
fn the_first_error_is_the_one_shown() {
    with_full_disk(PERIOD_NEVER, |system, mut run, _| {
        run.signal(Signal::SIGINT);
        run.wait_for_stderr("(no storage space): make room or make it writable");
        system.find_process("learner").signal(Signal::SIGKILL);
        let ended = run.fails("there is no checkpoint yet: start the run again");
        // The run fails because the checkpoint could not be saved. The error about the summary is only logged before.
        let (_, last) = ended.stderr.rsplit_once("\nerror: ").unwrap();
        assert!(last.contains("learner was killed by"), "{ended:#?}");
        check_has(&ended.stderr, &["summary.json: No space left"]);
        let lost = ended.stderr.lines().filter(|it| it.starts_with("lost "));
        let lost: Vec<_> = lost.collect();
        assert!(lost.len() == 1 && lost[0].contains(" of "), "{ended:#?}");
        for line in ended.stderr.lines() {
            let causes = line.matches("No space left").count();
            assert!(causes <= 1, "a cause is logged once: {line}");
        }
    });
}

/// The number of batches that may have been in flight to a learner when it exited.
const IN_FLIGHT: u64 = 8;

/// While the disk is full, the replay server stores and serves nothing. Then everything continues, and nothing was lost.
#[test]
fn a_full_disk_makes_all_processes_wait_until_there_is_room() {
    let system = system();
    let Some(_disk) = Disk::mount(system.path("disk"), 20_000) else {
        return;
    };
    let flags = format!("--agent c51 {LONG} --replay-dir disk/replay");
    let mut server = system.start_replay_server(&flags);
    let (learner, actor) = (system.start_learner("run"), system.start_actor(0));
    let client = system.connect();
    client.wait_for_updates(100);
    let filler = system.path("disk/filler");
    fill_disk(&filler);
    server.wait_for_stderr("cannot be written: No space left on device (os error 28); nothing more is stored until it can");
    let stopped = client.replay_status().unwrap();
    let words = [
        "replay on disk: ",
        "WRITES FAIL for",
        "No space left on device",
        "If the replay server dies now",
        "to do: the replay server on",
    ];
    wait_for_status(&system, &words);
    // The last page of the log has room for some joins; each further one has to wait, and none of them is kept to be written later.
    let joins = (1_000..1_200).map(|it| Row::of(&client, &ActorJoin::new(it, 1), "W"));
    check_replies(&client, joins);
    let json = system.run(&system.connect_args("status --json")).json();
    let bytes = &json["servers"][0]["processes"]["log"]["unwritten_bytes"];
    assert!(bytes.as_u64().is_some_and(|it| it < 1_000), "{bytes}");
    fs::remove_file(filler).unwrap();
    client.wait_for_transitions(stopped.transitions_inserted + 1_000);
    server.wait_for_stderr("can be written again; it has all stored transitions");
    let text = status_text(&system);
    check_has(&text, &["replay on disk: "]);
    assert!(!text.contains("WRITES FAIL"), "{text}");
    actor.stop(130);
    learner.stop(130);
    let before = client.check_nothing_lost();
    server.kill();
    let server = system.start_replay_server(&flags);
    let after = wait_for("the server", || client.replay_status());
    assert_eq!(after.transitions_inserted, before.transitions_inserted);
    // The learner's checkpoint contains all served batches except those in flight.
    let learner = system.start_learner("run");
    let rows = "rows that the learner's checkpoint has";
    let after = client.wait_for_replay(rows, |replay| {
        replay.rows_sampled >= before.rows_sampled - 16 * IN_FLIGHT
    });
    assert_eq!(after.updates_relearned, 0, "{after:#?}");
    client.wait_for_learner("the learner", |_| true);
    learner.stop(130);
    drop(client);
    server.stop(130);
}

#[test]
fn a_folder_that_cannot_be_used_is_said() {
    let system = system();
    let flags = format!("--agent c51 {SHORT} --replay-dir replay");
    let server = system.start_replay_server(&flags);
    drop(system.connect());
    let other = |flags: &str| {
        let socket = system.socket_endpoint("other");
        system.start_process(&format!("replay-server --listen {socket} {flags}"))
    };
    other(&flags)
        .fails("another replay server keeps its replay in replay: end it first, or choose another --replay-dir");
    server.stop(130);
    other(&flags.replace("c51", "driml-ada"))
        .wait()
        .expect_code(64)
        .expect_stderr("replay holds the replay of another run (its run spec has the hash");

    let Some(disk) = Disk::mount(system.path("disk"), 3_000) else {
        return;
    };
    let mut remount = Command::new("mount");
    remount.args(["-o", "remount,ro"]).arg(system.path("disk"));
    if !succeeds(&mut remount) {
        return;
    }
    other(&flags.replace("--replay-dir replay", "--replay-dir disk/replay"))
        .wait()
        .expect_code(64)
        .expect_stderr("disk/replay cannot be written: Read-only file system (os error 30)");
    drop(disk);
    assert!(system.file_names("replay").len() > 2);
}
