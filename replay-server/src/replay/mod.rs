//! The replay server's core: chunks in, batches out, and its account of itself.
//! It does no I/O, keeps no time and starts no thread: the service around it does.

use std::borrow::Cow;

use driml_protocol::{
    ActorJoin, AffinityUpdate, Batch, BatchHeader, BatchReply, Chunk, Claim, CodecError, Goodbye,
    InsertReply, Planes, ReplayStatus, RequestId, RunSpec, Tally, Waiting,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    config::{self, Compression, Config, ConfigError, SHARDS_MAX},
    ledger::{
        actors::{Actors, Difference, Verdict},
        requests::{Requests, Standing},
        statistics::Statistics,
    },
    rate_limiter::RateLimiter,
    sampling::{
        anchors::Anchors,
        assemble::Assembler,
        episodes::{Episodes, Window},
        horizon::Affinity,
        packed_batch::{Draft, PackedStates},
    },
    storage::{
        frame_store::{CompressedFrames, Frames, PackedChunk, Packer, PlainFrames},
        ring::{Ring, Step},
    },
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
        /// The reason.
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
    batch_rows: u32,
    ring: Ring,
    actors: Actors,
    requests: Requests,
    /// What was counted before the run was resumed.
    before: Tally,
    limiter: RateLimiter,
    episodes: Episodes,
    anchors: Anchors,
    window: Window,
    assembler: Assembler,
    affinity: Affinity,
    rng: ChaCha8Rng,
    statistics: Statistics,
    /// The learner found no anchor: one chunk may pass the limiter, or both sides would wait for each other.
    starving: bool,
}

impl Replay {
    /// An empty replay for batches of `batch_rows` rows; its draws follow from `spec.seed` and the order of calls. Of several
    /// shards it is the first: [`Replay::shard`].
    ///
    /// # Errors
    /// Settings that cannot work, or more memory than the system grants.
    pub fn new(spec: &RunSpec, config: &Config, batch_rows: u32) -> Result<Self, ConfigError> {
        Self::shard(spec, config, batch_rows, 0)
    }

    /// Shard `shard` of `config.shards`, which holds its share of the capacity and draws its own numbers.
    ///
    /// # Errors
    /// As [`Replay::new`], and a shard that does not exist.
    pub fn shard(
        spec: &RunSpec,
        config: &Config,
        batch_rows: u32,
        shard: u32,
    ) -> Result<Self, ConfigError> {
        config.validate(spec, batch_rows)?;
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
        let frames = match config.compression {
            Compression::None => PlainFrames::new(capacity, frame_bytes).map(Frames::Plain),
            Compression::Lz4 => {
                let bytes_max = config.compressed_bytes_max.map(|bytes| bytes / shards);
                Ok(Frames::Compressed(CompressedFrames::new(
                    frame_bytes,
                    bytes_max,
                )))
            }
        };
        let ring = frames.and_then(|frames| Ring::new(capacity, frames));
        let ring = ring.map_err(|bytes| {
            let why =
                format!("the system does not grant the {bytes} bytes that this takes; hold fewer");
            ConfigError::Key {
                key: "replay.capacity_transitions",
                value: config.capacity_transitions.to_string(),
                why,
            }
        })?;
        let mut rng = ChaCha8Rng::seed_from_u64(spec.seed);
        rng.set_stream(RNG_STREAM + u64::from(shard));
        Ok(Self {
            spec: spec.clone(),
            config: config.clone(),
            batch_rows,
            ring,
            actors: Actors::default(),
            requests: Requests::default(),
            before: Tally::default(),
            limiter: RateLimiter::new(
                config.replay_ratio,
                config.warmup_transitions,
                config.slack_transitions,
                config.transitions_max,
            ),
            episodes: Episodes::new(spec),
            anchors: Anchors::default(),
            window: Window::default(),
            assembler: Assembler::new(spec, config.study),
            affinity: Affinity::uniform(spec.num_actions),
            rng,
            statistics: Statistics::new(spec.horizon.k_max(), spec.num_actions),
            starving: false,
        })
    }

