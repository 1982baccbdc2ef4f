//! Waits for other processes by polling, with a deadline; and does several such waits at the same time.

use std::{
    thread,
    time::{Duration, Instant},
};

/// The time-out of each wait. The longest waits are for experiments of many runs: three minutes if four other processes share the same two
/// cores. The time-out of a CI job is longer.
const DEADLINE: Duration = Duration::from_secs(600);
/// Limits of the pause between two checks of a condition. The pause is as long as a check, because a check may start a process.
const LOOK_AGAIN: [Duration; 2] = [Duration::from_millis(10), Duration::from_millis(200)];

/// Waits until `look` returns a value, and returns it. Panics at the deadline.
pub fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        let looked = Instant::now();
        if let Some(seen) = look() {
            return seen;
        }
        assert!(
            started.elapsed() < DEADLINE,
            "waited {DEADLINE:?} for: {what}"
        );
        thread::sleep(looked.elapsed().clamp(LOOK_AGAIN[0], LOOK_AGAIN[1]));
    }
}

/// Waits until `holds` returns true. Panics at the deadline.
pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    wait_for(what, || holds().then_some(()));
}

/// Calls `work` for all items at the same time, one thread each. Meant for work that mostly waits.
pub fn at_once<T: Send>(items: impl IntoIterator<Item = T>, work: impl Fn(T) + Sync) {
    let work = &work;
    thread::scope(|scope| {
        for item in items {
            scope.spawn(move || work(item));
        }
    });
}
