//! The flag that tells the threads of a process to stop.
//! Each process drains and saves by itself; `termination` watches for the external reasons that raise the flag.

use std::{
    io::Write,
    sync::{Arc, Condvar, Mutex, mpsc},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use super::{
    fail_point, lock, spawn,
    termination::{self, ExitReason},
};

/// How often a thread that also waits for something else checks the flag.
const TICK: Duration = Duration::from_millis(50);
/// Signals closer together count as one request to exit: tools such as `timeout` signal the process and its group.
const SAME_REQUEST_MAX: Duration = Duration::from_millis(300);

/// Exit code after Ctrl-C, as a shell has it.
const INTERRUPTED: i32 = 130;

/// A flag that is raised once and never lowered; clones share it.
#[derive(Clone, Debug, Default)]
pub struct Shutdown {
    state: Arc<(Mutex<bool>, Condvar)>,
}

impl Shutdown {
    /// Raises the flag.
    pub fn set(&self) {
        *lock(&self.state.0) = true;
        self.state.1.notify_all();
    }

    /// Whether the flag is raised.
    pub fn is_set(&self) -> bool {
        *lock(&self.state.0)
    }

    /// Sleeps for `timeout`, or until the flag is raised; returns whether it is.
    pub fn wait_timeout(&self, timeout: Duration) -> bool {
        let (flag, raised) = &*self.state;
        let waited = raised.wait_timeout_while(lock(flag), timeout, |set| !*set);
        let (flag, _) = waited.expect("no thread panics while holding the flag");
        *flag
    }

    /// Sleeps until the flag is raised.
    pub fn wait(&self) {
        while !self.wait_timeout(Duration::from_secs(3600)) {}
    }

    /// Runs `work` on a thread of this `name` and returns its result. `None` if it has none soon after the flag is raised, or after
    /// `is_over`, which is called once a second, returns true: the thread then runs unattended.
    pub fn run_unless_set<T: Send + 'static>(
        &self,
        name: &'static str,
        work: impl FnOnce() -> T + Send + 'static,
        is_over: impl Fn() -> bool,
    ) -> std::io::Result<Option<T>> {
        let (sender, receiver) = mpsc::channel();
        spawn(name, move || {
            fail_point::reach(name);
            // The receiver is gone if the caller no longer waits.
            let _ = sender.send(work());
        })?;
        for tick in 1_u64.. {
            match receiver.recv_timeout(TICK) {
                Ok(result) => return Ok(Some(result)),
                Err(_) if self.is_set() || tick.is_multiple_of(20) && is_over() => break,
                // A thread that panics sends nothing; the panic ends the process.
                Err(_) => {}
            }
        }
        // Work that checks the flag itself returns soon.
        Ok(receiver.recv_timeout(10 * TICK).ok())
    }

    /// A flag that is raised at the first reason to exit: a signal, a closed terminal or stderr, or the death of the process `parent`.
    pub fn on_signals(parent: Option<u32>) -> std::io::Result<Self> {
        GracefulShutdown::on_signals(parent).map(|flags| flags.drain)
    }
}

/// Flags that tell a process when to exit if others need it while they exit themselves.
#[derive(Clone, Debug, Default)]
pub struct GracefulShutdown {
    /// Raised when the process should exit as soon as the others have left.
    pub drain: Shutdown,
    /// Raised when the process should exit without waiting for the others.
    pub immediate: Shutdown,
}

impl GracefulShutdown {
    /// Raises `drain` at any reason to exit, and `immediate` at SIGINT and SIGTERM, or without a `parent` at any reason. With a parent, its
    /// death, SIGHUP and a closed stderr raise only `drain`, because the other processes then exit too. Without one, a second SIGINT or
    /// SIGTERM exits the process at once.
    pub fn on_signals(parent: Option<u32>) -> std::io::Result<Self> {
        let flags = Self::default();
        let (raised, mut first) = (flags.clone(), None);
        termination::watch("signals", parent, move |reason| {
            raised.drain.set();
            if reason == ExitReason::Request || parent.is_none() {
                raised.immediate.set();
            }
            // A closed terminal is not the first of two signals.
            let is_signal = reason == ExitReason::Request && parent.is_none();
            if is_signal && is_repeated(reason, &mut first, Instant::now()) {
                let _ = writeln!(std::io::stderr(), "stopped at once by a second signal");
                std::process::exit(INTERRUPTED);
            }
        })?;
        Ok(flags)
    }

    /// Raises `drain` at any reason to exit, and `immediate` when SIGINT or SIGTERM arrives later.
    pub fn on_repeated_signals(parent: Option<u32>) -> std::io::Result<Self> {
        let flags = Self::default();
        let (raised, mut first) = (flags.clone(), None);
        termination::watch("interrupts", parent, move |reason| {
            raised.handle_reason(reason, &mut first, Instant::now());
        })?;
        Ok(flags)
    }

    /// Handles a reason that came up at `now`. `first` is the time of the first one.
    fn handle_reason(&self, reason: ExitReason, first: &mut Option<Instant>, now: Instant) {
        self.drain.set();
        if is_repeated(reason, first, now) {
            self.immediate.set();
        }
    }
}

/// Whether a person asks again to exit. A closed terminal causes SIGHUP and then other reasons, but no user there asks for a faster exit.
fn is_repeated(reason: ExitReason, first: &mut Option<Instant>, now: Instant) -> bool {
    let first = *first.get_or_insert(now);
    reason == ExitReason::Request && now - first > SAME_REQUEST_MAX
}

/// Waits until all of `threads` have ended, for at most `wait_max`.
///
/// A thread that still runs while the process exits may use shared memory that is already gone.
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
    fn work_that_takes_too_long_is_left_when_the_flag_is_raised() {
        let shutdown = Shutdown::default();
        let run = |work: fn() -> u8, over: bool| shutdown.run_unless_set("work", work, || over);
        let hang: fn() -> u8 = || loop {
            std::thread::park();
        };
        assert_eq!(run(|| 5, false).unwrap(), Some(5));
        assert_eq!(run(hang, true).unwrap(), None);
        shutdown.set();
        assert_eq!(run(hang, false).unwrap(), None);
    }

    #[test]
    fn a_closed_terminal_is_the_first_wish_and_never_the_second() {
        for reasons in [
            // Seconds, the reason, and whether both flags are raised then.
            &[
                (0.0, ExitReason::Abandoned, false),
                (5.0, ExitReason::Abandoned, false),
                (5.0, ExitReason::Request, true),
            ][..],
            // The time counts from the first signal.
            &[
                (0.0, ExitReason::Request, false),
                (0.299, ExitReason::Request, false),
                (0.31, ExitReason::Request, true),
            ],
        ] {
            let (flags, start, mut first) = (GracefulShutdown::default(), Instant::now(), None);
            assert!(!flags.drain.is_set());
            for &(seconds, reason, is_second) in reasons {
                let at = start + Duration::from_secs_f64(seconds);
                flags.handle_reason(reason, &mut first, at);
                assert!(flags.drain.is_set());
                assert_eq!(flags.immediate.is_set(), is_second, "{seconds} s");
            }
        }
    }
}
