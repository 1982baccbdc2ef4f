//! Fail points for tests: with `DRIML_TEST_PANIC=NAME` in the environment, the thread that reaches the point NAME panics. With
//! `DRIML_TEST_HOLD=UPDATES FILE`, a learner that has made this many updates waits until the file exists.
//! They exist in debug builds only; a release build reads no such variables.

use std::{env, path::Path, sync::OnceLock, thread::sleep, time::Duration};

/// The variable that names the point at which to panic.
pub const PANIC_VAR: &str = "DRIML_TEST_PANIC";

/// In a debug build, panics if `DRIML_TEST_PANIC` names this point; else does nothing.
///
/// Every worker thread passes one point, named like the thread, in each iteration of its loop. So a test can show for each thread that a
/// panic ends the process.
#[inline]
#[track_caller]
pub fn reach(name: &str) {
    static WANTED: OnceLock<Option<String>> = OnceLock::new();
    if cfg!(debug_assertions) {
        let wanted = WANTED.get_or_init(|| env::var(PANIC_VAR).ok());
        assert!(wanted.as_deref() != Some(name), "{PANIC_VAR}={name}");
    }
}

/// The variable that gives the number of updates after which to wait, and the file to wait for.
pub const HOLD_VAR: &str = "DRIML_TEST_HOLD";

/// In a debug build, waits for the file in `DRIML_TEST_HOLD` once `updates` has reached the number there; else does nothing.
///
/// A held run does not finish before the test that watches it is done, however slow the test is.
#[inline]
pub fn hold(updates: u64) {
    static WANTED: OnceLock<Option<(u64, String)>> = OnceLock::new();
    let read = || {
        let text = env::var(HOLD_VAR).ok()?;
        let (count, file) = text.split_once(' ')?;
        Some((count.parse().ok()?, file.to_owned()))
    };
    if cfg!(debug_assertions)
        && let Some((count, file)) = WANTED.get_or_init(read)
    {
        while updates >= *count && !Path::new(file).exists() {
            sleep(Duration::from_millis(10));
        }
    }
}
