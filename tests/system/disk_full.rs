//! A run folder on a disk that is full: the run continues, logs it once, and ends with the first error.
//! The disk is a small one in memory, which takes root's rights to mount; without them a line says what is skipped.

use std::{
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
    process::Command,
};

use driml_tests::{Process, TestSystem, skip, wait_for};
use nix::sys::signal::Signal;

use crate::{LONG, system};

/// A small disk. Dropping it takes it away.
pub(crate) struct Disk {
    folder: PathBuf,
}

impl Disk {
    /// One of so many KiB at `folder`; none, and a line that `test` is skipped, if it cannot be mounted.
    pub(crate) fn mount(test: &str, folder: PathBuf, kib: u32) -> Option<Self> {
        fs::create_dir(&folder).unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &format!("size={kib}k"), "tmpfs"]);
        match mount.arg(&folder).output() {
            Ok(output) if output.status.success() => Some(Self { folder }),
            Ok(output) => {
                let why = String::from_utf8_lossy(&output.stderr).trim().to_owned();
                skip(test, &why);
                None
            }
            Err(e) => {
                skip(test, &format!("mount: {e}"));
                None
            }
        }
    }

    /// Takes all room that there is.
    pub(crate) fn fill(&self) -> Filler {
        let path = self.folder.join("filler");
        let mut file = File::create(&path).unwrap();
        while file.write_all(&[0; 4096]).is_ok() {}
        Filler { path }
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

/// A file that takes all room of a disk.
pub(crate) struct Filler {
    path: PathBuf,
}

impl Filler {
    pub(crate) fn remove(self) {
        fs::remove_file(&self.path).unwrap();
    }
}

/// Updates between two checkpoints of a run that ends before the first.
const NEVER: u32 = 100_000_000;

/// A run on the disk, with a checkpoint after so many updates, that has learned something.
fn started(system: &TestSystem, checkpoint_period: u32) -> Process {
    let process = system.start(&format!(
        "local --agent c51 {LONG} --set learner.checkpoint_period_updates={checkpoint_period} --listen {} --run-dir disk/run",
        system.endpoint()
    ));
    let client = system.connect();
    client.wait_for_learner("some updates", |learner| learner.updates > 100);
    process
}

/// How often `words` were said.
fn times(said: &str, words: &str) -> usize {
    said.matches(words).count()
}

#[test]
fn a_run_continues_while_the_disk_is_full() {
    let system = system();
    let name = "a_run_continues_while_the_disk_is_full";
    let Some(disk) = Disk::mount(name, system.path("disk"), 3_000) else {
        return;
    };
    let mut process = started(&system, NEVER);
    let filler = disk.fill();
    process.wait_for_stderr("cannot be written: No space left");
    let client = system.connect();
    let then = client.learner().unwrap().updates;
    client.wait_for_learner("more updates", |learner| learner.updates > then + 200);
    filler.remove();
    let run = system.run_folder("disk/run");
    let now = client.learner().unwrap().updates;
    wait_for("a row of metrics after that", || {
        run.updates_recorded().filter(|&updates| updates > now)
    });
    process.signal(Signal::SIGINT);
    let ended = process.wait().expect_code(130);
    assert_eq!(times(&ended.stderr, "No space left"), 1, "{ended:#?}");
    assert_eq!(times(&ended.stderr, "are lost"), 0, "{ended:#?}");
    run.check("interrupted");
    // No second is missing.
    let (header, rows) = run.metrics();
    let seconds = header.iter().position(|it| it == "seconds").unwrap();
    let frames = header.iter().position(|it| it == "frames").unwrap();
    let cells: Vec<[f64; 2]> = rows
        .iter()
        .map(|row| [seconds, frames].map(|at| row[at].parse().unwrap()))
        .collect();
    assert!(
        cells.is_sorted_by(|a, b| a[0] < b[0] && a[1] <= b[1]),
        "{cells:?}"
    );
    check_nothing_is_left(&system, &system.path("disk/run"));
}

#[test]
fn the_first_error_is_the_one_shown() {
    let system = system();
    let name = "the_first_error_is_the_one_shown";
    let Some(disk) = Disk::mount(name, system.path("disk"), 3_000) else {
        return;
    };
    let mut process = started(&system, NEVER);
    let filler = disk.fill();
    process.wait_for_stderr("cannot be written: No space left");
    process.signal(Signal::SIGINT);
    let ended = process.wait().expect_code(1);
    // The checkpoint could not be saved: that is what the run failed by, and the summary is only said before.
    let errors = ended.stderr.rfind("\nerror: ").expect("an error is last");
    let last = &ended.stderr[errors..];
    assert!(last.contains("learner exited with code 1"), "{ended:#?}");
    assert!(
        ended.stderr.contains("summary.json: No space left"),
        "{ended:#?}"
    );
    let lost = ended.stderr.lines().filter(|it| it.contains("are lost: "));
    let lost: Vec<_> = lost.collect();
    assert!(
        lost.len() == 1 && lost[0].contains(" rows of "),
        "{ended:#?}"
    );
    for line in ended.stderr.lines() {
        assert!(
            times(line, "No space left") <= 1,
            "a cause is logged once: {line}"
        );
    }
    filler.remove();
    check_nothing_is_left(&system, &system.path("disk/run"));
}

#[test]
fn a_checkpoint_that_finds_no_room_is_tried_again() {
    let system = system();
    let name = "a_checkpoint_that_finds_no_room_is_tried_again";
    let Some(disk) = Disk::mount(name, system.path("disk"), 3_000) else {
        return;
    };
    let mut process = started(&system, 200);
    let filler = disk.fill();
    process.wait_for_stderr("No space left");
    let client = system.connect();
    let then = client.learner().unwrap().updates;
    client.wait_for_learner("more updates", |learner| learner.updates > then + 600);
    let run = system.path("disk/run");
    filler.remove();
    let now = client.learner().unwrap().updates;
    wait_for("a checkpoint after that", || {
        let names = fs::read_dir(run.join("checkpoints")).unwrap();
        let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut saved = names.filter_map(|name| name.strip_prefix("checkpoint-")?.parse().ok());
        saved.any(|updates: u64| updates > now).then_some(())
    });
    process.signal(Signal::SIGINT);
    process.wait().expect_code(130);
    system.run_folder("disk/run").check("interrupted");
    check_nothing_is_left(&system, &run);
}

/// No process and no half of a file.
fn check_nothing_is_left(system: &TestSystem, run: &Path) {
    assert_eq!(system.survivors(), []);
    for folder in [run.to_owned(), run.join("checkpoints")] {
        for entry in fs::read_dir(folder).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            let is_temporary = name.contains("tmp");
            assert!(!is_temporary, "{name}");
        }
    }
}
