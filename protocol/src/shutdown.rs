//! How a process learns that it should stop: SIGINT, SIGTERM, or the death of the process that started it.
//! It only raises a flag; draining and saving are each part's own.

use std::{
    sync::{Arc, Condvar, Mutex},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use tokio::signal::unix::{SignalKind, signal};

/// How often a part looks whether its parent still lives.
const PARENT_POLL: Duration = Duration::from_millis(500);

/// A flag that is raised once and never lowered; clones share it.
#[derive(Clone, Debug, Default)]
pub struct Shutdown {
    state: Arc<(Mutex<bool>, Condvar)>,
}

impl Shutdown {
    /// Raises the flag.
    pub fn set(&self) {
        *self.flag() = true;
        self.state.1.notify_all();
    }

    /// Whether the flag is raised.
    pub fn is_set(&self) -> bool {
        *self.flag()
    }

    /// Sleeps for `timeout`, or until the flag is raised; returns whether it is.
    pub fn wait_timeout(&self, timeout: Duration) -> bool {
        let (flag, _) = self
            .state
            .1
            .wait_timeout_while(self.flag(), timeout, |set| !*set)
            .expect("no thread panics while holding the flag");
        *flag
    }

    /// Sleeps until the flag is raised.
    pub fn wait(&self) {
        while !self.wait_timeout(Duration::from_secs(3600)) {}
    }

    fn flag(&self) -> std::sync::MutexGuard<'_, bool> {
        self.state
            .0
            .lock()
            .expect("no thread panics while holding the flag")
    }

    /// A flag that SIGINT and SIGTERM raise and, if `exit_with_parent`, the death of this process's parent.
    ///
    /// # Errors
    /// The operating system gave no thread, runtime or signal handler.
    pub fn on_signals(exit_with_parent: bool) -> std::io::Result<Self> {
        let shutdown = Self::default();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let (mut interrupt, mut terminate) = {
            let _inside = runtime.enter();
            (
                signal(SignalKind::interrupt())?,
                signal(SignalKind::terminate())?,
            )
        };
        let raised = shutdown.clone();
        let parent = std::os::unix::process::parent_id();
        let parent_died = async move {
            while !exit_with_parent || std::os::unix::process::parent_id() == parent {
                tokio::time::sleep(PARENT_POLL).await;
            }
        };
        std::thread::Builder::new()
            .name("signals".into())
            .spawn(move || {
                runtime.block_on(async {
                    tokio::select! {
                        _ = interrupt.recv() => {}
                        _ = terminate.recv() => {}
                        () = parent_died => {}
                    }
                });
                raised.set();
            })?;
        Ok(shutdown)
    }
}

/// Waits until all of `threads` have ended, at most for `wait_max`.
///
/// A thread that still runs while the process ends may find memory gone that it shares with others.
pub fn join_within(threads: impl IntoIterator<Item = JoinHandle<()>>, wait_max: Duration) {
    let started = Instant::now();
    for thread in threads {
        while !thread.is_finished() && started.elapsed() < wait_max {
            std::thread::sleep(Duration::from_millis(1));
        }
        if thread.is_finished() && thread.join().is_err() {
            tracing::error!("a thread had panicked");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waiting_ends_when_the_flag_is_raised() {
        let shutdown = Shutdown::default();
        assert!(!shutdown.wait_timeout(Duration::from_millis(1)));
        let other = shutdown.clone();
        let waiter = std::thread::spawn(move || other.wait());
        shutdown.set();
        waiter.join().unwrap();
        assert!(shutdown.is_set());
    }
}
