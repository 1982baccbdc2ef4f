//! What the replay says of itself, and what the service around it tells it to count.
//! It reads no clock: whoever measures a time passes it in.

use driml_protocol::{ReplayStatus, Tally, Waiting};

use super::Replay;

impl Replay {
    /// Counts a message that could not be read.
    pub fn note_refused_message(&mut self) {
        self.statistics.messages_refused += 1;
    }

    /// Counts `seconds` that a request for a batch waited at the limiter.
    pub fn note_learner_waited(&mut self, seconds: f64) {
        self.statistics.learner_waited_s += seconds;
    }

    /// Counts `seconds` that a chunk waited at the limiter.
    pub fn note_actors_waited(&mut self, seconds: f64) {
        self.statistics.actors_waited_s += seconds;
    }

    /// Sets how many actors are connected.
    pub fn set_actors(&mut self, actors: u32) {
        self.statistics.actors = actors;
    }

    /// Transitions stored since the start, in all shards as far as heard.
    pub const fn inserted_total(&self) -> u64 {
        self.limiter.inserted_total()
    }

    /// Whether all transitions of the run are in.
    pub fn all_in(&self) -> bool {
        self.limiter.all_in()
    }

    /// What was counted here since the start.
    pub const fn tally(&self) -> Tally {
        self.limiter.tally()
    }

    /// Who waits for whom now, for batches of the size that the replay was made for.
    pub fn waiting(&self) -> Waiting {
        match self.limiter.waiting(self.batch_size) {
            Waiting::ActorsWaitForLearner | Waiting::Nobody if self.starving => {
                Waiting::LearnerWaitsForActors
            }
            waiting => waiting,
        }
    }

    /// The account of itself.
    pub fn status(&self) -> ReplayStatus {
        let statistics = &self.statistics;
        ReplayStatus {
            transitions_inserted: self.limiter.tally().inserted,
            transitions_held: self.ring.inserted() - self.ring.oldest(),
            frame_bytes_held: self.ring.frames().bytes_held(),
            transitions_lost: statistics.transitions_lost,
            transitions_duplicated: statistics.transitions_duplicated,
            chunks_retried: statistics.chunks_retried,
            batches_retried: statistics.batches_retried,
            messages_refused: statistics.messages_refused,
            // As are these, below.
            connections_refused: 0,
            rows_sampled: self.limiter.tally().rows_sampled,
            rows_unlearned: statistics.rows_unlearned,
            warmup_transitions: self.config.warmup_transitions,
            episodes: statistics.episodes,
            returns: statistics.returns(),
            k_histogram: statistics.k_histogram.clone(),
            mean_age: statistics.mean_age,
            action_histogram: statistics.action_histogram.clone(),
            waiting: self.waiting(),
            learner_waited_s: statistics.learner_waited_s,
            actors_waited_s: statistics.actors_waited_s,
            actors: statistics.actors,
            // These are known to the service alone.
            actors_acting: 0,
            actors_waiting: 0,
            answer_ms: None,
            insert_ms: None,
            weights_behind_s: None,
            weights_behind_updates: None,
            affinity_version: self.affinity.version(),
            finished: self.limiter.all_in(),
        }
    }

    /// Checks the ring and the counts; panics at the first that is wrong. Slow: for tests.
    pub fn check_valid(&self) {
        self.ring.check_valid();
        if let Some(priorities) = &self.priorities {
            priorities.check_valid(&self.ring, &self.episodes);
        }
        let stored: u64 = self.statistics.action_histogram.iter().sum();
        assert_eq!(
            stored,
            self.ring.inserted(),
            "every transition stored has one action"
        );
        assert_eq!(
            self.resume_point.inserted + stored,
            self.limiter.tally().inserted,
            "every transition stored is counted"
        );
        let served: u64 = self.statistics.k_histogram.iter().sum();
        assert_eq!(
            self.resume_point.rows_sampled + served,
            self.limiter.tally().rows_sampled + self.statistics.rows_unlearned,
            "every row served has one k"
        );
    }
}
