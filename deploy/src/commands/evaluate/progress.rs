//! How far an evaluation is: a bar on a terminal, elsewhere a line on stderr now and then.

use std::time::{Duration, Instant};

use driml_launch::{console::Screen, stats::mean_and_deviation, view::TEMPLATE};

const PLAIN_PERIOD: Duration = Duration::from_secs(5);

/// The view of one policy's episodes. Dropping it takes it away.
pub(super) struct Progress {
    policy: String,
    episodes: usize,
    screen: Screen,
    plain_next: Instant,
}

impl Progress {
    pub(super) fn new(policy: &str, episodes: usize) -> Self {
        Self {
            policy: policy.to_owned(),
            episodes,
            screen: Screen::new(episodes as u64, TEMPLATE),
            plain_next: Instant::now() + PLAIN_PERIOD,
        }
    }

    pub(super) fn see(&mut self, returns: &[f64]) {
        let now = Instant::now();
        if let Some(bar) = self.screen.bar() {
            bar.set_position(returns.len() as u64);
            bar.set_message(self.describe(returns));
        } else if now >= self.plain_next {
            self.plain_next = now + PLAIN_PERIOD;
            self.screen.line(&self.describe(returns));
        }
    }

    fn describe(&self, returns: &[f64]) -> String {
        let (policy, done, of) = (&self.policy, returns.len(), self.episodes);
        let mean = match done {
            0 => String::new(),
            _ => format!(", mean return {:.3}", mean_and_deviation(returns).0),
        };
        format!("{policy}: {done} of {of} episodes{mean}")
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.screen.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_episodes_and_their_mean() {
        let progress = Progress::new("c51", 100);
        assert_eq!(progress.describe(&[]), "c51: 0 of 100 episodes");
        let said = progress.describe(&[1.0, 2.0]);
        assert_eq!(said, "c51: 2 of 100 episodes, mean return 1.500");
    }
}
