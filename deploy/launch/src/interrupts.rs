//! Counts how often this process was asked to stop: by Ctrl-C, by SIGTERM, or by closing the terminal or pipe.
//! The first is a wish to drain, the second to end at once; the caller decides.

use std::{
    ops::ControlFlow,
    sync::{Arc, Condvar, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use driml_protocol::end_signs::{self, EndSign};

/// Signals closer together are one wish: tools such as `timeout` signal the process and its group.
const ONE_WISH: Duration = Duration::from_millis(300);

/// A shared count of interrupts.
#[derive(Clone, Debug, Default)]
pub struct Interrupts {
    state: Arc<(Mutex<u32>, Condvar)>,
}

impl Interrupts {
    /// Starts to listen for signs that this process should end, for the rest of its life; the death of the process `parent` is
    /// one.
    pub fn listen(parent: Option<u32>) -> std::io::Result<Self> {
        let this = Self::default();
        let counted = this.clone();
        let mut last = None;
        end_signs::listen("interrupts", parent, move |sign| {
            counted.note(sign, &mut last, Instant::now());
            ControlFlow::Continue(())
        })?;
        Ok(this)
    }

    /// Counts a signal received at `now`. `last` is when the last request began.
    fn note(&self, sign: EndSign, last: &mut Option<Instant>, now: Instant) {
        let is_new = match sign {
            // Counted from the first signal of a request, so that repeated Ctrl-C always counts.
            EndSign::Asked => last.is_none_or(|last| now - last > ONE_WISH),
            // A closed terminal sends SIGHUP, and the other signs follow: no user is there who wants it faster.
            EndSign::Abandoned => last.is_none(),
        };
        if is_new {
            self.add();
            *last = Some(now);
        }
    }

    fn lock(&self) -> MutexGuard<'_, u32> {
        let count = self.state.0.lock();
        count.expect("no thread panics while holding the count")
    }

    fn add(&self) {
        *self.lock() += 1;
        self.state.1.notify_all();
    }

    /// How many there were.
    pub fn count(&self) -> u32 {
        *self.lock()
    }

    /// Sleeps for `timeout`, or until there is one more; returns how many there were.
    pub fn wait_timeout(&self, timeout: Duration) -> u32 {
        let count = self.lock();
        let before = *count;
        let (_, changed) = &*self.state;
        let waited = changed.wait_timeout_while(count, timeout, |count| *count == before);
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

    #[test]
    fn a_closed_terminal_is_the_first_wish_and_never_the_second() {
        let interrupts = Interrupts::default();
        let (start, mut last) = (Instant::now(), None);
        let mut note = |sign, seconds| {
            interrupts.note(sign, &mut last, start + Duration::from_secs(seconds));
            interrupts.count()
        };
        assert_eq!(note(EndSign::Abandoned, 0), 1);
        assert_eq!(note(EndSign::Abandoned, 5), 1);
        assert_eq!(note(EndSign::Asked, 10), 2, "a second request");
        assert_eq!(note(EndSign::Asked, 10), 2, "the same request");
        assert_eq!(note(EndSign::Abandoned, 20), 2);
    }
}
