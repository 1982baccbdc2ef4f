//! Counters over what was stored and served: episodes, returns, actions, k and ages.

use std::collections::VecDeque;

use driml_protocol::{EPISODES_MAX, EndedEpisode, EpisodesReply, RETURNS_MAX, ReplayStatus};
use serde::{Deserialize, Serialize};

use super::actors::Difference;

/// Maximum ended episodes kept for clients. Beyond it the oldest are dropped.
const EPISODES_KEPT_MAX: usize = 4 * EPISODES_MAX;
/// The same for a snapshot on disk, which has only the episodes that the recorder has not fetched yet.
const EPISODES_SNAPSHOT_MAX: usize = 1_024;

/// The counters, besides those of the ring and the limiter.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Statistics {
    /// The counters that the status reports. Fields that are known elsewhere keep their defaults.
    pub(crate) counted: ReplayStatus,
    /// Messages in which an actor's count differed from ours.
    differences: u64,
    /// The newest ended episodes, oldest first.
    newest: VecDeque<EndedEpisode>,
    /// How many ended episodes the recording process had at its last request; `None` before its first.
    #[serde(skip)]
    recorded_episodes: Option<u64>,
    /// Whether the recording process is the run's launcher.
    #[serde(skip)]
    launcher_records: bool,
}

impl Statistics {
    /// Creates counters at zero, for k in 0..=`k_max` and actions below `num_actions`.
    pub(crate) fn new(k_max: u32, num_actions: u32) -> Self {
        Self {
            counted: ReplayStatus {
                k_histogram: vec![0; k_max as usize + 1],
                action_histogram: vec![0; num_actions as usize],
                ..ReplayStatus::default()
            },
            ..Self::default()
        }
    }

    /// Resets the counters that the log cannot restore: retried and rejected messages, and waiting times.
    pub(crate) fn without_transient(mut self) -> Self {
        let counted = &mut self.counted;
        (counted.chunks_retried, counted.messages_refused) = (0, 0);
        (counted.learner_waited_s, counted.actors_waited_s) = (0.0, 0.0);
        self
    }

    /// Takes the ended episodes that `before` keeps, if both have counted the same number: a snapshot has only those not yet recorded.
    pub(crate) fn take_episodes(&mut self, before: &mut Self) {
        if self.counted.episodes == before.counted.episodes {
            self.newest = std::mem::take(&mut before.newest);
        }
    }

    /// Also resets the counters of rows drawn, so that only those of transitions stored remain.
    pub(crate) fn without_draws(self) -> Self {
        let mut stored = self.without_transient();
        let counted = &mut stored.counted;
        counted.k_histogram.fill(0);
        (counted.batches_retried, counted.rows_unlearned) = (0, 0);
        (counted.updates_relearned, counted.mean_age) = (0, 0.0);
        stored
    }

    /// Counts a difference between an actor's count and ours. Returns whether to log it: the 1st, 2nd, 4th, 8th and so on.
    pub(crate) fn count_difference(&mut self, Difference { lost, duplicated }: Difference) -> bool {
        if lost == 0 && duplicated == 0 {
            return false;
        }
        self.differences += 1;
        let counted = &mut self.counted;
        counted.transitions_lost = counted.transitions_lost.saturating_add(lost);
        let doubles = &mut counted.transitions_duplicated;
        *doubles = doubles.saturating_add(duplicated);
        self.differences.is_power_of_two()
    }

    pub(crate) fn count_served(&mut self, ks: &[u32]) {
        for &k in ks {
            self.counted.k_histogram[k as usize] += 1;
        }
    }

    /// Subtracts rows that [`Statistics::count_served`] counted, and counts a retried batch.
    pub(crate) fn refund(&mut self, ks: &[u32]) {
        self.counted.batches_retried += 1;
        for &k in ks {
            self.counted.k_histogram[k as usize] -= 1;
        }
    }

    /// Counts an ended episode, and its return if all of the episode was seen.
    pub(crate) fn count_episode(&mut self, episode: EndedEpisode) {
        self.counted.episodes += 1;
        if self.newest.len() == EPISODES_KEPT_MAX {
            self.newest.pop_front();
        }
        self.newest.push_back(episode);
        let returns = &mut self.counted.returns;
        if let Some(totals) = episode.totals {
            returns.known += 1;
            if returns.newest.len() == RETURNS_MAX {
                returns.newest.remove(0);
            }
            returns.newest.push(totals.episode_return);
        }
    }