    /// The same replay in a run that is resumed after `updates` of the learner, with nothing held any more.
    ///
    /// It counts on from the transitions that these updates used up. Then warmup_transitions of new ones come in before the
    /// next row is sampled, as at the start of the run; so the run steps its worlds that many times more than it counts.
    #[must_use]
    pub fn going_on_after(mut self, updates: u64, shard: u32) -> Self {
        let rows = updates.saturating_mul(u64::from(self.batch_rows));
        let inserted = (rows as f64 / self.config.replay_ratio) as u64;
        let (shards, shard) = (u64::from(self.config.shards), u64::from(shard));
        let share = |total: u64| total / shards + u64::from(shard < total % shards);
        self.before = Tally {
            inserted: share(inserted),
            rows_sampled: share(rows),
        };
        let elsewhere = Tally {
            inserted: inserted - self.before.inserted,
            rows_sampled: rows - self.before.rows_sampled,
        };
        self.limiter = self.limiter.going_on_after(self.before, elsewhere);
        // Not the numbers of the run's start again.
        self.rng.set_stream(
            (RNG_STREAM + shard).wrapping_add(updates.wrapping_mul(u64::from(SHARDS_MAX))),
        );
        self
    }

    /// Compresses chunks for this replay; it can do so while the replay is in use elsewhere.
    pub fn packer(&self) -> Packer {
        Packer {
            compression: self.config.compression,
        }
    }

    /// Takes part from now on: chunks of this life of the actor are stored, those of an earlier one no longer. Gives the number
    /// of earlier ones.
    ///
    /// # Errors
    /// Too many actors, or a life that another one has replaced; the reason, for a person.
    pub fn join_actor(&mut self, join: ActorJoin) -> Result<u32, String> {
        self.actors.join(join)?;
        Ok(self.actors.earlier_lives(join.actor))
    }

    /// The life of `actor` whose chunks are stored; none before it joins.
    pub fn actor_epoch(&self, actor: u32) -> Option<u64> {
        self.actors.current_epoch(actor)
    }

    /// A learner takes over that has learned from `rows_sampled` rows of this replay. What was served beyond them, to one that
    /// died before it saved what it learned, does not count as sampled any more; nor do versions of that one's affinity.
    ///
    /// # Errors
    /// It has learned from more rows than were ever served here; what to do, for a person.
    pub fn learner_starts(&mut self, rows_sampled: u64) -> Result<(), String> {
        let served = self.limiter.tally().rows_sampled;
        let Some(unlearned) = served.checked_sub(rows_sampled) else {
            return Err(format!(
                "the learner has learned from {rows_sampled} rows of a replay that has served {served}: start the replay server with \
                 --after-updates, as the run goes on"
            ));
        };
        self.limiter.taken_back(unlearned);
        self.statistics.rows_unlearned += unlearned;
        self.requests = Requests::default();
        self.affinity.expect_another_source();
        Ok(())
    }

    /// Stores a chunk: [`Replay::packer`] and [`Replay::insert_packed`] in one.
    pub fn insert(&mut self, chunk: &Chunk) -> InsertReply {
        self.insert_packed(&self.packer().pack(Cow::Borrowed(chunk)))
    }

    /// Stores a chunk that this replay's packer packed, whole, or says why not: [`Replay::settle`] and [`Replay::admit`] in one.
    pub fn insert_packed(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        self.settle(packed).unwrap_or_else(|| self.admit(packed))
    }

    /// The answer to a chunk that is not to be stored, now or ever: it is stored already, is not the next of its actor, makes no
    /// sense, or comes after the end of the run. `None`: it is for [`Replay::admit`].
    ///
    /// A retry is answered `Stored`, whatever the limiter says; a chunk that is not next is never stored.
    pub fn settle(&mut self, packed: &PackedChunk<'_>) -> Option<InsertReply> {
        let chunk = &*packed.chunk;
        let verdict = match self.unfit(chunk) {
            Some(why) => Verdict::Refused(why),
            None => self.actors.judge(&chunk.header),
        };
        match verdict {
            Verdict::Refused(why) => {
                tracing::warn!("refused a chunk of actor {}: {why}", chunk.header.actor);
                self.statistics.messages_refused += 1;
                Some(InsertReply::Refused { why })
            }
            Verdict::Retried => {
                self.statistics.chunks_retried += 1;
                Some(self.stored())
            }
            _ if self.limiter.all_in() => Some(InsertReply::Finished {
                inserted_total: self.inserted_total(),
            }),
            Verdict::OutOfOrder { expected } => Some(InsertReply::OutOfOrder { expected }),
            Verdict::Next => None,
        }
    }

