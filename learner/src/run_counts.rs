//! The counts of a run so far. The learner keeps them in its checkpoints, as no other process knows which rows it learned.
//! No number is derived: each was counted.

use driml_protocol::ShardCounts;
use serde::{Deserialize, Serialize};

/// Largest valid count. No run comes near it, and additions to valid counts cannot overflow.
pub(crate) const COUNT_MAX: u64 = 1 << 53;

/// The counts of a run so far, except its updates.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunCounts {
    /// Identifier of the run: a random number that its first learner drew; 0 before.
    pub run: u64,
    /// For each shard of the replay, the transitions stored, by its last report, and the rows learned.
    pub shards: Vec<ShardCounts>,
}

/// Rows of a batch that came from one shard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BatchPart {
    /// Index of the shard.
    pub shard: usize,
    /// Number of rows.
    pub rows: u32,
    /// Transitions that the shard had stored when it sent the rows.
    pub inserted: u64,
}

impl RunCounts {
    /// Frames of the run: transitions stored, in all shards.
    pub fn frames(&self) -> u64 {
        self.shards.iter().map(|it| it.inserted).sum()
    }

    /// Rows learned from all shards.
    pub fn rows(&self) -> u64 {
        self.shards.iter().map(|it| it.rows_sampled).sum()
    }

    /// Adapts the counts to a replay of `shards` shards. If the number of shards has changed, the totals are spread evenly.
    pub fn spread_over(&mut self, shards: usize) {
        if self.shards.len() == shards {
            return;
        }
        let (frames, rows, count) = (self.frames(), self.rows(), shards as u64);
        let share = |all: u64, shard: u64| all / count + u64::from(shard < all % count);
        self.shards = (0..count)
            .map(|shard| ShardCounts::new(share(frames, shard), share(rows, shard)))
            .collect();
    }

    /// Counts a batch that was learned from.
    pub fn add_batch(&mut self, parts: &[BatchPart]) {
        for part in parts {
            self.record_inserted(part.shard, part.inserted);
            self.shards[part.shard].rows_sampled += u64::from(part.rows);
        }
    }

    /// Records that `shard` has stored `inserted` transitions. A lower number than before is ignored.
    pub fn record_inserted(&mut self, shard: usize, inserted: u64) {
        if self.shards.len() <= shard {
            self.shards.resize(shard + 1, ShardCounts::default());
        }
        let known = &mut self.shards[shard].inserted;
        *known = inserted.max(*known);
    }

    /// The sum of the counts of all shards except `this`.
    pub fn other_shards(&self, this: usize) -> ShardCounts {
        let others = self.shards.iter().enumerate();
        let others = others.filter(|(shard, _)| *shard != this);
        others.fold(ShardCounts::default(), |sum, (_, counts)| sum + *counts)
    }

    /// Whether a run can reach these counts.
    pub(crate) fn is_plausible(&self) -> bool {
        let counts = self.shards.iter();
        let mut counts = counts.flat_map(|it| [it.inserted, it.rows_sampled]);
        counts.all(|count| count <= COUNT_MAX) && self.shards.len() <= 1 << 16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_other_shards_are_spread_and_none_is_lost() {
        let part = |shard, rows, inserted| BatchPart {
            shard,
            rows,
            inserted,
        };
        let mut counts = RunCounts::default();
        counts.add_batch(&[part(0, 200, 5_000), part(1, 56, 1_001)]);
        counts.add_batch(&[part(1, 256, 1_000)]);
        assert_eq!((counts.frames(), counts.rows()), (6_001, 512));
        assert_eq!(counts.other_shards(0).rows_sampled, 312);
        for shards in [3, 1, 7, 2] {
            counts.spread_over(shards);
            assert_eq!(counts.shards.len(), shards);
            assert_eq!((counts.frames(), counts.rows()), (6_001, 512));
        }
    }
}
