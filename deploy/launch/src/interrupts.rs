//! Counts how often this process was asked to stop: by Ctrl-C, by SIGTERM, or by closing the terminal or pipe.
//! The first is a wish to drain, the second to end at once; the caller decides.

use std::{
    ops::ControlFlow,
    time::{Duration, Instant},
};

use driml_protocol::{
    GracefulShutdown,
    termination::{self, EndSign},
};

/// Signals closer together are one wish: tools such as `timeout` signal the process and its group.
const ONE_WISH: Duration = Duration::from_millis(300);

/// A shared count of interrupts, up to two.
#[derive(Clone, Debug, Default)]
pub struct Interrupts(GracefulShutdown);

impl Interrupts {
    /// Starts to listen for signs that this process should end, for the rest of its life; the death of the process `parent` is
    /// one.
    pub fn listen(parent: Option<u32>) -> std::io::Result<Self> {
        let this = Self::default();
        let (counted, mut first) = (this.clone(), None);
        termination::listen("interrupts", parent, move |sign| {
            counted.note(sign, &mut first, Instant::now());
            ControlFlow::Continue(())
        })?;
        Ok(this)
    }

    /// Counts a sign received at `now`. `first` is when the first request began.
    fn note(&self, sign: EndSign, first: &mut Option<Instant>, now: Instant) {
        match *first {
            None => {
                *first = Some(now);
                self.0.ending.set();
            }
            // A closed terminal sends SIGHUP, and the other signs follow: no user is there who wants it faster.
            Some(first) if sign == EndSign::Asked && now - first > ONE_WISH => self.0.now.set(),
            Some(_) => {}
        }
    }

    /// How many there were.
    pub fn count(&self) -> u32 {
        u32::from(self.0.ending.is_set()) + u32::from(self.0.now.is_set())
    }

    /// Sleeps until there are two.
    pub(crate) fn wait_for_second(&self) {
        self.0.now.wait();
    }

    /// Sleeps for `timeout`, or until there is one; returns how many there were. After the first one it returns at once.
    pub fn wait_timeout(&self, timeout: Duration) -> u32 {
        self.0.ending.wait_timeout(timeout);
        self.count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_terminal_is_the_first_wish_and_never_the_second() {
        let interrupts = Interrupts::default();
        assert_eq!(interrupts.wait_timeout(Duration::from_millis(1)), 0);
        let (start, mut first) = (Instant::now(), None);
        let mut note = |sign, seconds| {
            interrupts.note(sign, &mut first, start + Duration::from_secs(seconds));
            interrupts.wait_timeout(Duration::from_secs(60))
        };
        assert_eq!(note(EndSign::Abandoned, 0), 1);
        assert_eq!(note(EndSign::Abandoned, 5), 1);
        assert_eq!(note(EndSign::Asked, 5), 2, "a second request");
        assert_eq!(note(EndSign::Abandoned, 20), 2);

        let (interrupts, mut first) = (Interrupts::default(), None);
        let mut note = |ms| {
            let now = start + Duration::from_millis(ms);
            interrupts.note(EndSign::Asked, &mut first, now);
            interrupts.count()
        };
        assert_eq!(
            [0, 299, 310].map(&mut note),
            [1, 1, 2],
            "from the first signal on"
        );
    }
}
