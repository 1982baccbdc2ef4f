//! A terminal or pipe is closed during a run: the run drains, saves and exits as after Ctrl-C. Another run is suspended and continued.
//! Ctrl-C is in `resume` and `failures`, hangups of single processes are in `by_hand`.

use std::{
    fs::{File, OpenOptions},
    io::{BufRead, BufReader, pipe},
    os::{fd::AsFd, unix::fs::OpenOptionsExt},
    process::{Child, Command, Stdio},
    thread,
    time::Duration,
};

use driml_tests::{Outcome, Process, TestSystem, wait_for, wait_until};
use nix::{
    fcntl::OFlag,
    pty::{grantpt, posix_openpt, ptsname_r, unlockpt},
    sys::signal::Signal,
};

use crate::{LONG, PROCESSES, start_run, system};

/// Opens a terminal. Returns its window, which is a process that reads what the terminal shows, and the terminal for another process.
fn open_window() -> (Process, File) {
    // Not `openpty`: every process that any test starts meanwhile would inherit its files.
    let flags = OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_CLOEXEC;
    let master = posix_openpt(flags).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let terminal = OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(OFlag::O_NOCTTY.bits())
        .open(ptsname_r(&master).unwrap())
        .unwrap();
    let mut window = Command::new("cat");
    window.stdin(master.as_fd().try_clone_to_owned().unwrap());
    (Process::start("a window".into(), window), terminal)
}

/// Starts the program with the arguments `run`, with standard output and standard error redirected to `out` and `err`.
fn spawn(system: &TestSystem, run: &str, out: impl Into<Stdio>, err: impl Into<Stdio>) -> Child {
    let mut command = system.command(run);
    command.stdout(out).stderr(err).spawn().unwrap()
}

/// Checks that the launcher exits as after an interrupt: everything is saved, and no process is left.
fn check_ended_saved(system: &TestSystem, mut launcher: Child) {
    let ended = wait_for("the launcher's end", || launcher.try_wait().unwrap());
    assert_eq!(ended.code(), Some(130), "{ended}");
    assert_eq!(system.running_processes(), []);
    let summary = system.run_folder("run").check(Outcome::Interrupted);
    assert!(summary.updates > 100, "{summary:#?}");
}

#[test]
fn a_closed_window_saves_the_run() {
    let system = system();
    let (window, terminal) = open_window();
    let run = system.local_args(&format!("--agent driml-ada {LONG}"));
    let launcher = spawn(&system, &run, terminal.try_clone().unwrap(), terminal);
    system.connect().wait_for_updates(100);
    wait_until("the progress bar", || {
        let shown = window.stdout();
        shown.contains("replay ratio 7") && shown.ends_with('\r')
    });
    window.kill();
    check_ended_saved(&system, launcher);
}

/// `driml local ... 2>&1 | head -2`, with processes and in lockstep.
#[test]
fn a_pipe_closed_after_two_lines_saves_the_run() {
    for flags in ["--agent driml-ada", "--agent c51 --lockstep"] {
        let system = system();
        let (reader, writer) = pipe().unwrap();
        let run = format!("local {LONG} {flags} --run-dir run");
        let launcher = spawn(&system, &run, writer.try_clone().unwrap(), writer);
        let mut lines = BufReader::new(reader).lines();
        let head = [lines.next(), lines.next()];
        assert!(matches!(head, [Some(Ok(_)), Some(Ok(_))]), "{head:?}");
        system.run_folder("run").wait_for_updates(100);
        drop(lines);
        check_ended_saved(&system, launcher);
    }
}

/// Returns whether hangups are ignored, as under `nohup`, and then reports the test as skipped. Asks the kernel, not the program.
pub(crate) fn skipped_under_nohup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let mask = status.lines().find_map(|it| it.strip_prefix("SigIgn:"));
    let mask = u64::from_str_radix(mask.unwrap().trim(), 16).unwrap();
    let is_ignored = mask & (1 << (Signal::SIGHUP as u32 - 1)) != 0;
    if is_ignored {
        driml_tests::skip("hangups are ignored here");
    }
    is_ignored
}

#[test]
fn a_hangup_ends_a_launched_run_once() {
    if skipped_under_nohup() {
        return;
    }
    let system = system();
    let process = start_run(&system, 100);
    // The kernel and a shell may each send a hangup.
    process.signal(Signal::SIGHUP);
    process.signal(Signal::SIGHUP);
    process.wait().expect_code(130);
    assert_eq!(system.running_processes(), []);
    system.run_folder("run").check(Outcome::Interrupted);
}

/// As with `nohup driml local ... &`, whose terminal is then closed.
#[test]
fn a_run_that_is_to_ignore_hangups_does() {
    let system = system();
    let run = system.local_args(&format!("--agent driml-ada {LONG}"));
    let process = system.start(&format!(
        "sh -c 'trap \"\" HUP; exec \"$0\" \"$@\"' DRIML {run}"
    ));
    let client = system.connect();
    let before = client.wait_for_updates(100);
    process.signal(Signal::SIGHUP);
    for role in PROCESSES {
        system.find_process(role).signal(Signal::SIGHUP);
    }
    client.wait_for_updates(before.updates + 500);
    process.stop(130);
    system.run_folder("run").check(Outcome::Interrupted);
}

/// As with Ctrl-Z, and `fg` after more time than the launcher waits for a reply.
#[test]
#[ignore = "three minutes: cargo nextest run --workspace --run-ignored only -E 'test(stopped_for_long)'"]
fn a_run_that_was_stopped_for_long_resumes() {
    let system = system();
    let mut process = start_run(&system, 100);
    let all = PROCESSES.map(|role| system.find_process(role));
    let signal = |launcher: &Process, signal| {
        launcher.signal(signal);
        all.iter().for_each(|it| it.signal(signal));
    };
    signal(&process, Signal::SIGSTOP);
    thread::sleep(Duration::from_secs(140));
    signal(&process, Signal::SIGCONT);
    let client = system.connect();
    let before = client.wait_for_updates(100);
    wait_until("500 more updates", || {
        assert!(process.is_running(), "{}", process.stderr());
        let learner = client.learner_status();
        learner.is_some_and(|it| it.updates > before.updates + 500)
    });
    let ended = process.stop(130);
    assert!(!ended.stderr.contains("no answer for 15 s"), "{ended:#?}");
    system.run_folder("run").check(Outcome::Interrupted);
}
