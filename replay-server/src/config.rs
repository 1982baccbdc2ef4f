//! The settings of the replay server, and the checks that keep a run from stalling.
//! The rules of the return and of k are not here: they are in the run spec, which every process shares.

use driml_protocol::{
    BatchHeader, RunSpec, Sampling, TRANSITION_BYTES,
    codec::{PAYLOAD_BYTES_MAX, VALUE_BYTES_MAX},
    config::{ConfigError, check, check_range},
};
use serde::{Deserialize, Serialize};

pub(crate) const SHARDS_MAX: u32 = 256;

pub(crate) const SEGMENT_BYTES_MIN: u64 = 1 << 20;
/// Maximum priorities (8 bytes each) of a shard on disk. A snapshot holds all of them and reserves a sixteenth for the rest.
const PRIORITIES_MAX: u64 = VALUE_BYTES_MAX as u64 / 16 * 15 / 8;

/// How frames are stored in memory. Batches are bit for bit the same with each variant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Compression {
    /// Uncompressed: the least work.
    #[default]
    None,
    /// LZ4 over consecutive frames of one stream: a fifth of the memory or less on many but not all Procgen games, and more work per
    /// chunk and batch.
    Lz4,
}

/// The replay server's settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Transitions held; the oldest are overwritten beyond it. Memory: one frame and 32 bytes each, taken as they come.
    pub capacity_transitions: u64,
    /// Replay servers among which the capacity and the actors are spread; the learner draws from each in proportion to what it
    /// holds.
    pub shards: u32,
    /// The rule that draws rows. Settings of earlier versions lack this field and mean uniform sampling.
    #[serde(default)]
    pub sampling: Sampling,
    /// How frames are stored in memory; batches do not depend on it.
    #[serde(default)]
    pub compression: Compression,
    /// Maximum bytes of compressed frames, besides at most 128 bytes per transition. If frames compress badly, the oldest are overwritten
    /// before `capacity_transitions` are held. Default: no limit; compressed frames take no more than uncompressed ones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compressed_bytes_max: Option<u64>,
    /// Rows sampled per transition inserted after the warm-up. More trains longer on each transition.
    pub replay_ratio: f64,
    /// Transitions stored before the replay ratio starts to count and the first row is sampled.
    pub warmup_transitions: u64,
    /// New transitions to store before the first row is sampled, if a run is resumed without its replay. At most the transitions that the
    /// run had stored and `capacity_transitions`, at least the warm-up. Settings of earlier versions lack this field and mean the warm-up.
    #[serde(default)]
    pub refill_transitions: u64,
    /// Transitions that inserts may run ahead of sampling, after the warm-up, before they have to wait.
    pub slack_transitions: u64,
    /// Transitions of the whole run, warm-up included, until [`all_stored`](crate::RateLimiter::all_stored). `None`: no limit.
    pub transitions_max: Option<u64>,
    /// Maximum bytes of all shards on disk, if the replay is kept there (`--replay-dir`, `--durable`). Beyond the limit the oldest
    /// transitions are removed, from memory too, before `capacity_transitions` are held. Default: as many bytes as uncompressed transitions
    /// take in memory, and up to a segment more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub disk_bytes_max: Option<u64>,
    /// Period in milliseconds between flushes, if the replay is kept on disk. Flushed data survives a power cut; written data always
    /// survives the death of the process. 0 flushes before each reply. Default: 1,000.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fsync_ms: Option<u64>,
    /// The point from which `replay_ratio` holds. Set if a resume after the warm-up changed the ratio, the batch size or the warm-up.
    /// Default: the end of the warm-up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub since: Option<RatioStart>,
}

/// The counts of a run when it was resumed with other settings. `driml train --resume` writes them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RatioStart {
    /// Transitions stored.
    pub transitions: u64,
    /// Rows learned.
    pub rows: u64,
    /// Updates done.
    pub updates: u64,
}

/// Returns the environment steps that must follow an anchor in its stream, unless its episode ends before: max(n_step, k_max).
pub(crate) fn lookahead_steps(spec: &RunSpec) -> u32 {
    spec.n_step.max(spec.horizon.k_max())
}

impl Config {
    /// Returns the point from which `replay_ratio` holds.
    pub fn ratio_start(&self) -> RatioStart {
        let since = self.since.unwrap_or_default();
        let transitions = since.transitions.max(self.warmup_transitions);
        RatioStart {
            transitions,
            ..since
        }
    }

    /// Returns settings for tests, benches and checks: one shard in memory, uniform sampling, and limits at which neither side ever waits.
    pub fn unlimited(capacity_transitions: u64) -> Self {
        Self {
            capacity_transitions,
            shards: 1,
            sampling: Sampling::default(),
            compression: Compression::default(),
            compressed_bytes_max: None,
            replay_ratio: 1e6,
            warmup_transitions: 0,
            refill_transitions: 0,
            slack_transitions: 1 << 40,
            transitions_max: None,
            disk_bytes_max: None,
            fsync_ms: None,
            since: None,
        }
    }

    /// Checks that no disk setting is given for a replay in memory. `keep_flags` names the flags that would keep the replay on disk.
    pub fn check_in_memory(&self, keep_flags: &str) -> Result<(), ConfigError> {
        let why = format!(
            "this replay is only in memory; add {keep_flags} to keep it on disk, or leave the setting out"
        );
        for (key, set) in [
            ("replay.disk_bytes_max", self.disk_bytes_max),
            ("replay.fsync_ms", self.fsync_ms),
        ] {
            check(set.is_none(), key, set.unwrap_or(0), &why)?;
        }
        Ok(())
    }

