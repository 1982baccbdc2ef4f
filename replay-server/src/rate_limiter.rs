//! Holds the replay ratio: it says which side is ahead and has to wait.
//! It does not wait itself, keep time or know what is stored.

use driml_protocol::{Tally, Waiting};

/// Counts transitions in and rows out, and keeps rows / transitions after the warm-up at the replay ratio.
///
/// Its one quantity is the credit, in rows: replay ratio * transitions after the warm-up - rows sampled. A batch of B rows
/// needs a credit of B; inserts wait while the credit is above slack * replay ratio. With slack * replay ratio >= B at least
/// one side can always go on. Source: the rate limiter of Reverb (Cassirer et al. 2021), with the ratio counted exactly.
///
/// `replay_ratio` is rlpyt's word for Reverb's `samples_per_insert`: rows sampled per transition inserted, not updates per step.
#[derive(Clone, Debug)]
pub struct RateLimiter {
    replay_ratio: f64,
    warmup_transitions: u64,
    slack_transitions: u64,
    transitions_max: Option<u64>,
    this_shard: Tally,
    /// What the replay's other shards have counted, as far as heard.
    other_shards: Tally,
}

impl RateLimiter {
    /// Nothing stored, nothing sampled. The arguments are those of `Config`, validated there.
    pub fn new(
        replay_ratio: f64,
        warmup_transitions: u64,
        slack_transitions: u64,
        transitions_max: Option<u64>,
    ) -> Self {
        Self {
            replay_ratio,
            warmup_transitions,
            slack_transitions,
            transitions_max,
            this_shard: Tally::default(),
            other_shards: Tally::default(),
        }
    }

    /// The same, in a run that goes on after so much was counted here and in the replay's other shards.
    #[must_use]
    pub fn resumed_at(self, this_shard: Tally, other_shards: Tally) -> Self {
        Self {
            this_shard,
            other_shards,
            ..self
        }
    }

    /// Transitions stored in all shards.
    pub const fn inserted_total(&self) -> u64 {
        self.this_shard
            .inserted
            .saturating_add(self.other_shards.inserted)
    }

    /// Rows sampled from all shards.
    pub const fn rows_sampled_total(&self) -> u64 {
        self.this_shard
            .rows_sampled
            .saturating_add(self.other_shards.rows_sampled)
    }

    /// Takes what the other shards have counted; counts never fall.
    pub fn set_other_shards(&mut self, other_shards: Tally) {
        let Tally {
            inserted,
            rows_sampled,
        } = &mut self.other_shards;
        *inserted = other_shards.inserted.max(*inserted);
        *rows_sampled = other_shards.rows_sampled.max(*rows_sampled);
    }

    /// What the other shards have counted, as far as heard.
    pub(crate) const fn other_shards(&self) -> Tally {
        self.other_shards
    }

    fn after_warmup(&self) -> u64 {
        self.inserted_total()
            .saturating_sub(self.warmup_transitions)
    }

    /// Rows allowed so far, whether sampled or not.
    fn rows_allowed(&self) -> f64 {
        self.replay_ratio * self.after_warmup() as f64
    }

    fn credit(&self) -> f64 {
        let Tally { rows_sampled, .. } = self.this_shard + self.other_shards;
        self.rows_allowed() - rows_sampled as f64
    }

    /// Whether a chunk may be stored now; chunks are stored whole, so inserts may overshoot by one chunk.
    pub fn may_insert(&self) -> bool {
        !self.all_in() && self.credit() <= self.slack_transitions as f64 * self.replay_ratio
    }

    /// Whether `rows` rows may be sampled now.
    pub fn may_sample(&self, rows: u32) -> bool {
        self.inserted_total() >= self.warmup_transitions && f64::from(rows) <= self.credit()
    }

    /// Whether all transitions of the run are in.
    pub fn all_in(&self) -> bool {
        self.transitions_max
            .is_some_and(|max| self.inserted_total() >= max)
    }

    /// Whether all transitions are in and no further batch of `rows` is allowed.
    pub fn finished(&self, rows: u32) -> bool {
        self.all_in() && !self.may_sample(rows)
    }

    /// Most rows that can ever be asked for at once; for more, both sides could wait for each other.
    pub fn rows_max(&self) -> u32 {
        (self.slack_transitions as f64 * self.replay_ratio) as u32
    }

    /// Counts `transitions` stored.
    pub fn inserted(&mut self, transitions: u64) {
        self.this_shard.inserted += transitions;
    }

    /// Counts `rows` sampled.
    pub fn sampled(&mut self, rows: u32) {
        debug_assert!(self.may_sample(rows), "{rows} rows beyond the replay ratio");
        self.this_shard.rows_sampled += u64::from(rows);
    }

    /// Counts `rows` that were sampled before, whatever the replay ratio allowed then.
    pub(crate) fn sampled_before(&mut self, rows: u64) {
        let sampled = &mut self.this_shard.rows_sampled;
        *sampled = sampled.saturating_add(rows);
    }

    /// Counts `rows` that were sampled, and of which nothing was learned, as not sampled.
    pub fn refund(&mut self, rows: u64) {
        let rows_sampled = &mut self.this_shard.rows_sampled;
        *rows_sampled = rows_sampled.saturating_sub(rows);
    }

    /// What was counted here since the start.
    pub const fn tally(&self) -> Tally {
        self.this_shard
    }

    /// Who waits, for batches of `rows`.
    pub fn waiting(&self, rows: u32) -> Waiting {
        if self.finished(rows) {
            Waiting::Finished
        } else if self.inserted_total() < self.warmup_transitions {
            Waiting::WarmUp {
                have: self.inserted_total(),
                need: self.warmup_transitions,
            }
        } else if !self.may_sample(rows) {
            Waiting::LearnerWaitsForActors
        } else if !self.may_insert() && !self.all_in() {
            Waiting::ActorsWaitForLearner
        } else {
            Waiting::Nobody
        }
    }
}
