//! Simulates a slow machine for one process by stopping the process most of the time.
//! The process behaves as usual and only takes longer.

use std::{
    thread::{self, JoinHandle},
    time::Duration,
};

use driml_protocol::Shutdown;
use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};

/// The durations for which the process runs and is stopped, in turn.
const RUN_DURATION: Duration = Duration::from_millis(2);
const STOP_DURATION: Duration = Duration::from_millis(98);

/// Keeps a process slow until this value is dropped.
#[derive(Debug)]
pub struct SlowMachine {
    done: Shutdown,
    thread: Option<JoinHandle<()>>,
}

impl SlowMachine {
    /// Slows down the process with this ID. Ignores a process that has already ended.
    pub fn for_process(pid: i32) -> Self {
        let done = Shutdown::default();
        let until = done.clone();
        let signal = move |signal| {
            let _ = kill(Pid::from_raw(pid), signal);
        };
        let work = move || {
            loop {
                signal(Signal::SIGSTOP);
                let is_done = until.wait_timeout(STOP_DURATION);
                signal(Signal::SIGCONT);
                if is_done || until.wait_timeout(RUN_DURATION) {
                    return;
                }
            }
        };
        Self {
            done,
            thread: Some(thread::spawn(work)),
        }
    }
}

impl Drop for SlowMachine {
    fn drop(&mut self) {
        self.done.set();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
