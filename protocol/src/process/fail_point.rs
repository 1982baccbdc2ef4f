//! Fail points for tests: with `DRIML_TEST_PANIC=NAME` in the environment, the thread that reaches the point NAME panics; with
//! `DRIML_TEST_HOLD=UPDATES FILE` a learner that has made so many updates waits for the file.
//! They exist in debug builds only; a release build reads no such variables.

use std::{env, path::Path, sync::OnceLock, thread::sleep, time::Duration};

/// The variable that names the point at which to panic.
pub const VARIABLE: &str = "DRIML_TEST_PANIC";

/// Panics if `DRIML_TEST_PANIC` names this point, in a debug build; else does nothing.
///
/// Every working thread passes one such point in each iteration of its loop, named as the thread is. So a test can show for each
/// thread that a panic ends the process.
#[inline]
#[track_caller]
pub fn reach(name: &str) {
    static WANTED: OnceLock<Option<String>> = OnceLock::new();
    if cfg!(debug_assertions) {
        let wanted = WANTED.get_or_init(|| env::var(VARIABLE).ok());
        assert!(wanted.as_deref() != Some(name), "{VARIABLE}={name}");
    }
}

/// The variable that says after how many updates to wait, and for which file.
pub const HOLD: &str = "DRIML_TEST_HOLD";

/// Waits until the file exists that `DRIML_TEST_HOLD` names, if so many `updates` are made, in a debug build; else does nothing.
///
/// A run that is held is not over before the test that watches it has seen and done what it has to, however slow the test is.
#[inline]
pub fn hold(updates: u64) {
    static WANTED: OnceLock<Option<(u64, String)>> = OnceLock::new();
    let read = || {
        let text = env::var(HOLD).ok()?;
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
