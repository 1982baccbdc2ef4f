//! Enforces the replay ratio: decides which side is ahead and has to wait.
//! It does not wait itself, has no clock, and does not know which transitions are stored.

use driml_protocol::{ShardCounts, Waiting};
use serde::{Deserialize, Serialize};

use crate::config::Config;

/// Counts transitions in and rows out, and keeps rows / transitions after the warm-up at the replay ratio.
///
/// Its one quantity is the credit, in rows: replay ratio * transitions after the warm-up - rows sampled. A batch of B rows
/// needs a credit of B; inserts wait while the credit is above slack * replay ratio. With slack * replay ratio >= B at least
/// one side can always proceed. Source: the rate limiter of Reverb (Cassirer et al. 2021), with the ratio counted exactly.
///
/// `replay_ratio` is rlpyt's word for Reverb's `samples_per_insert`: rows sampled per transition inserted, not updates per step.
#[derive(Clone, Debug)]
pub struct RateLimiter {
    config: Config,
    pub(crate) counts: LimiterCounts,
    pub(crate) is_run_over: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct LimiterCounts {
    pub(crate) this_shard: ShardCounts,
    /// The counts of the other shards, as the learner last reported them.
    pub(crate) other_shards: ShardCounts,
    /// Transitions that refilled this shard after a resume without its replay; `this_shard` does not include them.
    pub(crate) refilled: u64,
    /// Transitions that must still be refilled before rows are sampled.
    pub(crate) refill_left: u64,
}

impl RateLimiter {
    /// Creates a limiter with nothing stored or sampled. If a resume changed the ratio, `config.since` is the point from which it holds.
    pub fn new(config: &Config) -> Self {
        Self {
            config: config.clone(),
            counts: LimiterCounts::default(),
            is_run_over: false,
        }
    }

    /// Sets the counts of this shard and of the other shards.
    #[must_use]
    pub const fn with_counts(mut self, this_shard: ShardCounts, other_shards: ShardCounts) -> Self {
        (self.counts.this_shard, self.counts.other_shards) = (this_shard, other_shards);
        self
    }

    /// Returns the transitions stored in all shards.
    pub fn inserted_total(&self) -> u64 {
        (self.counts.this_shard + self.counts.other_shards).inserted
    }

    /// Returns the rows sampled from all shards.
    pub fn rows_sampled_total(&self) -> u64 {
        (self.counts.this_shard + self.counts.other_shards).rows_sampled
    }

    /// Sets the counts of the other shards.
    ///
    /// # Errors
    /// More transitions than the run can ever have, or more rows than the ratio allows for them; the reason, for a person.
    pub fn set_other_shards(&mut self, others: ShardCounts) -> Result<(), String> {
        let before = self.counts.other_shards;
        // Tolerance for transitions that a shard stores before the others report.
        let held_max = self.config.capacity_transitions;
        // Each of them stores up to the end of the run, if no learner reports meanwhile.
        let max = self.config.transitions_max.unwrap_or(u64::MAX);
        let max = max.saturating_mul(u64::from(self.config.shards) - 1);
        let inserted_max = max.max(before.inserted).saturating_add(held_max);
        if others.inserted > inserted_max {
            return Err(format!(
                "the other shards' count of stored transitions is {}; this run has at most {inserted_max}",
                others.inserted
            ));
        }
        // With more rows counted, the learner would wait for transitions that never come.
        let inserted = others.inserted.max(before.inserted);
        let inserted = inserted.saturating_add(self.counts.this_shard.inserted);
        let start = self.config.ratio_start();
        let allowed = start.rows as f64 + self.config.replay_ratio * inserted as f64;
        let slack_rows = self.config.slack_transitions.saturating_add(held_max) as f64
            * self.config.replay_ratio;
        let rows_max = allowed.max(before.rows_sampled as f64) + slack_rows;
        if others.rows_sampled as f64 > rows_max {
            return Err(format!(
                "the other shards' count of sampled rows is {}; for {inserted} transitions a run samples at most {rows_max:.0}",
                others.rows_sampled
            ));
        }
        self.counts.other_shards = others;
        Ok(())
    }

