//! The last warning or error of this process, for status reports.
//! The logger stores the warning here, and also writes log lines elsewhere.

use std::{
    sync::Mutex,
    time::{Duration, Instant},
};

use super::lock;

static LAST: Mutex<Option<(String, Instant)>> = Mutex::new(None);

/// Stores a warning in place of the previous one.
pub fn set(text: String) {
    *lock(&LAST) = Some((text, Instant::now()));
}

/// Returns the last warning and its age; `None` if there was none.
pub fn get() -> Option<(String, Duration)> {
    let last = lock(&LAST);
    last.as_ref().map(|(text, at)| (text.clone(), at.elapsed()))
}