    pub(crate) fn episodes_since(&self, since: u64) -> EpisodesReply {
        let (ended, kept) = (self.counted.episodes, self.newest.len() as u64);
        let before = since.clamp(ended - kept, ended);
        let skipped = (before + kept - ended) as usize;
        let episodes = self.newest.iter().skip(skipped).take(EPISODES_MAX);
        EpisodesReply {
            ended,
            before,
            episodes: episodes.copied().collect(),
        }
    }

    /// Notes that a recorder has the first `episodes` ended episodes. Once the launcher records, other clients no longer count.
    pub(crate) fn set_recorded(&mut self, episodes: u64, is_launcher: bool) {
        if is_launcher || !self.launcher_records {
            self.recorded_episodes = Some(episodes.min(self.counted.episodes));
            self.launcher_records = is_launcher;
        }
    }

    pub(crate) fn check(&self) -> Result<(), &'static str> {
        let (ended, returns) = (self.counted.episodes, &self.counted.returns);
        let fits = self.newest.len() <= EPISODES_KEPT_MAX
            && self.newest.len() as u64 <= ended
            && returns.newest.len() <= RETURNS_MAX
            && returns.known <= ended;
        match fits {
            true => Ok(()),
            false => Err("the state has more episodes than have ended"),
        }
    }

    /// Returns the statistics for a snapshot: without connected actors, and with unrecorded episodes only.
    pub(crate) fn for_snapshot(&self) -> Self {
        let mut logged = self.clone();
        // Connections do not outlive the process.
        logged.counted.actors = 0;
        let recorded = logged.recorded_episodes.take();
        let unrecorded = recorded.map_or(0, |it| self.counted.episodes - it);
        let kept = EPISODES_SNAPSHOT_MAX.min(unrecorded as usize);
        let newest = logged.newest.len();
        logged.newest.drain(..newest.saturating_sub(kept));
        logged
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_are_handed_out_once_and_in_order_and_the_oldest_are_let_go() {
        let mut statistics = Statistics::new(1, 1);
        assert_eq!(statistics.episodes_since(0), EpisodesReply::default());
        let end = |statistics: &mut Statistics, frames| {
            statistics.count_episode(EndedEpisode {
                frames,
                actor: 0,
                env: 0,
                totals: None,
            });
        };
        let most = EPISODES_MAX as u64;
        (0..most + 5).for_each(|n| end(&mut statistics, n));
        let first = statistics.episodes_since(0);
        assert_eq!((first.before, first.episodes.len()), (0, EPISODES_MAX));
        let second = statistics.episodes_since(first.next_since());
        let frames = second.episodes.iter().map(|it| it.frames);
        assert!(frames.eq(most..most + 5));
        assert_eq!(second.next_since(), second.ended);
        assert_eq!(statistics.episodes_since(second.next_since()).episodes, []);
        // A client that has more episodes than ended here counts those of another server.
        assert_eq!(statistics.episodes_since(u64::MAX).before, most + 5);

        let all = EPISODES_KEPT_MAX as u64 + 7;
        (most + 5..all).for_each(|n| end(&mut statistics, n));
        let late = statistics.episodes_since(0);
        assert_eq!((late.before, late.episodes[0].frames), (7, 7));
        assert_eq!(statistics.counted.episodes, all);
        // Once the launcher records, it alone says which episodes need not be kept.
        for (recorded, logged) in [
            (None, 0),
            (Some((9, false)), EPISODES_SNAPSHOT_MAX),
            (Some((all - 3, false)), 3),
            (Some((all - 4, true)), 4),
            (Some((all, false)), 4),
            (Some((all, true)), 0),
        ] {
            if let Some((episodes, is_launcher)) = recorded {
                statistics.set_recorded(episodes, is_launcher);
            }
            let reply = statistics.for_snapshot().episodes_since(0);
            assert_eq!((reply.next_since(), reply.episodes.len()), (all, logged));
        }
    }
}