    fn credit(&self) -> f64 {
        // Transitions before the start of the ratio allow only the rows sampled by then.
        let start = self.config.ratio_start();
        let after = self.inserted_total().saturating_sub(start.transitions);
        let allowed = start.rows as f64 + self.config.replay_ratio * after as f64;
        allowed - self.rows_sampled_total() as f64
    }

    /// Whether a chunk may be stored now; chunks are stored whole, so inserts may overshoot by one chunk.
    pub fn may_insert(&self) -> bool {
        let is_ahead =
            self.credit() > self.config.slack_transitions as f64 * self.config.replay_ratio;
        !self.all_stored() && (self.counts.refill_left > 0 || !is_ahead)
    }

    /// Whether `rows` rows may be sampled now.
    pub fn may_sample(&self, rows: u32) -> bool {
        self.counts.refill_left == 0
            && self.inserted_total() >= self.config.warmup_transitions
            && f64::from(rows) <= self.credit()
    }

    /// Whether the run is over, or all its transitions are stored by the last counts of the other shards. N shards store less than N *
    /// (slack + 2 * batch size / replay ratio + a chunk) too many: `may_insert` bounds what each stores between reports after the warm-up.
    pub fn all_stored(&self) -> bool {
        let max = self.config.transitions_max;
        let are_stored = max.is_some_and(|max| self.inserted_total() >= max);
        self.is_run_over || self.counts.refill_left == 0 && are_stored
    }

    /// Whether all transitions are stored and no further batch of `rows` rows is allowed.
    pub fn is_finished(&self, rows: u32) -> bool {
        self.all_stored() && !self.may_sample(rows)
    }

    /// Returns the maximum rows of one request. With more, both sides could wait for each other.
    pub fn rows_max(&self) -> u32 {
        (self.config.slack_transitions as f64 * self.config.replay_ratio) as u32
    }

    /// Counts `transitions` stored.
    pub fn count_inserted(&mut self, transitions: u64) {
        let counts = &mut self.counts;
        let refilled = transitions.min(counts.refill_left);
        counts.refill_left -= refilled;
        counts.refilled += refilled;
        counts.this_shard.inserted += transitions - refilled;
    }

    /// Counts `rows` sampled.
    pub fn count_sampled(&mut self, rows: u32) {
        debug_assert!(self.may_sample(rows), "{rows} rows beyond the replay ratio");
        self.counts.this_shard.rows_sampled += u64::from(rows);
    }

    /// Subtracts `rows` rows that were sampled but never learned from.
    pub fn refund(&mut self, rows: u64) {
        let rows_sampled = &mut self.counts.this_shard.rows_sampled;
        *rows_sampled = rows_sampled.saturating_sub(rows);
    }

    /// Resumes a run after the counts `counted` of this shard with an empty ring: `refill` transitions must be stored before the next row
    /// is sampled, unless the run has no batch of `rows` rows left to sample.
    pub(crate) fn resume_with_refill(&mut self, counted: ShardCounts, refill: u64, rows: u32) {
        self.counts.this_shard = counted;
        if !self.is_finished(rows) {
            self.counts.refill_left = refill;
        }
    }

    /// Returns this shard's counts since the start of the run.
    pub const fn counts(&self) -> ShardCounts {
        self.counts.this_shard
    }

    /// Returns which side waits, for batches of `rows` rows.
    pub fn waiting(&self, rows: u32) -> Waiting {
        let refilled = self.counts.refilled;
        let (have, need) = match self.counts.refill_left {
            0 => (self.inserted_total(), self.config.warmup_transitions),
            left => (refilled, refilled + left),
        };
        if self.is_finished(rows) {
            Waiting::Finished
        } else if have < need {
            Waiting::WarmUp { have, need }
        } else if !self.may_sample(rows) {
            Waiting::LearnerWaitsForActors
        } else if !self.may_insert() && !self.all_stored() {
            Waiting::ActorsWaitForLearner
        } else {
            Waiting::Neither
        }
    }
}