    /// Checks that `disk_bytes_max` is at least what the replay needs, for a replay that is kept on disk.
    pub fn check_disk_budget(&self, spec: &RunSpec) -> Result<(), ConfigError> {
        let least = disk_bytes_min(spec, self);
        let max = self.disk_bytes_max.unwrap_or(least);
        let why = format_args!(
            "it must hold the transitions before the first batch twice, and some segments; use at least {least}"
        );
        check(max >= least, "replay.disk_bytes_max", max, why)
    }

    /// Checks that the snapshot of each shard fits the codec's limit, for a replay that is kept on disk.
    pub(crate) fn check_on_disk(&self) -> Result<(), ConfigError> {
        let (key, capacity) = ("replay.capacity_transitions", self.capacity_transitions);
        let is_prioritised = self.sampling.is_prioritised();
        let fits = !is_prioritised || capacity / u64::from(self.shards) <= PRIORITIES_MAX;
        let why = format_args!(
            "each shard of a prioritised replay on disk holds at most {PRIORITIES_MAX}: hold fewer, use more shards, or keep it in memory"
        );
        check(fits, key, capacity, why)
    }

    /// Checks every value, alone and against `batch_size`, the rows of the learner's batches.
    ///
    /// The run cannot stall if slack_transitions * replay_ratio >= batch_size: inserts then wait only while a whole batch
    /// may be sampled.
    pub fn validate(&self, spec: &RunSpec, batch_size: u32) -> Result<(), ConfigError> {
        spec.validate()?;
        let (ratio, capacity) = (self.replay_ratio, self.capacity_transitions);
        let (warmup, slack) = (self.warmup_transitions, self.slack_transitions);
        let is_ratio = ratio.is_finite() && ratio > 0.0;
        let why = "rows per transition must be a number above 0";
        check(is_ratio, "replay.replay_ratio", ratio, why)?;
        self.sampling.validate()?;
        let rows_max = rows_max(spec, &self.sampling);
        let why = format_args!("a batch of this run has 1 to {rows_max} rows");
        check_range("learner.batch_size", batch_size, 1..=rows_max, why)?;
        let why = format_args!("a replay has 1 to {SHARDS_MAX} shards");
        check_range("replay.shards", self.shards, 1..=SHARDS_MAX, why)?;
        let window = u64::from(lookahead_steps(spec)) + u64::from(spec.frame_stack);
        let fits = capacity / u64::from(self.shards) >= window;
        let why = format_args!(
            "one sample spans {window} transitions (the longer of n_step and k_max, and the frame stack); hold at least that many in each shard for each environment"
        );
        check(fits, "replay.capacity_transitions", capacity, why)?;
        let bytes = capacity.checked_mul(spec.frame_bytes() as u64);
        let fits = bytes.is_some_and(|bytes| bytes <= isize::MAX as u64);
        let why = "this many frames exceed any machine's address space; hold fewer";
        check(fits, "replay.capacity_transitions", capacity, why)?;
        if let Some(max) = self.compressed_bytes_max {
            let key = "replay.compressed_bytes_max";
            let fits = self.compression != Compression::None;
            let why = "nothing is compressed; use compression = \"lz4\", or capacity_transitions";
            check(fits, key, max, why)?;
            let least = window * spec.frame_bytes() as u64 * u64::from(self.shards);
            let why = format_args!(
                "one sample spans {window} transitions, which may not compress; use at least {least}"
            );
            check(max >= least, key, max, why)?;
        }
        let fits = warmup <= capacity;
        let why = format_args!(
            "the first of them would be overwritten before any is sampled; use at most capacity_transitions = {capacity}"
        );
        check(fits, "replay.warmup_transitions", warmup, why)?;
        let batch = (f64::from(batch_size) / ratio).ceil();
        let fits = slack as f64 * ratio >= f64::from(batch_size);
        let why = format_args!(
            "actors and learner would wait for each other; use at least learner.batch_size / replay_ratio = {batch_size} / {ratio} = {batch}"
        );
        check(fits, "replay.slack_transitions", slack, why)?;
        if let (Some(max), None) = (self.transitions_max, self.since) {
            let least = warmup as f64 + batch;
            let why = format_args!(
                "the run would end before its first batch; use at least warmup_transitions + learner.batch_size / replay_ratio = {least}"
            );
            check(max as f64 >= least, "replay.transitions_max", max, why)?;
        }
        Ok(())
    }
}

/// Returns the minimum disk budget: twice the transitions before the first batch, and four segments of minimum size per shard.
fn disk_bytes_min(spec: &RunSpec, config: &Config) -> u64 {
    // A segment is at least four times as long as its snapshot, which has 8 bytes for each row with a priority.
    let priority_bytes = 4 * 8 * u64::from(config.sampling.is_prioritised());
    let transition_bytes = (spec.frame_bytes() + TRANSITION_BYTES) as u64 + priority_bytes;
    let warmup = config.warmup_transitions.saturating_mul(transition_bytes);
    let segments = u64::from(config.shards) * 4 * SEGMENT_BYTES_MIN;
    warmup.saturating_mul(2).saturating_add(segments)
}

/// Returns the maximum rows of a batch of this run, which keeps it below the codec's limit. Larger requests are rejected.
pub(crate) fn rows_max(spec: &RunSpec, sampling: &Sampling) -> u32 {
    // Counts each state with its full frame stack, as a receiver may expand the states to that.
    let header = BatchHeader {
        stacked: None,
        ..BatchHeader::largest(spec, 1)
    };
    let row_bytes = header.with_sampling(sampling).payload_bytes();
    u32::try_from(PAYLOAD_BYTES_MAX / row_bytes).unwrap_or(u32::MAX)
}