    /// Stores a chunk that [`Replay::settle`] has nothing to say of, if the limiter lets it pass or its actor leaves; else the
    /// answer is to wait.
    pub fn admit(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        let leaving = packed.chunk.header.leaving;
        if self.limiter.may_insert() || self.starving || leaving {
            self.store(packed);
            self.stored()
        } else {
            InsertReply::Wait {
                inserted_total: self.inserted_total(),
                kept: false,
            }
        }
    }

    fn stored(&self) -> InsertReply {
        InsertReply::Stored {
            inserted_total: self.inserted_total(),
            actors: self.statistics.actors.saturating_mul(self.config.shards),
            waited: false,
        }
    }

    /// What became of a chunk: stored, not wanted any more, or never to be stored; none where it is still to come.
    pub fn claim(&mut self, claim: &Claim) -> Option<InsertReply> {
        match self.actors.is_stored(claim) {
            Ok(true) => Some(self.stored()),
            Ok(false) if self.limiter.all_in() => Some(InsertReply::Finished {
                inserted_total: self.inserted_total(),
            }),
            Ok(false) => None,
            Err(why) => {
                self.statistics.messages_refused += 1;
                Some(InsertReply::Refused { why })
            }
        }
    }

    fn unfit(&self, chunk: &Chunk) -> Option<String> {
        let header = &chunk.header;
        let frame_bytes = self.spec.frame_bytes();
        if header.frame_bytes as usize != frame_bytes {
            return Some(format!(
                "frames of {} bytes; this run has {frame_bytes}",
                header.frame_bytes
            ));
        }
        let transitions = header.transitions() as u64;
        if transitions == 0 || transitions > self.ring.capacity() {
            let capacity = self.ring.capacity();
            return Some(format!(
                "{transitions} transitions in one chunk; the replay holds {capacity}: use 1 to that many"
            ));
        }
        let bytes = config::compressed_bytes_least(transitions, frame_bytes);
        if let Some(max) = self.config.compressed_bytes_max.filter(|&max| max < bytes) {
            return Some(format!(
                "a chunk that may take {bytes} bytes; compressed_bytes_max is {max}"
            ));
        }
        if header.sequence == u64::MAX || header.first_transition.checked_add(transitions).is_none()
        {
            return Some(format!(
                "counts that no run reaches: chunk {}, transition {}",
                header.sequence, header.first_transition
            ));
        }
        let reward_max = f32::MAX / self.spec.n_step as f32;
        if let Some(row) =
            (0..chunk.header.transitions()).find(|&row| chunk.reward(row).abs() > reward_max)
        {
            return Some(format!(
                "a reward of {:e}; returns of {} steps are float32, so a reward is at most {reward_max:e}: scale the world's rewards",
                chunk.reward(row),
                self.spec.n_step
            ));
        }
        let action = chunk
            .actions()
            .iter()
            .find(|&&a| u32::from(a) >= self.spec.num_actions)?;
        Some(format!(
            "action {action}; this run has {}",
            self.spec.num_actions
        ))
    }

    fn store(&mut self, packed: &PackedChunk<'_>) {
        let chunk = &*packed.chunk;
        let header = chunk.header;
        let (streams, difference) = self.actors.accept(&header);
        let steps = header.steps as usize;
        for ((number, stream), frames) in streams.iter_mut().enumerate().zip(packed.runs()) {
            let rows = number * steps..(number + 1) * steps;
            let step = |row| {
                let (action, reward) = (chunk.actions()[row], chunk.reward(row));
                Step::new(action, reward, chunk.end(row), header.weights_version)
            };
            stream.link = self
                .ring
                .push_run(frames, rows.clone().map(step), stream.link);
            for step in rows.map(step) {
                self.statistics.action_histogram[usize::from(step.action)] += 1;
                stream.episode_return = stream
                    .episode_return
                    .map(|sum| sum + f64::from(step.reward));
                if step.end.is_episode_end() {
                    self.statistics
                        .episode_ended(stream.episode_return.replace(0.0));
                }
            }
        }
        self.limiter.inserted(header.transitions() as u64);
        self.starving = false;
        self.count(header.actor, difference);
    }

