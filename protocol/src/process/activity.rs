//! What a process is doing, and since when, as text for `driml status`.
//! The process sets the text; nothing is measured here.

use std::{
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use super::lock;

/// The current activity of a process. Clones share it.
#[derive(Clone, Debug)]
pub struct Activity(Arc<Mutex<(String, Instant)>>);

impl Activity {
    /// Starts with the activity `doing`, such as `plays` or `waits for a batch`.
    pub fn new(doing: &str) -> Self {
        Self(Arc::new(Mutex::new((doing.to_owned(), Instant::now()))))
    }

    /// Sets the activity from now on; the same activity keeps its start time.
    pub fn begin(&self, doing: &str) {
        let mut now = lock(&self.0);
        if now.0 != doing {
            *now = (doing.to_owned(), Instant::now());
        }
    }

    /// Returns the activity and its duration.
    pub fn get(&self) -> (String, Duration) {
        let now = lock(&self.0);
        (now.0.clone(), now.1.elapsed())
    }
}
