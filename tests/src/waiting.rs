//! Waits for other processes by polling, with a deadline; and does several such waits at the same time.

use std::{
    thread,
    time::{Duration, Instant},
};

/// The time-out of each wait. The longest waits are for experiments of many runs: three minutes if four other processes share the same two
/// cores. The time-out of a CI job is longer.
const TIMEOUT: Duration = Duration::from_secs(600);
/// Limits of the pause between two checks of a condition. The pause is as long as a check, because a check may start a process.
const POLL_INTERVAL: [Duration; 2] = [Duration::from_millis(10), Duration::from_millis(200)];

/// Waits until `poll` returns a value, and returns it. Panics at the deadline.
pub fn wait_for<T>(what: &str, mut poll: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        let polled_at = Instant::now();
        if let Some(value) = poll() {
            return value;
        }
        assert!(started.elapsed() < TIMEOUT, "waited {TIMEOUT:?} for {what}");
        let [shortest, longest] = POLL_INTERVAL;
        thread::sleep(polled_at.elapsed().clamp(shortest, longest));
    }
}

/// Waits until `holds` returns true. Panics at the deadline.
pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    wait_for(what, || holds().then_some(()));
}

/// Calls `work` for all items at the same time, one thread each. Meant for work that mostly waits.
pub fn in_parallel<T: Send>(items: impl IntoIterator<Item = T>, work: impl Fn(T) + Sync) {
    let work = &work;
    thread::scope(|scope| {
        for item in items {
            scope.spawn(move || work(item));
        }
    });
}
