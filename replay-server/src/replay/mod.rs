//! The replay server's core: it stores chunks, serves batches, admits actors and a learner, and reports its status.
//! It has no clock and no threads: `service` has them. `persist` writes to disk, `sampling` draws rows, `ledger` and `rate_limiter` count.

mod actors;
mod learner;

use driml_protocol::{
    EpisodesReply, EpisodesRequest, Origin, ReplayStatus, RunSpec, ShardCounts, Waiting,
    config::{ConfigError, check},
};

use crate::{
    config::Config,
    ledger::requests::LastRequests,
    persist::{journal::Journal, snapshot::ReplayState},
    rate_limiter::RateLimiter,
    sampling::batch::BatchSampler,
    storage::{frame_store::FrameStore, ring::Ring},
};

/// Maximum lead of a version: of an affinity matrix over the rows served, and of the weights that acted over the newest weights. Not 0, as
/// a restarted replay may not know all rows and weights.
pub(crate) const VERSION_AHEAD_MAX: u64 = 1 << 32;

/// The state of the replay server. It is in memory, and with a log also on disk: see [`ReplayFolder`](crate::ReplayFolder).
pub struct Replay {
    pub(crate) spec: RunSpec,
    pub(crate) config: Config,
    batch_size: u32,
    pub(crate) ring: Ring,
    pub(crate) limiter: RateLimiter,
    pub(crate) sampler: BatchSampler,
    pub(crate) state: ReplayState,
    requests: LastRequests,
    /// The identity of this sampler, which prioritised batches carry. Priorities of rows from another origin are ignored: a restarted
    /// replay server numbers its transitions anew, or has lost some, and so has another incarnation.
    pub(crate) origin: Origin,
    /// Set while the log is read back: differences counted then were logged when they happened.
    pub(crate) is_recovering: bool,
    /// Set after the log was read back: the learner's next request replaces the count of rows, and later ones may raise it.
    pub(crate) awaits_row_count: bool,
    pub(crate) journal: Option<Journal>,
}

impl Replay {
    /// Creates an empty replay in memory for batches of `batch_size` rows. `spec.seed` and the order of calls determine its draws. With
    /// several shards this is shard 0; [`Replay::shard`] creates any shard.
    ///
    /// # Errors
    /// Settings that cannot work, or more memory than the system grants.
    pub fn new(spec: &RunSpec, config: &Config, batch_size: u32) -> Result<Self, ConfigError> {
        Self::shard(spec, config, batch_size, 0)
    }

    /// Creates shard `shard` of `config.shards`, with its share of the capacity and a separate random stream.
    pub fn shard(
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
        shard: u32,
    ) -> Result<Self, ConfigError> {
        config.validate(spec, batch_size)?;
        let shards = config.shards;
        let why = format_args!("shard {shard} does not exist; the first is shard 0");
        check(shard < shards, "replay.shards", shards, why)?;
        let shards = u64::from(config.shards);
        let capacity = config.capacity_transitions / shards;
        let bytes_max = config.compressed_bytes_max.map(|bytes| bytes / shards);
        let not_granted = |bytes: u64| {
            let why = format_args!(
                "the system does not grant the {bytes} bytes that this takes; hold fewer"
            );
            let key = "replay.capacity_transitions";
            ConfigError::new(key, config.capacity_transitions, why)
        };
        let frames = FrameStore::new(config.compression, capacity, spec.frame_bytes(), bytes_max)
            .map_err(not_granted)?;
        Ok(Self {
            spec: spec.clone(),
            config: config.clone(),
            batch_size,
            ring: Ring::new(capacity, frames).map_err(not_granted)?,
            limiter: RateLimiter::new(config),
            sampler: BatchSampler::new(spec, &config.sampling, capacity).map_err(not_granted)?,
            state: ReplayState::new(spec, shard),
            requests: LastRequests::default(),
            origin: Origin {
                shard,
                incarnation: 0,
            },
            is_recovering: false,
            awaits_row_count: false,
            journal: None,
        })
    }
}

/// Status, and the counters that the service updates.
impl Replay {
    /// Returns the counters of messages, waits and connections.
    pub(crate) const fn counters_mut(&mut self) -> &mut ReplayStatus {
        &mut self.state.statistics.counted
    }

    /// Returns the transitions that all shards have stored; those of the other shards are from their last reports.
    pub fn inserted_total(&self) -> u64 {
        self.limiter.inserted_total()
    }

    /// Returns this shard's counts since the start of the run.
    pub const fn counts(&self) -> ShardCounts {
        self.limiter.counts()
    }

    /// Sets the counts of the other shards. Impossible counts are an error: the reason, for a person.
    pub fn set_other_shards(&mut self, other_shards: ShardCounts) -> Result<(), String> {
        self.limiter.set_other_shards(other_shards)
    }

    /// Returns which side waits now, for batches of the `batch_size` that the replay was created for.
    pub fn waiting(&self) -> Waiting {
        match self.limiter.waiting(self.batch_size) {
            Waiting::ActorsWaitForLearner | Waiting::Neither if self.is_starving() => {
                Waiting::LearnerWaitsForActors
            }
            waiting => waiting,
        }
    }

    /// Whether the last draw found no anchor. Then the next chunk is stored without credit.
    pub(crate) const fn is_starving(&self) -> bool {
        self.state.starving
    }

    /// Returns the status. Fields that only the service knows keep their defaults.
    pub fn status(&self) -> ReplayStatus {
        let counts = self.limiter.counts;
        ReplayStatus {
            transitions_inserted: counts.this_shard.inserted,
            transitions_refilled: counts.refilled,
            transitions_held: match (counts.refill_left, self.is_starving()) {
                (0, false) => self.ring.inserted() - self.ring.oldest(),
                _ => 0,
            },
            frame_bytes_held: self.ring.frames().bytes_held(),
            rows_sampled: counts.this_shard.rows_sampled,
            updates: self.state.learned.updates,
            warmup_transitions: self.config.warmup_transitions,
            waiting: self.waiting(),
            affinity_version: self.state.affinity.version(),
            finished: self.limiter.all_stored(),
            ..self.state.statistics.counted.clone()
        }
    }

    /// Notes that the client has the first `request.since` ended episodes, and returns the next ones.
    pub(crate) fn answer_episodes(&mut self, request: EpisodesRequest) -> EpisodesReply {
        let EpisodesRequest { since, is_launcher } = request;
        self.state.statistics.set_recorded(since, is_launcher);
        self.episodes_since(since)
    }

    /// Returns the ended episodes after the first `since`, at most as many as one reply holds.
    pub fn episodes_since(&self, since: u64) -> EpisodesReply {
        self.state.statistics.episodes_since(since)
    }

    /// Notes that the launcher has the first `episodes` ended episodes.
    pub fn set_recorded_episodes(&mut self, episodes: u64) {
        self.state.statistics.set_recorded(episodes, true);
    }

    /// Checks the ring and the counts; panics at the first that is wrong. Slow: for tests.
    pub fn check_valid(&self) {
        self.ring.check_valid();
        self.sampler.rows.check_valid(&self.ring);
        assert_eq!(self.snapshot().check(&self.state), Ok(()));
    }
}
