//! Processes that connect to the wrong place: each cause soon gets its own error, which says what to do.
//! Wrong certificates are in `tls`, wrong settings in the learner's and the watch's own tests.

use std::{
    io::{Read, Write},
    ops::Range,
    os::unix::net::UnixListener,
    thread,
    time::{Duration, Instant},
};

use driml_tests::{Exit, TestSystem, in_parallel};
use nix::sys::signal::Signal;

use crate::{SHORT, listen_on_free_port, system};

/// The commands that connect to a replay server.
const COMMANDS: [&str; 4] = [
    "actor --connect",
    "learner --run-dir run --connect",
    "status --connect",
    "watch --connect",
];

/// Runs a command that must exit within this range of seconds, and checks that its output names no file of the build machine.
fn fails_within(system: &TestSystem, command: &str, seconds: Range<u64>) -> Exit {
    let started = Instant::now();
    let ended = system.run(command).expect_code(1);
    // Allow more time on a busy machine.
    let (took, seconds) = (started.elapsed(), seconds.start..seconds.end + 10);
    assert!(seconds.contains(&took.as_secs()), "{command}: {took:?}");
    for own in [".rs:", "registry", "Timeout!"] {
        assert!(!ended.stderr.contains(own), "{}", ended.stderr);
    }
    ended
}

#[test]
fn a_closed_port_differs_from_an_unknown_host() {
    let system = system();
    let (endpoint, _) = listen_on_free_port();
    let unknown = "tcp/no-such-host.invalid:7447";
    in_parallel(COMMANDS, |command| {
        // Actors and learners give the replay server 30 s to start.
        let waits = COMMANDS[..2].contains(&command);
        let seconds = if waits { 25..30 } else { 0..5 };
        fails_within(&system, &format!("{command} {endpoint}"), seconds).expect_stderr(&format!(
            "nothing listens on {endpoint}: start the replay server first"
        ));
        // That a host is unknown may be temporary.
        fails_within(&system, &format!("{command} {unknown}"), 0..30)
            .expect_stderr(&format!("the host of {unknown} is unknown: "));
    });
    fails_within(&system, &system.connect_args("watch"), 0..5)
        .expect_stderr("there is no such socket. Start the replay server first");
    drop(UnixListener::bind(system.path("s")).unwrap());
    fails_within(&system, &system.connect_args("watch"), 0..5)
        .expect_stderr("its socket was left by a process that has ended");
    system.run("status").expect_code(64);
}

#[test]
fn a_web_server_is_no_replay_server() {
    let system = system();
    let (endpoint, listener) = listen_on_free_port();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            thread::spawn(move || {
                let mut request = [0; 1024];
                let count = stream.read(&mut request).unwrap_or(0);
                // Reply as web servers do to a request that they do not understand.
                if request[..count].starts_with(b"GET") {
                    let _ = stream.write_all(b"HTTP/1.0 404 Not Found\r\n\r\n");
                }
            });
        }
    });
    in_parallel(COMMANDS, |command| {
        fails_within(&system, &format!("{command} {endpoint}"), 0..5)
            .expect_stderr(&format!(
                "something listens on {endpoint} that is not driml"
            ))
            .expect_stderr("it sent \"HTTP/1.0 404 Not Found\"");
    });
}

#[test]
fn a_router_without_a_run_is_named_while_it_is_waited_for() {
    let system = system();
    let (endpoint, _) = listen_on_free_port();
    let _router = driml_tests::listen(&endpoint);
    in_parallel(&COMMANDS[..2], |command| {
        let started = Instant::now();
        let mut process = system.start_process(&format!("{command} {endpoint}"));
        let words = "a process listens there, but does not answer at driml/run-info";
        process.wait_for_stderr(words);
        assert!(started.elapsed() < Duration::from_secs(30));
    });
    in_parallel(&COMMANDS[2..], |command| {
        system
            .rejects(&format!("{command} {endpoint}"), "a program listens on")
            .expect_stderr("but it is not a replay server with the namespace \"driml\"");
    });
}

/// The process exits soon and, as one that plays or learns, with exit code 130.
#[test]
fn a_process_that_waits_for_its_server_ends_when_it_is_told_to() {
    let system = system();
    in_parallel(&COMMANDS[..2], |command| {
        for signal in [Signal::SIGINT, Signal::SIGTERM] {
            // Nothing listens there.
            let mut process = system.start(&format!("{command} {}", system.endpoint()));
            process.wait_for_stderr("waiting up to 30 s: nothing listens on ");
            process.signal(signal);
            process.wait().expect_code(130);
            // Something listens, and sends nothing.
            let (endpoint, listener) = listen_on_free_port();
            let process = system.start(&format!("{command} {endpoint}"));
            let connection = listener.accept().unwrap();
            process.signal(signal);
            process.wait().expect_code(130);
            drop(connection);
        }
    });
}

#[test]
fn an_endpoint_that_is_taken_is_named_before_anything_is_made() {
    let system = system();
    let (endpoint, _listener) = listen_on_free_port();
    for command in ["local --run-dir run", "replay-server"] {
        let ended = system
            .rejects(
                &format!("{command} {SHORT} --listen {endpoint}"),
                &format!("error: cannot listen on {endpoint}: another process listens there"),
            )
            .expect_stderr("with --listen for this command");
        assert_eq!(ended.stderr.lines().count(), 1, "{}", ended.stderr);
    }
    assert!(!system.path("run").exists());
}
