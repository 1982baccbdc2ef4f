//! Counters over what was stored and served: episodes, returns, actions, k and ages.
//! It decides nothing.

use std::collections::VecDeque;

use driml_protocol::{RETURNS_OF, Returns};
use serde::{Deserialize, Serialize};

/// What the status reports beside the ring's and the limiter's own counts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Statistics {
    pub(crate) transitions_lost: u64,
    pub(crate) transitions_duplicated: u64,
    pub(crate) chunks_retried: u64,
    pub(crate) batches_retried: u64,
    /// Rows served to a learner that died before it saved what it learned from them.
    pub(crate) rows_unlearned: u64,
    pub(crate) messages_refused: u64,
    /// Messages by which an actor's own count differed.
    pub(crate) differences: u64,
    pub(crate) episodes: u64,
    returns_known: u64,
    returns: VecDeque<f64>,
    pub(crate) k_histogram: Vec<u64>,
    pub(crate) mean_age: f64,
    pub(crate) action_histogram: Vec<u64>,
    pub(crate) learner_waited_s: f64,
    pub(crate) actors_waited_s: f64,
    pub(crate) actors: u32,
}

impl Statistics {
    /// Zeros, for k in 0..=`k_max` and actions below `num_actions`.
    pub(crate) fn new(k_max: u32, num_actions: u32) -> Self {
        Self {
            k_histogram: vec![0; k_max as usize + 1],
            action_histogram: vec![0; num_actions as usize],
            ..Self::default()
        }
    }

    /// Without what is counted of messages that change nothing, which no log knows of.
    pub(crate) fn of_changes(mut self) -> Self {
        (self.chunks_retried, self.messages_refused, self.actors) = (0, 0, 0);
        (self.learner_waited_s, self.actors_waited_s) = (0.0, 0.0);
        self
    }

    /// Counts rows served with these `ks`.
    pub(crate) fn served(&mut self, ks: &[u32]) {
        for &k in ks {
            self.k_histogram[k as usize] += 1;
        }
    }

    /// Counts rows that [`Statistics::served`] counted as not served.
    pub(crate) fn refund(&mut self, ks: &[u32]) {
        self.batches_retried += 1;
        for &k in ks {
            self.k_histogram[k as usize] -= 1;
        }
    }

    /// Counts an episode that ended, with its undiscounted return if all of it was seen.
    pub(crate) fn episode_ended(&mut self, episode_return: Option<f64>) {
        self.episodes += 1;
        if let Some(episode_return) = episode_return {
            self.returns_known += 1;
            if self.returns.len() == RETURNS_OF {
                self.returns.pop_front();
            }
            self.returns.push_back(episode_return);
        }
    }

    /// Returns of the last [`RETURNS_OF`] episodes.
    pub(crate) fn returns(&self) -> Returns {
        Returns {
            known: self.returns_known,
            newest: self.returns.iter().copied().collect(),
        }
    }
}