    fn count(&mut self, actor: u32, Difference { lost, duplicated }: Difference) {
        if lost > 0 || duplicated > 0 {
            tracing::warn!(
                "actor {actor}: {lost} transitions lost, {duplicated} stored twice, by its own count"
            );
        }
        let Statistics {
            transitions_lost,
            transitions_duplicated,
            ..
        } = &mut self.statistics;
        *transitions_lost = transitions_lost.saturating_add(lost);
        *transitions_duplicated = transitions_duplicated.saturating_add(duplicated);
    }

    /// Makes a batch: [`Replay::draw`] and [`Draft::unpack`] in one.
    ///
    /// # Errors
    /// As [`Replay::draw`].
    pub fn sample(&mut self, rows: u32) -> Result<Batch, Unready> {
        self.draw(rows).map(Draft::unpack)
    }

    /// [`Replay::draw_in`] for request `id`. What an earlier attempt at this request was given did not arrive: from now on it
    /// does not count as sampled.
    ///
    /// # Errors
    /// As [`Replay::draw`]; a request that nobody waits for any more is told to wait.
    pub fn draw_for(
        &mut self,
        id: RequestId,
        rows: u32,
        memory: impl FnOnce(usize) -> Planes,
    ) -> Result<Draft, Unready> {
        match self.requests.enter(id) {
            Standing::Overtaken => return Err(Unready::Wait(self.limiter.waiting(rows))),
            Standing::Open(lost) => {
                if !lost.is_empty() {
                    tracing::warn!("a batch of {} rows did not reach the learner", lost.len());
                    self.limiter.taken_back(lost.len() as u64);
                    self.statistics.taken_back(&lost);
                }
            }
        }
        let draft = self.draw_in(rows, memory)?;
        self.requests.give(id.asker, draft.ks.clone());
        Ok(draft)
    }

    /// A batch of `rows` rows, anchors uniform over the valid ones and drawn with replacement, or why there is none. With
    /// compression its frames are left to be unpacked, which needs the replay no more.
    ///
    /// # Errors
    /// The limiter or the lack of any valid anchor asks to wait; the run is over; `rows` can never be served.
    pub fn draw(&mut self, rows: u32) -> Result<Draft, Unready> {
        self.draw_in(rows, Planes::zeroed)
    }

    /// [`Replay::draw`] into memory that `memory` gives, so many bytes, all of which are written by the time it is unpacked.
    ///
    /// # Errors
    /// As [`Replay::draw`].
    pub fn draw_in(
        &mut self,
        rows: u32,
        memory: impl FnOnce(usize) -> Planes,
    ) -> Result<Draft, Unready> {
        let rows_max = config::rows_max(&self.spec).min(self.limiter.rows_max());
        if rows == 0 || rows > rows_max {
            self.statistics.messages_refused += 1;
            let why = format!(
                "a batch of {rows} rows; this run serves 1 to {rows_max}: change the batch size, or raise slack_transitions"
            );
            return Err(Unready::Refused { why });
        }
        if self.limiter.finished(rows) {
            return Err(Unready::Finished);
        }
        if !self.limiter.may_sample(rows) {
            return Err(Unready::Wait(self.limiter.waiting(rows)));
        }
        let mut header = self.batch_header(rows);
        let mut batch = Batch::in_memory(header, memory(header.planes_bytes()));
        let pixel_bytes = self.spec.frame_channels as usize;
        let mut packed = PackedStates::new(self.spec.frame_bytes(), pixel_bytes);
        let mut ks = Vec::with_capacity(rows as usize);
        let mut age_total = 0;
        let mut rows_mut = batch.rows_mut();
        for row in 0..rows as usize {
            if !self
                .anchors
                .draw(&self.ring, &self.episodes, &mut self.rng, &mut self.window)
            {
                return Err(self.no_anchor());
            }
            let states = self.assembler.write_row(
                &self.affinity,
                &self.window,
                &mut self.rng,
                (&mut rows_mut, row),
            );
            match self.ring.frames() {
                Frames::Plain(frames) => states.write(&mut rows_mut, row, |index, out| {
                    let stack = self.episodes.stack(&self.ring, index);
                    stack.write(pixel_bytes, out, |index| frames.frame(index));
                }),
                Frames::Compressed(frames) => {
                    packed.add_row((&self.ring, frames, &self.episodes), states);
                }
            }
            ks.push(states.k());
            age_total += self.ring.inserted() - 1 - self.window.index(0);
            let version = self.window.step(0).weights_version;
            let (newest, oldest) = header.weights_versions;
            header.weights_versions = (newest.max(version), oldest.min(version));
        }
        header.mean_age = age_total as f64 / f64::from(rows);
        self.statistics.mean_age = header.mean_age;
        self.statistics.served(&ks);
        self.limiter.sampled(rows);
        header.tally = self.limiter.tally();
        batch.header = header;
        self.starving = false;
        Ok(Draft { batch, packed, ks })
    }

