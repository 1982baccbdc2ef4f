//! The last warning or error of this process, for status reports.
//! The logger stores it here; where else a log line goes is not known here.

use std::{
    sync::Mutex,
    time::{Duration, Instant},
};

use super::lock;

static LAST: Mutex<Option<(String, Instant)>> = Mutex::new(None);

/// Keeps a warning in the place of the one before.
pub fn note(text: String) {
    *lock(&LAST) = Some((text, Instant::now()));
}

/// The last one and its age; none if there was none.
pub fn get() -> Option<(String, Duration)> {
    let last = lock(&LAST);
    last.as_ref().map(|(text, at)| (text.clone(), at.elapsed()))
}
