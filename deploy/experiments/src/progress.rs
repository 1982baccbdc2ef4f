//! Shows the progress of an experiment and the time left: a bar on a terminal, else a line from time to time.
//! It also checks for Ctrl-C after every unit of work.

use std::time::Instant;

use driml_launch::console::{Screen, wrap};
use driml_machine::{error::Interrupted, units::rough_duration};
use driml_protocol::GracefulShutdown;

const PROGRESS_TEMPLATE: &str = "{bar:40} {percent:>3}%\n{msg}";

/// Counts units of work, such as updates.
#[derive(Debug)]
pub(crate) struct Progress {
    total: u64,
    done: u64,
    /// The units that an earlier start did; they do not count for the speed.
    earlier: u64,
    started: Instant,
    task: String,
    screen: Screen,
    /// The flag `drain` is set by the first Ctrl-C or signal, `immediate` by the second.
    pub(crate) shutdown: GracefulShutdown,
}

impl Progress {
    pub(crate) fn new(total: u64, shutdown: GracefulShutdown) -> Self {
        Self {
            total,
            done: 0,
            earlier: 0,
            started: Instant::now(),
            task: String::new(),
            screen: Screen::new(total, PROGRESS_TEMPLATE),
            shutdown,
        }
    }

    pub(crate) fn set_task(&mut self, task: &str) {
        self.task = task.to_owned();
    }

    pub(crate) fn count_earlier(&mut self, units: u64) {
        self.count(units);
        self.earlier += units;
    }

    fn count(&mut self, units: u64) {
        self.done += units;
        debug_assert!(self.done <= self.total, "more work than was announced");
    }

    pub(crate) const fn done(&self) -> u64 {
        self.done
    }

    /// Adds units to the total: work that turns out to be needed, or that failed and must be done again.
    pub(crate) fn add_work(&mut self, units: u64) {
        self.total += units;
        if let Some(bar) = self.screen.bar() {
            bar.set_length(self.total);
        }
    }

    pub(crate) fn advance(&mut self, units: u64) -> Result<(), Interrupted> {
        self.count(units);
        self.show();
        if self.is_interrupted() {
            self.clear();
            return Err(Interrupted);
        }
        Ok(())
    }

    /// Whether a Ctrl-C or a signal asked the experiment to stop.
    pub(crate) fn is_interrupted(&self) -> bool {
        self.shutdown.drain.is_set()
    }

    pub(crate) fn line(&self, line: &str) {
        self.screen.print_line(line);
    }

    pub(crate) fn clear(&self) {
        self.screen.clear();
    }

    fn show(&mut self) {
        let left = match self.seconds_left(self.started.elapsed().as_secs_f64()) {
            Some(seconds) => format!("about {} left", rough_duration(seconds)),
            None => "the time left is not known yet".to_owned(),
        };
        let (task, percent) = (&self.task, 100 * self.done / self.total.max(1));
        let done = self.done.min(self.total);
        self.screen.show(done, |beside_bar| match beside_bar {
            true => wrap(&format!("{task}, {left}"), " ", 0),
            false => format!("{percent:>3}%  {task}, {left}"),
        });
    }

    /// Returns the seconds left at the speed so far; `None` until this start has done some work.
    pub(crate) fn seconds_left(&self, elapsed: f64) -> Option<f64> {
        let new_units = self.done - self.earlier;
        let left = self.total.saturating_sub(self.done);
        (new_units > 0).then(|| elapsed / new_units as f64 * left as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_follows_from_the_work_of_this_start() {
        let mut progress = Progress::new(100, GracefulShutdown::default());
        progress.count_earlier(40);
        assert_eq!(progress.seconds_left(5.0), None);
        progress.advance(10).unwrap();
        assert_eq!(progress.seconds_left(5.0), Some(25.0));
        assert!(indicatif::ProgressStyle::with_template(PROGRESS_TEMPLATE).is_ok());
    }
}
