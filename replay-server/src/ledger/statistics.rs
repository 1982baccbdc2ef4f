//! Counters over what was stored and served: episodes, returns, actions, k and ages.

use std::collections::VecDeque;

use driml_protocol::{EPISODES_MAX, EndedEpisode, EpisodesReply, RETURNS_OF, ReplayStatus};
use serde::{Deserialize, Serialize};

use super::actors::Difference;

/// Ended episodes that are kept for clients; of more the oldest are dropped.
const EPISODES_KEPT_MAX: usize = 4 * EPISODES_MAX;
/// The same in a snapshot on disk, where a recorder fetches them: those that it has not fetched yet.
const EPISODES_LOGGED_MAX: usize = 1_024;

/// What is counted beside the ring's and the limiter's own counts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Statistics {
    /// As the status says it; what is known elsewhere is at its default here.
    pub(crate) counted: ReplayStatus,
    /// Messages by which an actor's own count differed.
    differences: u64,
    /// The newest of the episodes that ended.
    newest: VecDeque<EndedEpisode>,
    /// How many the process that records them had when it asked last; none before it asks.
    #[serde(skip)]
    recorded: Option<u64>,
    /// That process is the run's launcher.
    #[serde(skip)]
    is_launched: bool,
}

impl Statistics {
    /// Zeros, for k in 0..=`k_max` and actions below `num_actions`.
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

    /// Without what is counted of messages that change nothing, which no log knows of.
    pub(crate) fn of_changes(mut self) -> Self {
        let counted = &mut self.counted;
        (counted.chunks_retried, counted.messages_refused) = (0, 0);
        (counted.learner_waited_s, counted.actors_waited_s) = (0.0, 0.0);
        self
    }

    /// Takes the ended episodes that `before` keeps, if these counts are of the same moment: a snapshot has those alone that were not
    /// recorded.
    pub(crate) fn keep_newest_of(&mut self, before: &mut Self) {
        if self.counted.episodes == before.counted.episodes {
            self.newest = std::mem::take(&mut before.newest);
        }
    }

    /// What is counted of transitions stored, without what is counted of rows drawn.
    pub(crate) fn of_stored(self) -> Self {
        let mut stored = self.of_changes();
        let counted = &mut stored.counted;
        counted.k_histogram.fill(0);
        (counted.batches_retried, counted.rows_unlearned) = (0, 0);
        (counted.updates_relearned, counted.mean_age) = (0, 0.0);
        stored
    }

    /// Counts how an actor's count differs from ours; whether this is worth a line in the log: ever more seldom.
    pub(crate) fn count(&mut self, Difference { lost, duplicated }: Difference) -> bool {
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

    pub(crate) fn served(&mut self, ks: &[u32]) {
        for &k in ks {
            self.counted.k_histogram[k as usize] += 1;
        }
    }

    /// Counts rows that [`Statistics::served`] counted as not served.
    pub(crate) fn refund(&mut self, ks: &[u32]) {
        self.counted.batches_retried += 1;
        for &k in ks {
            self.counted.k_histogram[k as usize] -= 1;
        }
    }

    /// Counts an episode that ended; its return counts if all of it was seen.
    pub(crate) fn episode_ended(&mut self, episode: EndedEpisode) {
        self.counted.episodes += 1;
        if self.newest.len() == EPISODES_KEPT_MAX {
            self.newest.pop_front();
        }
        self.newest.push_back(episode);
        let returns = &mut self.counted.returns;
        if let Some(played) = episode.played {
            returns.known += 1;
            if returns.newest.len() == RETURNS_OF {
                returns.newest.remove(0);
            }
            returns.newest.push(played.episode_return);
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

    /// A recorder has the first so many of them: the launcher, or, where none records, one that watches the run.
    pub(crate) fn note_recorded(&mut self, episodes: u64, is_launcher: bool) {
        if is_launcher || !self.is_launched {
            self.recorded = Some(episodes.min(self.counted.episodes));
            self.is_launched = is_launcher;
        }
    }

    pub(crate) fn check(&self) -> Result<(), &'static str> {
        let (ended, returns) = (self.counted.episodes, &self.counted.returns);
        let fits = self.newest.len() <= EPISODES_KEPT_MAX
            && self.newest.len() as u64 <= ended
            && returns.newest.len() <= RETURNS_OF
            && returns.known <= ended;
        match fits {
            true => Ok(()),
            false => Err("a state with more episodes than have ended"),
        }
    }

    /// What a log keeps of a moment.
    pub(crate) fn logged(&self) -> Self {
        let mut logged = self.clone();
        // Who is connected is not counted.
        logged.counted.actors = 0;
        let recorded = logged.recorded.take();
        let unrecorded = recorded.map_or(0, |it| self.counted.episodes - it);
        let kept = EPISODES_LOGGED_MAX.min(unrecorded as usize);
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
            statistics.episode_ended(EndedEpisode {
                frames,
                actor: 0,
                env: 0,
                played: None,
            });
        };
        let most = EPISODES_MAX as u64;
        (0..most + 5).for_each(|n| end(&mut statistics, n));
        let first = statistics.episodes_since(0);
        assert_eq!((first.before, first.episodes.len()), (0, EPISODES_MAX));
        let second = statistics.episodes_since(first.up_to());
        let frames = second.episodes.iter().map(|it| it.frames);
        assert!(frames.eq(most..most + 5));
        assert_eq!(second.up_to(), second.ended);
        assert_eq!(statistics.episodes_since(second.up_to()).episodes, []);
        // One who knows of more knows another server's.
        assert_eq!(statistics.episodes_since(u64::MAX).before, most + 5);

        let all = EPISODES_KEPT_MAX as u64 + 7;
        (most + 5..all).for_each(|n| end(&mut statistics, n));
        let late = statistics.episodes_since(0);
        assert_eq!((late.before, late.episodes[0].frames), (7, 7));
        assert_eq!(statistics.counted.episodes, all);
        for (recorded, logged) in [
            (None, 0),
            (Some(9), EPISODES_LOGGED_MAX),
            (Some(all - 3), 3),
        ] {
            statistics.recorded = recorded;
            let reply = statistics.logged().episodes_since(0);
            assert_eq!((reply.up_to(), reply.episodes.len()), (all, logged));
        }
    }
}
