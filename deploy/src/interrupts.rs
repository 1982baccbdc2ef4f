//! Counts how often a person has asked this process to stop: Ctrl-C, SIGTERM, a closed terminal.
//! The first is a wish to drain, the second to end at once; the caller decides.

use std::{
    sync::{Arc, Condvar, Mutex},
    time::{Duration, Instant},
};

use tokio::signal::unix::{SignalKind, signal};

/// Signals closer together are one wish: tools such as `timeout` signal the process and its group.
const ONE_WISH: Duration = Duration::from_millis(300);
/// How often it is looked whether the parent lives.
const PARENT_POLL: Duration = Duration::from_millis(500);

/// A shared count of interrupts.
#[derive(Clone, Debug, Default)]
pub(crate) struct Interrupts {
    state: Arc<(Mutex<u32>, Condvar)>,
}

impl Interrupts {
    /// Starts to listen for signals, for the rest of the process's life; the death of the parent counts too, if
    /// `exit_with_parent`.
    ///
    /// # Errors
    /// The operating system gave no thread, runtime or signal handler.
    pub(crate) fn listen(exit_with_parent: bool) -> std::io::Result<Self> {
        let this = Self::default();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let (mut interrupt, mut terminate, mut hangup) = {
            let _inside = runtime.enter();
            (
                signal(SignalKind::interrupt())?,
                signal(SignalKind::terminate())?,
                signal(SignalKind::hangup())?,
            )
        };
        let counted = this.clone();
        let parent = std::os::unix::process::parent_id();
        let parent_died = async move {
            while !exit_with_parent || std::os::unix::process::parent_id() == parent {
                tokio::time::sleep(PARENT_POLL).await;
            }
        };
        std::thread::Builder::new()
            .name("interrupts".into())
            .spawn(move || {
                runtime.block_on(async {
                    let mut last: Option<Instant> = None;
                    let mut orphan = false;
                    tokio::pin!(parent_died);
                    loop {
                        tokio::select! {
                            () = &mut parent_died, if !orphan => orphan = true,
                            _ = interrupt.recv() => {}
                            _ = terminate.recv() => {}
                            _ = hangup.recv() => {}
                        }
                        // Counted from the wish's first signal: whoever keeps pressing is heard.
                        if last.is_none_or(|last| last.elapsed() > ONE_WISH) {
                            counted.add();
                            last = Some(Instant::now());
                        }
                    }
                });
            })?;
        Ok(this)
    }

    fn add(&self) {
        *self
            .state
            .0
            .lock()
            .expect("no thread panics while holding the count") += 1;
        self.state.1.notify_all();
    }

    /// How many there were.
    pub(crate) fn count(&self) -> u32 {
        *self
            .state
            .0
            .lock()
            .expect("no thread panics while holding the count")
    }

    /// Sleeps for `timeout`, or until there is one more; returns how many there were.
    pub(crate) fn wait_timeout(&self, timeout: Duration) -> u32 {
        let count = self
            .state
            .0
            .lock()
            .expect("no thread panics while holding the count");
        let before = *count;
        let waited = self
            .state
            .1
            .wait_timeout_while(count, timeout, |count| *count == before);
        *waited.expect("no thread panics while holding the count").0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_interrupt_counts_and_wakes() {
        let interrupts = Interrupts::default();
        assert_eq!(interrupts.wait_timeout(Duration::from_millis(1)), 0);
        let other = interrupts.clone();
        let waiter = std::thread::spawn(move || other.wait_timeout(Duration::from_secs(60)));
        while !waiter.is_finished() {
            interrupts.add();
            std::thread::yield_now();
        }
        assert!(waiter.join().unwrap() >= 1);
    }
}