    /// What a batch of `rows` rows says of itself before any row is written.
    pub(crate) fn batch_header(&self, rows: u32) -> BatchHeader {
        BatchHeader {
            tally: self.limiter.tally(),
            held: self.ring.inserted() - self.ring.oldest(),
            ..BatchHeader::of(&self.spec, rows)
        }
    }

    fn no_anchor(&mut self) -> Unready {
        if self.limiter.all_in() {
            let why = format!(
                "none of the {} transitions held can be sampled, and no more will come: every copy of the world needs n_step or k_max consecutive ones; raise capacity_transitions or transitions_max, or use fewer copies",
                self.ring.inserted() - self.ring.oldest()
            );
            return Unready::Refused { why };
        }
        self.starving = true;
        Unready::Wait(Waiting::LearnerWaitsForActors)
    }

    /// Takes a newer affinity matrix; one that is not newer than this learner's last is ignored.
    ///
    /// # Errors
    /// A matrix of another size, or with an entry that is no probability; it counts as a refused message.
    pub fn set_affinity(&mut self, update: &AffinityUpdate) -> Result<(), CodecError> {
        self.affinity
            .update(update)
            .inspect_err(|_| self.note_refused_message())
    }

    /// Takes an actor's last word; what it produced and is not stored counts as lost, the reverse as stored twice.
    pub fn goodbye(&mut self, goodbye: &Goodbye) {
        let difference = self.actors.goodbye(goodbye);
        self.count(goodbye.actor, difference);
    }

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

    /// What was counted here since the start.
    pub const fn tally(&self) -> Tally {
        self.limiter.tally()
    }

    /// Takes what the replay's other shards have counted.
    ///
    /// # Errors
    /// More transitions than the run can ever have; the reason, for a person.
    pub fn heard(&mut self, elsewhere: Tally) -> Result<(), String> {
        let config = &self.config;
        // Each shard takes what its limiter allows until it hears of the others, at most what it holds.
        let most = |max: u64| max.saturating_add(config.capacity_transitions);
        if let Some(most) = config.transitions_max.map(most)
            && elsewhere.inserted > most
        {
            return Err(format!(
                "the other shards are said to have stored {} transitions; this run has at most {most}",
                elsewhere.inserted
            ));
        }
        self.limiter.heard(elsewhere);
        Ok(())
    }

    /// Who waits for whom now, for batches of the size that the replay was made for.
    pub fn waiting(&self) -> Waiting {
        match self.limiter.waiting(self.batch_rows) {
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
        let stored: u64 = self.statistics.action_histogram.iter().sum();
        assert_eq!(
            stored,
            self.ring.inserted(),
            "every transition stored has one action"
        );
        assert_eq!(
            self.before.inserted + stored,
            self.limiter.tally().inserted,
            "every transition stored is counted"
        );
        let served: u64 = self.statistics.k_histogram.iter().sum();
        assert_eq!(
            self.before.rows_sampled + served,
            self.limiter.tally().rows_sampled + self.statistics.rows_unlearned,
            "every row served has one k"
        );
    }
}
