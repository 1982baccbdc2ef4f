//! One process: its output as it comes, signals to it, and its end within the deadline.
//! It does not know what the process is.

use std::{
    io::{BufRead, BufReader, Read},
    os::unix::process::ExitStatusExt,
    process::{Child, Command, Stdio},
    sync::{Arc, Mutex},
    thread::{self, JoinHandle},
};

use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};

use crate::waiting::{wait_for, wait_until};

/// A started process. Dropping it kills it.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    stdout: Output,
    stderr: Output,
}

/// How a process ended, and all it said.
#[derive(Clone, Debug)]
pub struct Ended {
    /// Its exit code; none if a signal ended it.
    pub code: Option<i32>,
    /// The signal that ended it.
    pub signal: Option<i32>,
    /// All of its standard output.
    pub stdout: String,
    /// All of its standard error.
    pub stderr: String,
}

/// What was read from one pipe so far, and the thread that reads on.
#[derive(Debug)]
struct Output {
    text: Arc<Mutex<String>>,
    reader: JoinHandle<()>,
}

impl Output {
    fn read(pipe: impl Read + Send + 'static) -> Self {
        let text = Arc::<Mutex<String>>::default();
        let sink = text.clone();
        let reader = thread::spawn(move || {
            for line in BufReader::new(pipe).split(b'\n') {
                let Ok(line) = line else { return };
                let mut sink = sink.lock().unwrap();
                sink.push_str(&String::from_utf8_lossy(&line));
                sink.push('\n');
            }
        });
        Self { text, reader }
    }

    fn so_far(&self) -> String {
        self.text.lock().unwrap().clone()
    }
}

/// Checks that a text has all of these words.
#[track_caller]
pub fn check_has(text: &str, all: &[&str]) {
    for words in all {
        assert!(text.contains(words), "wanted {words:?} in:\n{text}");
    }
}

/// What a command prints that is not the program.
pub(crate) fn run(command: &mut Command) -> String {
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

impl Process {
    /// Starts a command that a test has put together; `name` is for messages.
    pub fn start(name: String, mut command: Command) -> Self {
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = command
            .spawn()
            .unwrap_or_else(|e| panic!("starting {command:?}: {e}"));
        let stdout = Output::read(child.stdout.take().expect("it is piped"));
        let stderr = Output::read(child.stderr.take().expect("it is piped"));
        Self {
            name,
            child,
            stdout,
            stderr,
        }
    }

    /// Sends a signal. It has not been waited for, so its number is still its own.
    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.pid()), signal).unwrap();
    }

    /// Its number.
    pub fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    /// Standard error so far.
    pub fn stderr(&self) -> String {
        self.stderr.so_far()
    }

    /// Waits until standard error holds `words`.
    pub fn wait_for_stderr(&mut self, words: &str) {
        wait_until(&format!("{}: {words:?} on stderr", self.name), || {
            // In this order: what it said just before its end is not missed.
            let ended =
                self.child.try_wait().unwrap().is_some() && self.stderr.reader.is_finished();
            let said = self.stderr.so_far();
            let found = said.contains(words);
            assert!(
                found || !ended,
                "{} ended without saying {words:?}:\n{said}",
                self.name
            );
            found
        });
    }

    /// Whether it is still running.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Waits for its end; at the deadline it is killed.
    pub fn wait(mut self) -> Ended {
        let what = format!("the end of {}", self.name);
        let status = wait_for(&what, || self.child.try_wait().unwrap());
        // Its pipes close with it, as it has no child that holds them.
        wait_until(&format!("the last output of {}", self.name), || {
            self.stdout.reader.is_finished() && self.stderr.reader.is_finished()
        });
        Ended {
            code: status.code(),
            signal: status.signal(),
            stdout: self.stdout.so_far(),
            stderr: self.stderr.so_far(),
        }
    }

    /// Waits for its end, which must be a success.
    #[track_caller]
    pub fn wait_ok(self) -> Ended {
        self.wait().expect_code(0)
    }

    /// Waits for its end, which must be an error with `words` on standard error.
    #[track_caller]
    pub fn fails(self, words: &str) -> Ended {
        self.wait().expect_error(words)
    }

    /// Kills it and waits for its end.
    pub fn kill(self) {
        self.signal(Signal::SIGKILL);
        assert_eq!(self.wait().signal, Some(Signal::SIGKILL as i32));
    }

    /// Sends it what Ctrl-C does and waits for its end.
    pub fn interrupt(self) -> Ended {
        self.signal(Signal::SIGINT);
        self.wait()
    }

    /// Asks it to stop and waits for its end.
    pub fn stop(self) -> Ended {
        self.signal(Signal::SIGTERM);
        self.wait()
    }

    /// Asks it to stop and waits until it exits: with code 0 if its run is over, else with 130.
    #[track_caller]
    pub fn stop_ok(self) -> Ended {
        let ended = self.stop();
        let code = if ended.code == Some(130) { 130 } else { 0 };
        ended.expect_code(code)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if thread::panicking() {
            // The test runner shows this beside the failure.
            println!(
                "--- {}\n{}{}",
                self.name,
                self.stdout.so_far(),
                self.stderr.so_far()
            );
        }
    }
}

impl Ended {
    /// Checks the exit code, and that no thread panicked.
    #[track_caller]
    pub fn expect_code(self, code: i32) -> Self {
        assert!(
            self.code == Some(code) && !self.stderr.contains("panicked"),
            "exit code {:?}, signal {:?}, wanted code {code}\n{}{}",
            self.code,
            self.signal,
            self.stdout,
            self.stderr
        );
        self
    }

    /// Checks that it ended with an error, exit code 1, and `words` on standard error.
    #[track_caller]
    pub fn expect_error(self, words: &str) -> Self {
        self.expect_code(1).expect_said(words)
    }

    /// Standard output, as JSON.
    #[track_caller]
    pub fn json(&self) -> serde_json::Value {
        let said = serde_json::from_str(&self.stdout);
        said.unwrap_or_else(|e| panic!("{e}: {}", self.stdout))
    }

    /// Checks that standard error holds `words`.
    #[track_caller]
    pub fn expect_said(self, words: &str) -> Self {
        check_has(&self.stderr, &[words]);
        self
    }

    /// Checks that standard output holds `words`.
    #[track_caller]
    pub fn expect_printed(self, words: &str) -> Self {
        check_has(&self.stdout, &[words]);
        self
    }
}
