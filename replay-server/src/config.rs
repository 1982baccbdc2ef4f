//! What can be set about the replay server, and the checks that keep a run from stalling.
//! It does not hold the rules of the return or of k: those are the run spec's, shared by every process.

use driml_protocol::{
    BatchHeader, RunSpec, Sampling, TRANSITION_BYTES,
    codec::{PAYLOAD_BYTES_MAX, VALUE_BYTES_MAX},
    config::{ConfigError, check},
};
use serde::{Deserialize, Serialize};

pub(crate) const SHARDS_MAX: u32 = 256;

pub(crate) const SEGMENT_BYTES_MIN: u64 = 1 << 20;
/// Most priorities of a shard on disk, 8 bytes each: a state holds all of them, and leaves a sixteenth for the rest.
const PRIORITIES_MAX: u64 = VALUE_BYTES_MAX as u64 / 16 * 15 / 8;

/// How frames are kept in memory. Batches are the same, bit for bit, whatever it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Compression {
    /// As they came: the least work.
    #[default]
    None,
    /// Consecutive frames of one stream together, by LZ4: a fifth of the memory or less on many Procgen games, not on all, and
    /// more work a chunk and a batch.
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
    /// By which rule rows are drawn. Settings of earlier versions do not have it: uniformly.
    #[serde(default)]
    pub sampling: Sampling,
    /// How frames are kept in memory; batches do not depend on it.
    #[serde(default)]
    pub compression: Compression,
    /// Bytes that compressed frames may take, beside at most 128 a transition: if they compress badly, the oldest are overwritten
    /// before `capacity_transitions` are held. Without it they may take as much as uncompressed ones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compressed_bytes_max: Option<u64>,
    /// Rows sampled per transition inserted after the warm-up. More trains longer on each transition.
    pub replay_ratio: f64,
    /// Transitions stored before the replay ratio starts to count and the first row is sampled.
    pub warmup_transitions: u64,
    /// New transitions stored before the first row is sampled when a run is resumed without its replay: no more than it had stored and
    /// than `capacity_transitions`, no fewer than the warm-up. Settings of earlier versions do not have it: as many as the warm-up.
    #[serde(default)]
    pub refill_transitions: u64,
    /// Transitions that inserts may run ahead of sampling, after the warm-up, before they have to wait.
    pub slack_transitions: u64,
    /// Transitions of the whole run, warm-up included: once that many are stored, no more are taken. None runs on.
    pub transitions_max: Option<u64>,
    /// Where the replay is kept on disk (`--replay-dir`, `--durable`): most bytes that all shards may take there. Beyond it the oldest
    /// transitions go, from memory too, before `capacity_transitions` are held. Without it they take as much as uncompressed ones
    /// in memory, and up to a segment more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub disk_bytes_max: Option<u64>,
    /// Where the replay is kept on disk: milliseconds after which what was written is flushed, so that it survives a power cut too;
    /// the death of the process it always survives. 0 flushes before each answer. Without it 1,000.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fsync_ms: Option<u64>,
    /// The point from which `replay_ratio` holds, if it, the batch size or the warm-up was changed when the run was resumed and the
    /// warm-up is over by then; without it the end of the warm-up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub since: Option<Since>,
}

/// A point in a run: what was counted when it was resumed with other settings. `driml train --resume` writes it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Since {
    /// Transitions stored.
    pub transitions: u64,
    /// Rows learned.
    pub rows: u64,
    /// Updates done.
    pub updates: u64,
}

/// Environment steps that must follow an anchor in its stream, unless its episode ends before: max(n_step, k_max).
pub(crate) fn reach(spec: &RunSpec) -> u32 {
    spec.n_step.max(spec.horizon.k_max())
}

impl Config {
    /// The point from which `replay_ratio` holds.
    pub fn ratio_start(&self) -> Since {
        let since = self.since.unwrap_or_default();
        let transitions = since.transitions.max(self.warmup_transitions);
        Since {
            transitions,
            ..since
        }
    }

    /// One shard in memory, drawn from uniformly, in which neither side ever waits: for tests, benches and checks.
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

    /// Checks that nothing is set that needs a replay on disk, for one that is in memory alone; `to_keep_it` are the flags that would
    /// change that.
    pub fn check_in_memory(&self, to_keep_it: &str) -> Result<(), ConfigError> {
        for (key, set) in [
            ("replay.disk_bytes_max", self.disk_bytes_max),
            ("replay.fsync_ms", self.fsync_ms),
        ] {
            check(set.is_none(), key, set.unwrap_or(0), || {
                format!(
                    "this replay is in memory alone; add {to_keep_it} to keep it on disk, or leave the setting out"
                )
            })?;
        }
        Ok(())
    }

