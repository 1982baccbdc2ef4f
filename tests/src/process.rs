//! One process: its output so far, signals to it, and its exit within the deadline.
//! This module does not know the role of the process.

use std::{
    fs::File,
    os::unix::{fs::FileExt, process::ExitStatusExt},
    process::{Child, Command},
    thread,
};

use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};

use crate::waiting::{wait_for, wait_until};

/// A started process. Dropping the value kills the process.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    /// Files without a name, to which the process writes.
    stdout: File,
    stderr: File,
}

/// How a process ended, and all its output.
#[derive(Clone, Debug)]
pub struct Exit {
    /// The exit code; `None` if a signal ended the process.
    pub code: Option<i32>,
    /// The signal that ended the process, if any.
    pub signal: Option<i32>,
    /// All of its standard output.
    pub stdout: String,
    /// All of its standard error.
    pub stderr: String,
}

/// Returns what was written to a file so far. The offset at which the process writes does not move.
fn text_so_far(file: &File) -> String {
    let mut bytes = vec![0; file.metadata().unwrap().len() as usize];
    file.read_exact_at(&mut bytes, 0).unwrap();
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Checks that a text contains every string in `all`.
#[track_caller]
pub fn check_has(text: &str, all: &[&str]) {
    for words in all {
        assert!(text.contains(words), "wanted {words:?} in:\n{text}");
    }
}

/// Runs a command other than the program under test, which must succeed, and returns its standard output.
pub(crate) fn run(command: &mut Command) -> String {
    let output = command.output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {stderr}");
    String::from_utf8(output.stdout).unwrap()
}

impl Process {
    /// Starts a command that a test has built, with the standard input that it has; `name` identifies the process in messages.
    pub fn start(name: String, mut command: Command) -> Self {
        let [stdout, stderr] = [(); 2].map(|()| tempfile::tempfile().unwrap());
        command.stdout(stdout.try_clone().unwrap());
        command.stderr(stderr.try_clone().unwrap());
        let child = command.spawn();
        let child = child.unwrap_or_else(|e| panic!("starting {command:?}: {e}"));
        Self {
            name,
            child,
            stdout,
            stderr,
        }
    }

    /// Sends a signal. The process has not been waited for, so no other process can have its ID.
    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.pid()), signal).unwrap();
    }

    /// Returns the process ID.
    pub fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    /// Standard output so far.
    pub fn stdout(&self) -> String {
        text_so_far(&self.stdout)
    }

    /// Standard error so far.
    pub fn stderr(&self) -> String {
        text_so_far(&self.stderr)
    }

    /// Waits until standard error holds `words`.
    pub fn wait_for_stderr(&mut self, words: &str) {
        wait_until(&format!("{}: {words:?} on stderr", self.name), || {
            // Check for the end first, so that output written just before the end is not missed.
            let ended = self.child.try_wait().unwrap().is_some();
            let stderr = text_so_far(&self.stderr);
            let found = stderr.contains(words);
            assert!(
                found || !ended,
                "{} ended without saying {words:?}:\n{stderr}",
                self.name
            );
            found
        });
    }

    /// Whether the process is still running.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Waits until the process ends. At the deadline, panics and thereby kills the process.
    pub fn wait(mut self) -> Exit {
        let what = format!("the end of {}", self.name);
        let status = wait_for(&what, || self.child.try_wait().unwrap());
        Exit {
            code: status.code(),
            signal: status.signal(),
            stdout: self.stdout(),
            stderr: self.stderr(),
        }
    }

    /// Waits until the process ends and checks that it succeeded.
    #[track_caller]
    pub fn wait_ok(self) -> Exit {
        self.wait().expect_code(0)
    }

    /// Waits until the process ends and checks that it failed with `words` on standard error.
    #[track_caller]
    pub fn fails(self, words: &str) -> Exit {
        self.wait().expect_code(1).expect_stderr(words)
    }

    /// Kills the process and waits until it ends.
    pub fn kill(self) {
        self.signal(Signal::SIGKILL);
        assert_eq!(self.wait().signal, Some(Signal::SIGKILL as i32));
    }

    /// Sends SIGINT, as Ctrl-C does, and waits until the process ends.
    pub fn interrupt(self) -> Exit {
        self.signal(Signal::SIGINT);
        self.wait()
    }

    /// Sends SIGTERM, waits until the process exits, and checks its exit code: 0 if its run is over, else 130.
    #[track_caller]
    pub fn stop(self, code: i32) -> Exit {
        self.signal(Signal::SIGTERM);
        self.wait().expect_code(code)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if thread::panicking() {
            // The test runner shows this beside the failure.
            println!("--- {}\n{}{}", self.name, self.stdout(), self.stderr());
        }
    }
}

impl Exit {
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

    /// Parses standard output as JSON.
    #[track_caller]
    pub fn json(&self) -> serde_json::Value {
        let json = serde_json::from_str(&self.stdout);
        json.unwrap_or_else(|e| panic!("{e}: {}", self.stdout))
    }

    /// Checks that standard error contains `words`.
    #[track_caller]
    pub fn expect_stderr(self, words: &str) -> Self {
        check_has(&self.stderr, &[words]);
        self
    }

    /// Checks that standard output contains `words`.
    #[track_caller]
    pub fn expect_stdout(self, words: &str) -> Self {
        check_has(&self.stdout, &[words]);
        self
    }
}
