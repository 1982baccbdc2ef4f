//! A process that gets little of the processor, as on a slow machine: it is stopped most of the time.
//! What it does is its own; it only takes longer.

use std::{
    thread::{self, JoinHandle},
    time::Duration,
};

use driml_protocol::Shutdown;
use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};

/// For how long it runs, and stands still, in turn.
const RUNS: Duration = Duration::from_millis(2);
const STANDS: Duration = Duration::from_millis(98);

/// A process is slow until this is dropped.
#[derive(Debug)]
pub struct SlowMachine {
    done: Shutdown,
    thread: Option<JoinHandle<()>>,
}

impl SlowMachine {
    /// Slows the process of this number down; one that has ended meanwhile is ignored.
    pub fn for_process(pid: i32) -> Self {
        let done = Shutdown::default();
        let until = done.clone();
        let signal = move |signal| {
            let _ = kill(Pid::from_raw(pid), signal);
        };
        let work = move || {
            loop {
                signal(Signal::SIGSTOP);
                let is_done = until.wait_timeout(STANDS);
                signal(Signal::SIGCONT);
                if is_done || until.wait_timeout(RUNS) {
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