    /// Checks that the state of a shard can be written, for a replay that is kept on disk.
    pub(crate) fn check_on_disk(&self) -> Result<(), ConfigError> {
        let (key, capacity) = ("replay.capacity_transitions", self.capacity_transitions);
        let is_prioritised = self.sampling.is_prioritised();
        let fits = !is_prioritised || capacity / u64::from(self.shards) <= PRIORITIES_MAX;
        check(fits, key, capacity, || {
            format!(
                "each shard of a prioritised replay on disk holds at most {PRIORITIES_MAX}: hold fewer, use more shards, or keep it in memory"
            )
        })
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
        check(is_ratio, "replay.replay_ratio", ratio, || why)?;
        self.sampling.validate()?;
        let rows_max = rows_max(spec, &self.sampling);
        let fits = (1..=rows_max).contains(&batch_size);
        check(fits, "learner.batch_size", batch_size, || {
            format!("a batch of this run has 1 to {rows_max} rows")
        })?;
        let fits = (1..=SHARDS_MAX).contains(&self.shards);
        check(fits, "replay.shards", self.shards, || {
            format!("a replay has 1 to {SHARDS_MAX} shards")
        })?;
        let window = u64::from(reach(spec)) + u64::from(spec.frame_stack);
        let fits = capacity / u64::from(self.shards) >= window;
        check(fits, "replay.capacity_transitions", capacity, || {
            format!(
                "one sample spans {window} transitions (the longer of n_step and k_max, and the frame stack); hold at least that many in each shard for each environment"
            )
        })?;
        let bytes = capacity.checked_mul(spec.frame_bytes() as u64);
        let fits = bytes.is_some_and(|bytes| bytes <= isize::MAX as u64);
        let why = "this many frames exceed any machine's address space; hold fewer";
        check(fits, "replay.capacity_transitions", capacity, || why)?;
        if let Some(max) = self.compressed_bytes_max {
            let key = "replay.compressed_bytes_max";
            let fits = self.compression != Compression::None;
            let why = "nothing is compressed; use compression = \"lz4\", or capacity_transitions";
            check(fits, key, max, || why)?;
            let least = window * spec.frame_bytes() as u64 * u64::from(self.shards);
            check(max >= least, key, max, || {
                format!(
                    "one sample spans {window} transitions, which may not compress; use at least {least}"
                )
            })?;
        }
        if let Some(max) = self.disk_bytes_max {
            let least = disk_bytes_least(spec, self);
            check(max >= least, "replay.disk_bytes_max", max, || {
                format!(
                    "it must hold the transitions before the first batch twice, and some segments; use at least {least}"
                )
            })?;
        }
        let fits = warmup <= capacity;
        check(fits, "replay.warmup_transitions", warmup, || {
            format!(
                "the first of them would be overwritten before any is sampled; use at most capacity_transitions = {capacity}"
            )
        })?;
        let batch = (f64::from(batch_size) / ratio).ceil();
        let fits = slack as f64 * ratio >= f64::from(batch_size);
        check(fits, "replay.slack_transitions", slack, || {
            format!(
                "actors and learner would wait for each other; use at least learner.batch_size / replay_ratio = {batch_size} / {ratio} = {batch}"
            )
        })?;
        if let (Some(max), None) = (self.transitions_max, self.since) {
            let least = warmup as f64 + batch;
            check(max as f64 >= least, "replay.transitions_max", max, || {
                format!(
                    "the run would end before its first batch; use at least warmup_transitions + learner.batch_size / replay_ratio = {least}"
                )
            })?;
        }
        Ok(())
    }
}

/// Least disk budget of a replay: room for the transitions before the first batch, and for the segments that come and go.
fn disk_bytes_least(spec: &RunSpec, config: &Config) -> u64 {
    // A segment is four times as long as the state that it begins with, which has 8 bytes of each row that has a priority.
    let of_states = 4 * 8 * u64::from(config.sampling.is_prioritised());
    let row_bytes = (spec.frame_bytes() + TRANSITION_BYTES) as u64 + of_states;
    let warmup = config.warmup_transitions.saturating_mul(row_bytes);
    let segments = u64::from(config.shards) * 4 * SEGMENT_BYTES_MIN;
    warmup.saturating_mul(2).saturating_add(segments)
}

/// Most rows of one batch of this run, so that it stays below the codec's limit; larger requests are refused.
pub(crate) fn rows_max(spec: &RunSpec, sampling: &Sampling) -> u32 {
    // With each state whole: a receiver may make them so.
    let header = BatchHeader {
        stacked: None,
        ..BatchHeader::of(spec, 1)
    };
    let row_bytes = header.sampled_by(sampling).payload_bytes();
    u32::try_from(PAYLOAD_BYTES_MAX / row_bytes).unwrap_or(u32::MAX)
}
