//! Waiting for what other processes do: by looking, with a deadline; and for several at the same time.

use std::{
    thread,
    time::{Duration, Instant},
};

/// How long any one wait may take. The longest are for experiments of many runs: three minutes where four other processes want the
/// same two cores. A CI job's limit is above it.
const DEADLINE: Duration = Duration::from_secs(600);
/// Between two looks at a condition: as long as a look takes, as one may start a process, within these limits.
const LOOK_AGAIN: [Duration; 2] = [Duration::from_millis(10), Duration::from_millis(200)];

/// Waits until `look` gives something.
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

/// Waits until something holds.
pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    wait_for(what, || holds().then_some(()));
}

/// Does this for all items at the same time, where most of it is waiting.
pub fn at_once<T: Send>(items: impl IntoIterator<Item = T>, work: impl Fn(T) + Sync) {
    let work = &work;
    thread::scope(|scope| {
        for item in items {
            scope.spawn(move || work(item));
        }
    });
}
