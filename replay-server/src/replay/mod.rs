//! The replay server's core: chunks in, batches out, who takes part, and its account of itself.
//! It keeps no time and starts no thread: the service around it does. What it writes to disk is in `persist`, how rows are drawn in
//! `sampling`, what is counted in `ledger` and `rate_limiter`.

mod actors;
mod learner;

use driml_protocol::{
    EpisodesReply, EpisodesRequest, Origin, ReplayStatus, RunSpec, ShardCounts, Waiting,
    config::{ConfigError, check},
};

use crate::{
    config::Config,
    ledger::requests::Requests,
    persist::{journal::Journal, snapshot::ReplayState},
    rate_limiter::RateLimiter,
    sampling::batch::BatchSampler,
    storage::{frame_store::Frames, ring::Ring},
};

/// How far the version of an affinity matrix may be ahead of the rows served, and that of weights that acted ahead of the newest: a
/// replay that was started anew may not know all.
pub(crate) const VERSION_AHEAD_MAX: u64 = 1 << 32;

/// Everything the replay server knows. Kept in memory alone, or, with a log, on disk too: [`KeptReplay`](crate::KeptReplay).
pub struct Replay {
    pub(crate) spec: RunSpec,
    pub(crate) config: Config,
    batch_size: u32,
    pub(crate) ring: Ring,
    pub(crate) limiter: RateLimiter,
    pub(crate) sampler: BatchSampler,
    pub(crate) state: ReplayState,
    requests: Requests,
    /// Who draws, as batches say it that are drawn by priority: priorities of rows that another one drew change nothing. A replay server
    /// that is started again numbers its transitions anew, or has lost some, and so draws another incarnation.
    pub(crate) origin: Origin,
    /// It is being read back: what is counted was logged when it happened.
    pub(crate) quiet: bool,
    /// It was read back: how many rows the learner has, it says with its next request.
    pub(crate) awaits_learner: bool,
    pub(crate) log: Option<Journal>,
}

/// An empty replay, and who draws from it.
impl Replay {
    /// An empty replay in memory for batches of `batch_size` rows; its draws follow from `spec.seed` and the order of calls. Of several
    /// shards it is the first: [`Replay::shard`].
    ///
    /// # Errors
    /// Settings that cannot work, or more memory than the system grants.
    pub fn new(spec: &RunSpec, config: &Config, batch_size: u32) -> Result<Self, ConfigError> {
        Self::shard(spec, config, batch_size, 0)
    }

    /// Shard `shard` of `config.shards`, which holds its share of the capacity and draws its own numbers.
    pub fn shard(
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
        shard: u32,
    ) -> Result<Self, ConfigError> {
        config.validate(spec, batch_size)?;
        let shards = config.shards;
        check(shard < shards, "replay.shards", shards, || {
            format!("there is no shard {shard}; the first is shard 0")
        })?;
        let shards = u64::from(config.shards);
        let capacity = config.capacity_transitions / shards;
        let bytes_max = config.compressed_bytes_max.map(|bytes| bytes / shards);
        let not_granted = |bytes: u64| {
            let why = format_args!(
                "the system does not grant the {bytes} bytes that this takes; hold fewer"
            );
            let key = "replay.capacity_transitions";
            ConfigError::of(key, config.capacity_transitions, why)
        };
        let frames = Frames::new(config.compression, capacity, spec.frame_bytes(), bytes_max)
            .map_err(not_granted)?;
        Ok(Self {
            spec: spec.clone(),
            config: config.clone(),
            batch_size,
            ring: Ring::new(capacity, frames).map_err(not_granted)?,
            limiter: RateLimiter::new(config),
            sampler: BatchSampler::new(spec, &config.sampling, capacity).map_err(not_granted)?,
            state: ReplayState::new(spec, shard),
            requests: Requests::default(),
            origin: Origin {
                shard,
                incarnation: 0,
            },
            quiet: false,
            awaits_learner: false,
            log: None,
        })
    }
}

/// What it says of itself, and what the service around it tells it to count.
impl Replay {
    /// What is counted of messages, waits and connections.
    pub(crate) const fn counted(&mut self) -> &mut ReplayStatus {
        &mut self.state.statistics.counted
    }

    /// Transitions of the run that were stored, in all shards by their last reports.
    pub fn inserted_total(&self) -> u64 {
        self.limiter.inserted_total()
    }

    /// What was counted here since the start of the run.
    pub const fn counts(&self) -> ShardCounts {
        self.limiter.counts()
    }

    /// Takes what the replay's other shards have counted.
    pub fn set_other_shards(&mut self, other_shards: ShardCounts) -> Result<(), String> {
        self.limiter.set_other_shards(other_shards)
    }

    /// Who waits for whom now, for batches of the size that the replay was made for.
    pub fn waiting(&self) -> Waiting {
        match self.limiter.waiting(self.batch_size) {
            Waiting::ActorsWaitForLearner | Waiting::Neither if self.state.starving => {
                Waiting::LearnerWaitsForActors
            }
            waiting => waiting,
        }
    }

    /// The account of itself; what the service alone knows is left at its default.
    pub fn status(&self) -> ReplayStatus {
        let counts = self.limiter.counts;
        ReplayStatus {
            transitions_inserted: counts.this_shard.inserted,
            transitions_refilled: counts.refilled,
            transitions_held: match counts.refill_left {
                0 => self.ring.inserted() - self.ring.oldest(),
                _ => 0,
            },
            frame_bytes_held: self.ring.frames().bytes_held(),
            rows_sampled: counts.this_shard.rows_sampled,
            updates: self.state.learned.updates,
            warmup_transitions: self.config.warmup_transitions,
            waiting: self.waiting(),
            affinity_version: self.state.affinity.version(),
            finished: self.limiter.all_in(),
            ..self.state.statistics.counted.clone()
        }
    }

    /// The episodes that are asked for, by one that has those before.
    pub(crate) fn episodes(&mut self, request: EpisodesRequest) -> EpisodesReply {
        let EpisodesRequest { since, is_launcher } = request;
        self.state.statistics.note_recorded(since, is_launcher);
        self.episodes_since(since)
    }

    /// Episodes that ended after the first `since`, at most as many as one answer holds.
    pub fn episodes_since(&self, since: u64) -> EpisodesReply {
        self.state.statistics.episodes_since(since)
    }

    /// The launcher has the first so many episodes that ended.
    pub fn note_recorded(&mut self, episodes: u64) {
        self.state.statistics.note_recorded(episodes, true);
    }

    /// Checks the ring and the counts; panics at the first that is wrong. Slow: for tests.
    pub fn check_valid(&self) {
        self.ring.check_valid();
        self.sampler.rows.check_valid(&self.ring);
        assert_eq!(self.snapshot().check(&self.state), Ok(()));
    }
}
