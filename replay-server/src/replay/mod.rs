//! The replay server's core: chunks in, batches out, and its account of itself.
//! It does no I/O, keeps no time and starts no thread: the service around it does.

pub(crate) mod events;
mod ingest;
mod priorities;
mod sample;
pub(crate) mod snapshot;
mod status;

use driml_protocol::{BatchReply, Origin, RunSpec, Sampling, Tally, Waiting};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    config::{Config, ConfigError, SHARDS_MAX, reach},
    ledger::{actors::Actors, requests::Requests, statistics::Statistics},
    rate_limiter::RateLimiter,
    sampling::{
        anchors::Anchors,
        assemble::Assembler,
        episodes::{Episodes, Window},
        horizon::Affinity,
        prioritised::Priorities,
    },
    storage::{frame_store::Frames, ring::Ring},
};

/// The replay server's own stream of the run's seed, so that no other part draws the same numbers.
const RNG_STREAM: u64 = u64::from_be_bytes(*b"replay-1");

/// Why there is no batch.
#[derive(Clone, Debug, PartialEq)]
pub enum Unready {
    /// Not yet: who waits for what.
    Wait(Waiting),
    /// Never again: all transitions are in and sampled.
    Finished,
    /// Never: the reason, for a person.
    Refused {
        /// Why, and what to do about it.
        why: String,
    },
}

impl From<Unready> for BatchReply {
    fn from(unready: Unready) -> Self {
        match unready {
            Unready::Wait(waiting) => Self::Wait(waiting),
            Unready::Finished => Self::Finished,
            Unready::Refused { why } => Self::Refused { why },
        }
    }
}

/// Everything the replay server knows.
pub struct Replay {
    spec: RunSpec,
    config: Config,
    batch_size: u32,
    ring: Ring,
    actors: Actors,
    requests: Requests,
    /// What was counted before the run was resumed.
    resume_point: Tally,
    limiter: RateLimiter,
    episodes: Episodes,
    anchors: Anchors,
    /// Where rows are drawn by priority.
    priorities: Option<Priorities>,
    /// Who draws, as batches say it that are drawn by priority.
    origin: Origin,
    window: Window,
    assembler: Assembler,
    affinity: Affinity,
    rng: ChaCha8Rng,
    statistics: Statistics,
    /// The learner found no anchor: one chunk may pass the limiter, or both sides would wait for each other.
    starving: bool,
    /// What happens has happened before, and was said then.
    quiet: bool,
}

impl Replay {
    /// An empty replay for batches of `batch_size` rows; its draws follow from `spec.seed` and the order of calls. Of several
    /// shards it is the first: [`Replay::shard`].
    ///
    /// # Errors
    /// Settings that cannot work, or more memory than the system grants.
    pub fn new(spec: &RunSpec, config: &Config, batch_size: u32) -> Result<Self, ConfigError> {
        Self::shard(spec, config, batch_size, 0)
    }

    /// Shard `shard` of `config.shards`, which holds its share of the capacity and draws its own numbers.
    ///
    /// # Errors
    /// As [`Replay::new`], and a shard that does not exist.
    pub fn shard(
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
        shard: u32,
    ) -> Result<Self, ConfigError> {
        config.validate(spec, batch_size)?;
        if shard >= config.shards {
            return Err(ConfigError::Key {
                key: "replay.shards",
                value: config.shards.to_string(),
                why: format!("there is no shard {shard}; the first is shard 0"),
            });
        }
        let shards = u64::from(config.shards);
        let capacity = config.capacity_transitions / shards;
        let frame_bytes = spec.frame_bytes();
        let bytes_max = config.compressed_bytes_max.map(|bytes| bytes / shards);
        let frames = Frames::new(config.compression, capacity, frame_bytes, bytes_max);
        let ring = frames.and_then(|frames| Ring::new(capacity, frames));
        let refused = |bytes| {
            let why =
                format!("the system does not grant the {bytes} bytes that this takes; hold fewer");
            ConfigError::Key {
                key: "replay.capacity_transitions",
                value: config.capacity_transitions.to_string(),
                why,
            }
        };
        let ring = ring.map_err(refused)?;
        let priorities = match config.sampling {
            Sampling::Uniform => None,
            Sampling::Prioritised { alpha, .. } => {
                let made = Priorities::new(alpha, capacity, reach(spec));
                Some(made.map_err(refused)?)
            }
        };
        let mut rng = ChaCha8Rng::seed_from_u64(spec.seed);
        rng.set_stream(RNG_STREAM + u64::from(shard));
        Ok(Self {
            spec: spec.clone(),
            config: config.clone(),
            batch_size,
            ring,
            actors: Actors::default(),
            requests: Requests::default(),
            resume_point: Tally::default(),
            limiter: RateLimiter::new(
                config.replay_ratio,
                config.warmup_transitions,
                config.slack_transitions,
                config.transitions_max,
            ),
            episodes: Episodes::new(spec),
            anchors: Anchors::default(),
            priorities,
            origin: Origin {
                shard,
                incarnation: 0,
            },
            window: Window::default(),
            assembler: Assembler::new(spec, config.reproduced_bug),
            affinity: Affinity::uniform(spec.num_actions),
            rng,
            statistics: Statistics::new(spec.horizon.k_max(), spec.num_actions),
            starving: false,
            quiet: false,
        })
    }

    /// The same replay in a run that is resumed after `updates` of the learner, with nothing held any more.
    ///
    /// It counts on from the transitions that these updates used up. Then warmup_transitions of new ones come in before the
    /// next row is sampled, as at the start of the run; so the run steps its worlds that many times more than it counts.
    #[must_use]
    pub fn resumed_at(mut self, updates: u64, shard: u32) -> Self {
        let rows = updates.saturating_mul(u64::from(self.batch_size));
        let inserted = (rows as f64 / self.config.replay_ratio) as u64;
        let (shards, shard) = (u64::from(self.config.shards), u64::from(shard));
        let share = |total: u64| total / shards + u64::from(shard < total % shards);
        self.resume_point = Tally {
            inserted: share(inserted),
            rows_sampled: share(rows),
        };
        let other_shards = Tally {
            inserted: inserted - self.resume_point.inserted,
            rows_sampled: rows - self.resume_point.rows_sampled,
        };
        self.limiter = self.limiter.resumed_at(self.resume_point, other_shards);
        // Not the numbers of the run's start again.
        self.rng.set_stream(
            (RNG_STREAM + shard).wrapping_add(updates.wrapping_mul(u64::from(SHARDS_MAX))),
        );
        self
    }
}
