//! What a process is doing, and since when, as text for `driml status`.
//! The process reports it; nothing is observed here.

use std::{
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use super::lock;

/// What a process is doing now. Clones are the same.
#[derive(Clone, Debug)]
pub struct Activity(Arc<Mutex<(String, Instant)>>);

impl Activity {
    /// It begins with `doing`, such as `plays` or `waits for a batch`.
    pub fn new(doing: &str) -> Self {
        Self(Arc::new(Mutex::new((doing.to_owned(), Instant::now()))))
    }

    /// Sets what it does from now on; the same activity keeps its start time.
    pub fn begin(&self, doing: &str) {
        let mut now = lock(&self.0);
        if now.0 != doing {
            *now = (doing.to_owned(), Instant::now());
        }
    }

    /// What it does, and for how long.
    pub fn get(&self) -> (String, Duration) {
        let now = lock(&self.0);
        (now.0.clone(), now.1.elapsed())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_activity_keeps_its_start() {
        let activity = Activity::new("plays");
        std::thread::sleep(Duration::from_millis(20));
        activity.begin("plays");
        assert!(activity.get().1 >= Duration::from_millis(20));
        activity.clone().begin("waits");
        let (doing, since) = activity.get();
        assert_eq!(doing, "waits");
        assert!(since < Duration::from_millis(20));
    }
}
