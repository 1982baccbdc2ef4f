//! The flag that tells the threads of a process to stop.
//! Each process drains and saves by itself; `termination` watches for the external reasons that raise the flag.

use std::{
    ops::ControlFlow,
    sync::{Arc, Condvar, Mutex, mpsc},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use super::{
    fail_point, lock,
    termination::{self, EndSign},
};

/// How often a thread that also waits for something else checks the flag.
const TICK: Duration = Duration::from_millis(50);
/// Signals closer together count as one request to exit: tools such as `timeout` signal the process and its group.
const ONE_WISH: Duration = Duration::from_millis(300);

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

    /// Runs `work` on a thread of this `name` and returns its result; `None` if the flag is raised first. The thread then runs unattended.
    pub fn unless_set<T: Send + 'static>(
        &self,
        name: &'static str,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> std::io::Result<Option<T>> {
        let (tell, told) = mpsc::channel();
        let thread = std::thread::Builder::new().name(name.into());
        thread.spawn(move || {
            fail_point::reach(name);
            // The receiver is gone if the flag was raised meanwhile.
            let _ = tell.send(work());
        })?;
        loop {
            match told.recv_timeout(TICK) {
                Ok(given) => return Ok(Some(given)),
                // A thread that panics sends nothing; the panic ends the process.
                Err(_) if self.is_set() => return Ok(None),
                Err(_) => {}
            }
        }
    }

    /// A flag that is raised at the first reason to exit: a signal, a closed terminal or stderr, or the death of the process `parent`.
    pub fn on_signals(parent: Option<u32>) -> std::io::Result<Self> {
        GracefulShutdown::on_signals(parent).map(|steps| steps.ending)
    }
}

/// Flags that tell a process when to exit if others need it while they exit themselves.
#[derive(Clone, Debug, Default)]
pub struct GracefulShutdown {
    /// Raised when the process should exit as soon as the others have left.
    pub ending: Shutdown,
    /// Raised when the process should exit without waiting for the others.
    pub now: Shutdown,
}

impl GracefulShutdown {
    /// Raises `ending` at any reason to exit, and `now` at SIGINT and SIGTERM, or without a `parent` at any reason. With a parent, its
    /// death, SIGHUP and a closed stderr raise only `ending`, because the other processes then exit too.
    pub fn on_signals(parent: Option<u32>) -> std::io::Result<Self> {
        let steps = Self::default();
        let raised = steps.clone();
        termination::listen("signals", parent, move |sign| {
            raised.ending.set();
            if sign == EndSign::Abandoned && parent.is_some() {
                return ControlFlow::Continue(());
            }
            raised.now.set();
            ControlFlow::Break(())
        })?;
        Ok(steps)
    }

    /// Raises `ending` at any reason to exit, and `now` when SIGINT or SIGTERM arrives later.
    pub fn on_repeated_signals(parent: Option<u32>) -> std::io::Result<Self> {
        let steps = Self::default();
        let (raised, mut first) = (steps.clone(), None);
        termination::listen("interrupts", parent, move |sign| {
            raised.note(sign, &mut first, Instant::now());
            ControlFlow::Continue(())
        })?;
        Ok(steps)
    }

    /// Handles a sign received at `now`. `first` is the time of the first sign.
    fn note(&self, sign: EndSign, first: &mut Option<Instant>, now: Instant) {
        match *first {
            None => {
                *first = Some(now);
                self.ending.set();
            }
            // A closed terminal causes SIGHUP and then other signs, but no user there asks for a faster exit.
            Some(first) if sign == EndSign::Asked && now - first > ONE_WISH => self.now.set(),
            Some(_) => {}
        }
    }
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
    fn waiting_ends_when_the_flag_is_raised() {
        let shutdown = Shutdown::default();
        assert!(!shutdown.wait_timeout(Duration::from_millis(1)));
        let other = shutdown.clone();
        let waiter = std::thread::spawn(move || other.wait());
        shutdown.set();
        waiter.join().unwrap();
        assert!(shutdown.is_set());
    }

    #[test]
    fn work_that_takes_too_long_is_left_when_the_flag_is_raised() {
        let shutdown = Shutdown::default();
        assert_eq!(shutdown.unless_set("work", || 5).unwrap(), Some(5));
        let (until, released) = mpsc::channel::<()>();
        let raised = shutdown.clone();
        let work = move || {
            raised.set();
            released.recv()
        };
        assert_eq!(shutdown.unless_set("work", work).unwrap(), None);
        drop(until);
    }

    #[test]
    fn a_closed_terminal_is_the_first_wish_and_never_the_second() {
        for signs in [
            // Seconds, the sign, and whether both flags are raised then.
            &[
                (0.0, EndSign::Abandoned, false),
                (5.0, EndSign::Abandoned, false),
                (5.0, EndSign::Asked, true),
            ][..],
            // The time counts from the first signal.
            &[
                (0.0, EndSign::Asked, false),
                (0.299, EndSign::Asked, false),
                (0.31, EndSign::Asked, true),
            ],
        ] {
            let (steps, start, mut first) = (GracefulShutdown::default(), Instant::now(), None);
            assert!(!steps.ending.is_set());
            for &(seconds, sign, is_second) in signs {
                let at = start + Duration::from_secs_f64(seconds);
                steps.note(sign, &mut first, at);
                assert!(steps.ending.is_set());
                assert_eq!(steps.now.is_set(), is_second, "{seconds} s");
            }
        }
    }
}
