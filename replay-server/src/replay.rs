//! The replay server's core: chunks in, batches out, who takes part, and its account of itself.
//! It keeps no time and starts no thread: the service around it does. What it writes to disk is in `persist`, how rows are drawn in
//! `sampling`, what is counted in `ledger` and `rate_limiter`.

use std::borrow::Cow;

use driml_protocol::{
    ActorJoin, AffinityUpdate, Batch, BatchHeader, BatchReply, Buffer, Chunk, ChunkHeader, Claim,
    CodecError, EndedEpisode, EpisodesReply, Goodbye, InsertReply, Learned, LearnerJoin, LogStatus,
    Origin, Played, PriorityUpdate, ReplayStatus, RequestId, RunSpec, Tally, Waiting, codec,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    admission::{self, TRANSITIONS_MAX},
    config::{self, Config, ConfigError, SHARDS_MAX},
    ledger::{
        actors::{Actors, Difference, Verdict},
        requests::{Dedup, Requests},
        statistics::Statistics,
    },
    persist::{
        error::PersistError,
        log::Log,
        segment::Mark,
        snapshot::{Note, Snapshot},
    },
    rate_limiter::RateLimiter,
    sampling::{
        assemble::{Assembler, RowStates},
        episodes::{Episodes, Window},
        horizon::Affinity,
        needed_frames::NeededFrames,
        packed_batch::{PackedBatch, PackedFrames},
        rows::{
            self,
            sampler::{Held, PriorityCounts, RowSampler, RowsState},
        },
    },
    storage::{
        frame_store::{Frames, PackedChunk, Packer},
        ring::{Ring, Step},
    },
};

/// The replay server's own stream of the run's seed, so that no other process draws the same numbers.
const RNG_STREAM: u64 = u64::from_be_bytes(*b"replay-1");
/// How far the version of an affinity matrix may be ahead of the rows served, of which a replay that was started anew may not
/// know all.
const VERSION_AHEAD_MAX: u64 = 1 << 32;
/// Most updates and rows that a learner can have behind it.
const LEARNED_MAX: u64 = 1 << 60;

/// Transitions of one piece of what is gone.
const GONE_PIECE: u64 = 256;

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

/// Everything the replay server knows. Kept in memory alone, or, with a log, on disk too: [`KeptReplay`](crate::KeptReplay).
pub struct Replay {
    pub(crate) spec: RunSpec,
    pub(crate) config: Config,
    pub(crate) batch_size: u32,
    pub(crate) ring: Ring,
    pub(crate) actors: Actors,
    requests: Requests,
    /// The learner that is served, as it joined.
    pub(crate) learner: Option<LearnerJoin>,
    pub(crate) learned: Learned,
    /// Updates after which the run was resumed without this replay.
    pub(crate) resumed_after: u64,
    /// Transitions that the run had stored then.
    pub(crate) inserted_before: u64,
    /// Rows that were sampled and are in no histogram of this replay; below 0 if some of those that are were not sampled.
    pub(crate) rows_before: i64,
    pub(crate) limiter: RateLimiter,
    episodes: Episodes,
    rows: Box<dyn RowSampler>,
    /// Who draws, as batches say it that are drawn by priority.
    pub(crate) origin: Origin,
    window: Window,
    assembler: Assembler,
    pub(crate) affinity: Affinity,
    pub(crate) rng: ChaCha8Rng,
    pub(crate) statistics: Statistics,
    /// The learner found no anchor: one chunk may pass the limiter, or both sides would wait for each other.
    pub(crate) starving: bool,
    /// It is being read back: what is counted was logged when it happened.
    pub(crate) quiet: bool,
    /// It was read back: how many rows the learner has, it says with its next request.
    awaits_learner: bool,
    pub(crate) log: Option<Log>,
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
        let bytes_max = config.compressed_bytes_max.map(|bytes| bytes / shards);
        let frames = Frames::new(config.compression, capacity, spec.frame_bytes(), bytes_max);
        let ring = frames.and_then(|frames| Ring::new(capacity, frames));
        let sampler = rows::sampler(&config.sampling, spec, capacity);
        let (ring, rows) = ring
            .and_then(|ring| Ok((ring, sampler?)))
            .map_err(|bytes| ConfigError::Key {
                key: "replay.capacity_transitions",
                value: config.capacity_transitions.to_string(),
                why: format!(
                    "the system does not grant the {bytes} bytes that this takes; hold fewer"
                ),
            })?;
        let mut rng = ChaCha8Rng::seed_from_u64(spec.seed);
        rng.set_stream(RNG_STREAM + u64::from(shard));
        let mut limiter = RateLimiter::new(
            config.replay_ratio,
            config.warmup_transitions,
            config.slack_transitions,
            config.transitions_max,
        );
        if let Some(since) = config.since {
            limiter = limiter.since(Tally {
                inserted: since.transitions,
                rows_sampled: since.rows,
            });
        }
        Ok(Self {
            spec: spec.clone(),
            config: config.clone(),
            batch_size,
            ring,
            actors: Actors::default(),
            requests: Requests::default(),
            learner: None,
            learned: Learned::default(),
            resumed_after: 0,
            inserted_before: 0,
            rows_before: 0,
            limiter,
            episodes: Episodes::new(spec),
            rows,
            origin: Origin {
                shard,
                incarnation: 0,
            },
            window: Window::default(),
            assembler: Assembler::new(spec),
            affinity: Affinity::uniform(spec.num_actions),
            rng,
            statistics: Statistics::new(spec.horizon.k_max(), spec.num_actions),
            starving: false,
            quiet: false,
            awaits_learner: false,
            log: None,
        })
    }

    /// The same, drawing under this number: priorities of rows that were drawn under another one are counted and change nothing.
    /// A replay server that is started again numbers its transitions anew, or has lost some, and so draws another number.
    #[must_use]
    pub const fn with_incarnation(mut self, incarnation: u64) -> Self {
        self.origin.incarnation = incarnation;
        self
    }

    /// Draws other numbers than at the start of the run, after `resumed` of whatever it counts.
    fn draw_anew(&mut self, resumed: u64) {
        let beyond = resumed.wrapping_mul(u64::from(SHARDS_MAX));
        let stream = RNG_STREAM + u64::from(self.origin.shard);
        self.rng.set_stream(stream.wrapping_add(beyond));
    }
}

/// Actors, and the chunks that they send.
impl Replay {
    /// Takes part from now on: chunks of this life of the actor are stored, those of an earlier one no longer. Gives the number
    /// of earlier ones.
    ///
    /// # Errors
    /// Too many actors, or a life that another one has replaced; the reason, for a person.
    pub fn join_actor(&mut self, join: ActorJoin) -> Result<u32, String> {
        let before = self.actor_incarnation(join.actor);
        self.actors.join(join)?;
        if before != Some(join.incarnation) {
            self.note(Note::ActorJoined(join));
        }
        Ok(self.actors.earlier_incarnations(join.actor))
    }

    /// The life of `actor` whose chunks are stored; none before it joins.
    pub fn actor_incarnation(&self, actor: u32) -> Option<u64> {
        self.actors.current_incarnation(actor)
    }

    /// Actors of which a chunk has come.
    pub(crate) fn actors_delivered(&self) -> impl Iterator<Item = u32> {
        self.actors.delivered()
    }

    /// Makes room for an actor if a run's number of them is reached: forgets those that never sent a chunk and of which
    /// `is_connected` says that their life is gone, as somebody who joins under one number after the other leaves behind.
    pub(crate) fn forget_absent_actors(&mut self, is_connected: impl Fn(u32, u64) -> bool) {
        self.actors.forget_absent(is_connected);
    }

    /// Compresses chunks for this replay; it can do so while the replay is in use elsewhere.
    pub fn packer(&self) -> Packer {
        Packer {
            compression: self.config.compression,
            seal_for: self.log.as_ref().map(|log| log.spec_hash),
        }
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
                self.statistics.messages_refused += 1;
                Some(InsertReply::Refused { why })
            }
            Verdict::Retried => {
                self.statistics.chunks_retried += 1;
                Some(self.stored())
            }
            _ if self.limiter.all_in() => Some(self.run_is_full()),
            Verdict::OutOfOrder { .. } if self.actors.insists(&chunk.header) => None,
            Verdict::OutOfOrder { expected } => Some(InsertReply::OutOfOrder { expected }),
            Verdict::Next => None,
        }
    }

    /// Stores a chunk that [`Replay::settle`] has nothing to say of, on disk before in memory, if the limiter lets it pass or its actor
    /// leaves; else, and while the disk refuses, the answer is to wait.
    pub fn admit(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        if !(self.limiter.may_insert() || self.starving || packed.chunk.header.leaving) {
            return self.wait(false);
        }
        match self.log.as_mut().map_or(Ok(true), |log| log.chunk(packed)) {
            Ok(true) => {}
            Ok(false) => return self.wait(false),
            Err(why) => return InsertReply::Refused { why },
        }
        self.store(packed);
        self.tidy();
        self.stored()
    }

    /// What became of a chunk: stored, not wanted any more, or never to be stored; none where it is still to come.
    pub fn claim(&mut self, claim: &Claim) -> Option<InsertReply> {
        match self.actors.is_stored(claim) {
            Ok(true) => Some(self.stored()),
            Ok(false) => self.limiter.all_in().then(|| self.run_is_full()),
            Err(why) => {
                self.statistics.messages_refused += 1;
                Some(InsertReply::Refused { why })
            }
        }
    }

    /// The answer that a chunk has to wait; `kept` says whether it waits here.
    pub(crate) const fn wait(&self, kept: bool) -> InsertReply {
        InsertReply::Wait {
            inserted_total: self.inserted_total(),
            kept,
        }
    }

    fn stored(&self) -> InsertReply {
        InsertReply::Stored {
            inserted_total: self.inserted_total(),
            actors: self.statistics.actors.saturating_mul(self.config.shards),
            waited: false,
        }
    }

    const fn run_is_full(&self) -> InsertReply {
        InsertReply::Finished {
            inserted_total: self.inserted_total(),
        }
    }

    pub(crate) fn unfit(&self, chunk: &Chunk) -> Option<String> {
        admission::unfit(&self.spec, &self.config, self.ring.capacity(), chunk)
    }

    /// Stores a chunk that is the next of its actor.
    pub(crate) fn store(&mut self, packed: &PackedChunk<'_>) {
        let chunk = &*packed.chunk;
        let header = chunk.header;
        let (streams, difference) = self.actors.accept(&header);
        self.limiter.inserted(header.transitions() as u64);
        let steps = header.steps as usize;
        // In all shards, as far as heard.
        let frames = self.limiter.inserted_total();
        for ((number, stream), run) in streams.iter_mut().enumerate().zip(packed.runs()) {
            let rows = number * steps..(number + 1) * steps;
            let step = |row| {
                let (action, reward) = (chunk.actions()[row], chunk.reward(row));
                Step::new(action, reward, chunk.end(row), header.weights_version)
            };
            let (link, first) = (stream.link, self.ring.inserted());
            stream.link = self.ring.push_run(run, rows.clone().map(step), link);
            let (ring, episodes) = (&self.ring, &self.episodes);
            self.rows.stored(Held { ring, episodes }, first, link);
            for step in rows.map(step) {
                self.statistics.action_histogram[usize::from(step.action)] += 1;
                if let Some(episode) = &mut stream.episode {
                    episode.episode_return += f64::from(step.reward);
                    episode.steps += 1;
                }
                if step.end.is_episode_end() {
                    self.statistics.episode_ended(EndedEpisode {
                        frames,
                        actor: header.actor,
                        copy: number as u32,
                        played: stream.episode.replace(Played::default()),
                    });
                }
            }
        }
        self.starving = false;
        self.count(header.actor, difference);
    }

    fn count(&mut self, actor: u32, difference: Difference) {
        let Difference { lost, duplicated } = difference;
        // Whoever sends nonsense could make the line come at any rate.
        if self.statistics.count(difference) && !self.quiet {
            tracing::warn!(
                "actor {actor}: {lost} transitions lost, {duplicated} stored twice, by its own count"
            );
        }
    }

    /// Takes an actor's last word; what it produced and is not stored counts as lost, the reverse as stored twice. One of a life
    /// that never joined, or with a count that no run reaches, is refused: gives the reason.
    pub fn goodbye(&mut self, goodbye: &Goodbye) -> Option<String> {
        let said = match goodbye.produced {
            0..=TRANSITIONS_MAX => self.actors.goodbye(goodbye),
            produced => Err(format!(
                "actor {} says it produced {produced} transitions, a count that no run reaches",
                goodbye.actor
            )),
        };
        match said {
            Ok(difference) => {
                self.count(goodbye.actor, difference);
                self.note(Note::Goodbye(*goodbye));
                None
            }
            Err(why) => {
                self.note_refused_message();
                Some(why)
            }
        }
    }
}

/// The learner, and the batches that it is served.
impl Replay {
    /// Serves this learner from now on, and it alone. How many rows were learned is what it says: what was served beyond them counts as
    /// not sampled. A replay that is empty counts on from where its checkpoint stands, and fills again before the next row is sampled.
    /// Gives the number of updates that are learned again.
    ///
    /// # Errors
    /// Another learner has learned in this run, and this one has no checkpoint of it; what to do, for a person.
    pub fn join_learner(&mut self, join: LearnerJoin) -> Result<u64, String> {
        let counts = [join.tally, join.other_shards].map(|it| it.inserted.max(it.rows_sampled));
        if join.updates.max(counts[0]).max(counts[1]) > LEARNED_MAX {
            return Err(format!(
                "a learner after {} updates, {:?} and {:?}: counts that no run reaches",
                join.updates, join.tally, join.other_shards
            ));
        }
        let done = self.learned.updates;
        match self.learner {
            // It has not heard the answer.
            Some(known) if known.learner == join.learner => return Ok(0),
            Some(known) if known.run == join.run || join.restart => {}
            Some(_) if done == 0 && join.updates == 0 => {}
            Some(_) => {
                return Err(format!(
                    "the run has learned {done} updates, and the learner has no checkpoint of it: start the learner with the --run-dir \
                     that holds its checkpoints, or with --restart to begin again from the first update"
                ));
            }
            None => self.resume_empty(&join),
        }
        let learned = join.tally.rows_sampled;
        let unlearned = self.limiter.tally().rows_sampled.saturating_sub(learned);
        self.statistics.rows_unlearned += unlearned;
        self.limiter.refund(unlearned);
        self.set_rows_sampled(learned);
        self.limiter.adopt_other_shards(join.other_shards);
        let again = done.saturating_sub(join.updates);
        self.statistics.updates_relearned += again;
        self.learned = Learned {
            updates: join.updates,
            saved_updates: join.updates,
            rows_received: learned,
        };
        (self.learner, self.awaits_learner) = (Some(join), false);
        self.requests = Requests::default();
        self.affinity.expect_another_source();
        self.note(Note::LearnerJoined(join));
        Ok(again)
    }

    /// Counts on from a learner's checkpoint, if nothing is stored here.
    fn resume_empty(&mut self, join: &LearnerJoin) {
        if join.updates == 0 || self.ring.inserted() > 0 {
            return;
        }
        let shards = u64::from(self.config.shards);
        let refill = self.config.warmup_transitions.div_ceil(shards);
        // All shards' credit decides whether anything is left to fill it for.
        self.limiter.adopt_other_shards(join.other_shards);
        self.limiter
            .resume_empty(join.tally, refill, self.batch_size);
        self.inserted_before = join.tally.inserted;
        self.rows_before = join.tally.rows_sampled as i64;
        self.resumed_after = join.updates;
        self.draw_anew(join.updates);
    }

    /// So many rows were sampled here, whatever was counted.
    fn set_rows_sampled(&mut self, rows: u64) {
        let counted = self.limiter.tally().rows_sampled;
        self.rows_before += rows as i64 - counted as i64;
        self.limiter.set_rows_sampled(rows);
    }

    /// The learner that is served.
    pub fn learner(&self) -> Option<u64> {
        self.learner.map(|it| it.learner)
    }

    /// Updates after which the run was resumed without its replay; 0 if it never was, or before its learner has joined.
    pub const fn resumed_after(&self) -> u64 {
        self.resumed_after
    }

    /// Takes what the learner says it has done. If it has saved a checkpoint, so does a replay that is kept on disk.
    ///
    /// # Errors
    /// Counts that no run reaches; the reason, for a person.
    pub fn note_learned(&mut self, learned: Learned) -> Result<(), String> {
        let Learned {
            updates,
            saved_updates,
            rows_received,
        } = learned;
        if updates.max(saved_updates).max(rows_received) > LEARNED_MAX {
            return Err(format!(
                "a learner with {updates} updates and {rows_received} rows, counts that no run reaches"
            ));
        }
        if std::mem::take(&mut self.awaits_learner) {
            self.set_rows_sampled(rows_received);
        }
        // A request may overtake another.
        if updates >= self.learned.updates {
            let has_saved = saved_updates > self.learned.saved_updates;
            self.learned = learned;
            if has_saved {
                self.begin_segment();
            }
        }
        Ok(())
    }

    /// The learner has done so many updates.
    pub fn note_updates(&mut self, updates: u64) {
        self.learned.updates = self.learned.updates.max(updates.min(LEARNED_MAX));
    }

    /// Makes a batch: [`Replay::draw`] and [`PackedBatch::unpack`] in one.
    ///
    /// # Errors
    /// As [`Replay::draw`].
    pub fn sample(&mut self, rows: u32) -> Result<Batch, Unready> {
        self.draw(rows).map(PackedBatch::unpack)
    }

    /// A batch of `rows` rows, anchors drawn with replacement by the rule of `replay.sampling`, or why there is none. With
    /// compression its frames are left to be unpacked, which needs the replay no more.
    ///
    /// # Errors
    /// The limiter or the lack of any valid anchor asks to wait; the run is over; `rows` can never be served.
    pub fn draw(&mut self, rows: u32) -> Result<PackedBatch, Unready> {
        self.draw_in(rows, Buffer::zeroed)
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
        memory: impl FnOnce(usize) -> Buffer,
    ) -> Result<PackedBatch, Unready> {
        let Dedup::Fresh(lost) = self.requests.begin(id) else {
            return Err(Unready::Wait(self.limiter.waiting(rows)));
        };
        if !lost.is_empty() {
            tracing::warn!("a batch of {} rows did not reach the learner", lost.len());
            self.limiter.refund(lost.len() as u64);
            self.statistics.refund(&lost);
        }
        let draft = self.draw_in(rows, memory)?;
        self.requests.complete(id.client_id, draft.ks.clone());
        Ok(draft)
    }

    /// [`Replay::draw`] into memory that `memory` gives, so many bytes, all of which are written by the time it is unpacked.
    ///
    /// # Errors
    /// As [`Replay::draw`].
    pub fn draw_in(
        &mut self,
        rows: u32,
        memory: impl FnOnce(usize) -> Buffer,
    ) -> Result<PackedBatch, Unready> {
        let rows_max = config::rows_max(&self.spec, &self.config.sampling);
        let rows_max = rows_max.min(self.limiter.rows_max());
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
        let mut drawn = Vec::with_capacity(rows as usize);
        let mut ks = Vec::with_capacity(rows as usize);
        let mut age_total = 0;
        for _ in 0..rows {
            let (ring, episodes) = (&self.ring, &self.episodes);
            let held = Held { ring, episodes };
            if !self.rows.draw(held, &mut self.rng, &mut self.window) {
                return Err(self.no_anchor());
            }
            let row = self
                .assembler
                .row(&self.affinity, &self.window, &mut self.rng);
            ks.push(row.1.k());
            drawn.push(row);
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
        let (scalars, states): (Vec<_>, Vec<_>) = drawn.into_iter().unzip();
        let mut needed = NeededFrames::default();
        if let Some(stacked) = &mut header.stacked {
            needed = NeededFrames::of(&self.ring, &self.episodes, states.iter());
            stacked.frames = needed.count() as u32;
        }
        let mut batch = Batch::of_rows(header, &scalars, memory);
        // All by the masses that are there now: to find that one was no anchor any more makes the others more likely.
        let probability = |states: &RowStates| {
            let probability = self.rows.probability(states.anchor())? as f32;
            Some((states.anchor(), probability.clamp(f32::MIN_POSITIVE, 1.0)))
        };
        if let Some(draws) = states.iter().map(probability).collect::<Option<Vec<_>>>() {
            batch.set_draws(draws.into_iter());
        }
        let mut packed = PackedFrames::new(self.spec.frame_bytes());
        let mut places = batch.states_mut();
        let mut stacks = needed.stacks();
        for (row, states) in states.iter().enumerate() {
            let numbers: Vec<usize> = places.of_row(row).collect();
            if header.stacked.is_none() {
                let frames = states.indices().zip(numbers);
                packed.write_or_take_row(&self.ring, frames, &mut places);
                continue;
            }
            for (number, stack) in numbers.into_iter().zip(&mut stacks) {
                places.set_stack(number, stack);
            }
            packed.write_or_take_row(&self.ring, needed.first_in(row), &mut places);
        }
        self.starving = false;
        Ok(PackedBatch { batch, packed, ks })
    }

    /// What a batch of `rows` rows says of itself before any row is written.
    pub(crate) fn batch_header(&self, rows: u32) -> BatchHeader {
        BatchHeader {
            tally: self.limiter.tally(),
            held: self.ring.inserted() - self.ring.oldest(),
            origin: self.config.sampling.is_prioritised().then_some(self.origin),
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
        // A version is a count of updates, each of at least one row.
        let rows = self.limiter.rows_sampled_total();
        let set = match update.version.saturating_sub(rows) {
            0..=VERSION_AHEAD_MAX => self.affinity.update(update),
            _ => Err(CodecError::Header(format!(
                "version {} of the affinity, in a run that has served {rows} rows",
                update.version
            ))),
        };
        set.inspect_err(|_| self.note_refused_message())
    }

    /// Takes the priorities of rows that were drawn here; those of other shards are none of its business. An update that has come
    /// before changes nothing, nor does a row whose transition was overwritten meanwhile: both are counted.
    ///
    /// # Errors
    /// A run that draws uniformly, or a transition that was never stored; the reason, for a person. Nothing has then changed.
    pub fn set_priorities(&mut self, update: &PriorityUpdate) -> Result<(), String> {
        self.rows.update(&self.ring, update, self.origin)
    }

    /// What became of the priorities that came; none where rows are drawn uniformly.
    pub fn priority_counts(&self) -> Option<PriorityCounts> {
        self.rows.priority_counts()
    }

    /// Takes what the replay's other shards have counted.
    ///
    /// # Errors
    /// More transitions than the run can ever have, or more rows than it gives for these; the reason, for a person.
    pub fn set_other_shards(&mut self, other_shards: Tally) -> Result<(), String> {
        let held_max = self.config.capacity_transitions;
        self.limiter.set_other_shards(other_shards, held_max)
    }
}

/// The log on disk, if there is one.
impl Replay {
    /// Bytes of the log; 0 without one.
    pub fn log_bytes(&self) -> u64 {
        self.log.as_ref().map_or(0, |log| log.journal.bytes())
    }

    /// How the log stands; none without one.
    pub fn log_status(&self) -> Option<LogStatus> {
        self.log.as_ref().map(|log| log.journal.status())
    }

    /// Whether all notes are on disk; until then joins and goodbyes get no answer.
    pub fn is_ready(&mut self) -> bool {
        let log = self.log.as_mut();
        log.is_none_or(|log| log.journal.is_ready())
    }

    /// Whether the disk refused what was to be written last.
    pub fn is_refused_by_disk(&self) -> bool {
        let log = self.log.as_ref();
        log.is_some_and(|log| log.journal.is_failing())
    }

    /// Flushes what was written to the disk: nothing more is to come.
    pub fn flush(&mut self) {
        if let Some(log) = &mut self.log {
            log.journal.flush();
        }
    }

    /// Marks this moment in the log, on the disk. The log can be opened there again, also after it went on: then all of the
    /// replay is as it is now, to the last bit. The last two marks hold, without those that were given up.
    ///
    /// # Errors
    /// A disk that refuses.
    pub fn mark(&mut self) -> Result<Option<Mark>, PersistError> {
        let snapshot = self.snapshot();
        let marked = self.log.as_mut().map(|log| log.mark(snapshot));
        self.prune();
        marked.transpose()
    }

    /// Nothing will go back to `mark`, as the checkpoint that was to name it could not be saved: it does not take the place of one
    /// to which a checkpoint goes back.
    pub fn give_up_mark(&mut self, mark: Mark) {
        if let Some(log) = &mut self.log {
            log.give_up(mark);
        }
    }

    fn note(&mut self, note: Note) {
        if let Some(log) = &mut self.log {
            log.note(&note);
        }
        self.tidy();
    }

    /// Begins another segment when one is full, and removes those that are not needed any more.
    pub(crate) fn tidy(&mut self) {
        let journal = self.log.as_ref().map(|log| &log.journal);
        if let Some(journal) = journal.filter(|it| it.is_full()) {
            if let Some(oldest) = journal.over_budget() {
                self.forget_before(oldest);
                self.prune();
            }
            self.begin_segment();
        }
        self.prune();
    }

    fn begin_segment(&mut self) {
        if self.log.is_some() {
            let snapshot = self.snapshot();
            self.log.iter_mut().for_each(|log| log.rotate(&snapshot));
        }
    }

    fn prune(&mut self) {
        let oldest = self.ring.oldest();
        self.log.iter_mut().for_each(|log| log.prune(oldest));
    }

    /// Lets go of the transitions before `oldest`.
    pub(crate) fn forget_before(&mut self, oldest: u64) {
        self.ring.forget_before(oldest);
        self.rows.forget(&self.ring);
    }

    /// All of it but the transitions.
    pub(crate) fn snapshot(&self) -> Snapshot {
        Snapshot {
            inserted: self.ring.inserted(),
            oldest: self.ring.oldest(),
            capacity: self.ring.capacity(),
            actors: self.actors.clone(),
            learner: self.learner,
            learned: self.learned,
            resumed_after: self.resumed_after,
            inserted_before: self.inserted_before,
            rows_before: self.rows_before,
            counts: self.limiter.counts(),
            affinity: self.affinity.clone(),
            rng: self.rng.clone(),
            statistics: self.statistics.logged(),
            starving: self.starving,
            rows: self.rows.state(&self.ring),
        }
    }

    /// Whether rows are drawn by the rule that left this state.
    pub(crate) fn draws_by_rule_of(&self, state: &RowsState) -> bool {
        let is_prioritised = matches!(state, RowsState::Prioritised(_));
        self.config.sampling.is_prioritised() == is_prioritised
    }

    /// Takes back a snapshot. The transitions between what is stored and those that the snapshot knows are gone: of an empty replay
    /// all, else they leave a gap, whose size is the result; 0 if it is so large that nothing before it is held.
    ///
    /// # Errors
    /// It is none of a replay of this run; the reason, for a person.
    pub(crate) fn restore(&mut self, mut snapshot: Snapshot) -> Result<u64, String> {
        if let Some(why) = snapshot.unfit(&self.snapshot(), self.spec.num_actions) {
            return Err(why.into());
        }
        let (stored, inserted) = (self.ring.inserted(), snapshot.inserted);
        if self.ring.first() == stored {
            self.ring.start_at(inserted);
        } else if inserted.saturating_sub(stored) >= self.ring.capacity() {
            // Nothing that is stored would be held.
            let origin = self.origin;
            *self = Self::shard(&self.spec, &self.config, self.batch_size, origin.shard)
                .map_err(|e| e.to_string())?;
            self.origin = origin;
            self.ring.start_at(inserted);
            snapshot.actors.cut_streams(stored);
        }
        let gap = inserted.checked_sub(self.ring.inserted()).ok_or_else(|| {
            format!("a state after {inserted} transitions, where {stored} are stored")
        })?;
        if gap > 0 {
            self.push_gone(gap);
            snapshot.actors.cut_streams(stored);
        }
        self.forget_before(snapshot.oldest);
        snapshot.actors.note_restored();
        if gap == 0 {
            snapshot.statistics.keep_newest_of(&mut self.statistics);
        }
        self.limiter.set_counts(snapshot.counts);
        self.restore_rows(snapshot.oldest, &snapshot.rows);
        self.actors = snapshot.actors;
        (self.learner, self.learned) = (snapshot.learner, snapshot.learned);
        (self.resumed_after, self.starving) = (snapshot.resumed_after, snapshot.starving);
        self.inserted_before = snapshot.inserted_before;
        self.rows_before = snapshot.rows_before;
        (self.affinity, self.rng) = (snapshot.affinity, snapshot.rng);
        self.statistics = snapshot.statistics;
        self.statistics.actors = 0;
        Ok(gap)
    }

    /// Takes the place of `count` transitions that are gone.
    fn push_gone(&mut self, mut count: u64) {
        let packer = self.packer();
        while count > 0 {
            let steps = count.min(GONE_PIECE).min(self.ring.capacity());
            let chunk = Chunk::zeroed(ChunkHeader {
                actor: 0,
                incarnation: 0,
                sequence: 0,
                first_transition: 0,
                weights_version: 0,
                leaving: false,
                streams: 1,
                steps: steps as u32,
                frame_bytes: self.spec.frame_bytes() as u32,
            });
            let packed = packer.pack(Cow::Owned(chunk));
            for run in packed.runs() {
                self.ring.push_gone(run, steps);
            }
            count -= steps;
        }
    }

    /// Takes back how rows were drawn when `oldest` was the oldest transition.
    fn restore_rows(&mut self, oldest: u64, state: &RowsState) {
        let (ring, episodes) = (&self.ring, &self.episodes);
        let held = Held { ring, episodes };
        self.rows.restore(held, oldest, state, &mut self.window);
    }

    /// Ends a recovery. Without a mark what was drawn since the last snapshot is not known: the learner says it.
    pub(crate) fn recovered(&mut self, exactly: bool) {
        self.quiet = false;
        self.statistics.actors = 0;
        if !exactly {
            self.awaits_learner = self.learner.is_some();
            self.draw_anew(self.ring.inserted());
        }
    }

    /// All but the transitions, as bytes that are the same where it is: what a mark brings back. For tests.
    ///
    /// # Errors
    /// A state over the codec's limit.
    pub fn state_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let mut snapshot = self.snapshot();
        snapshot.statistics = snapshot.statistics.of_changes();
        codec::encode_value(&snapshot)
    }

    /// The same without what was drawn: what a log brings back after its server died at any moment. For tests.
    ///
    /// # Errors
    /// A state over the codec's limit.
    pub fn stored_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let (fresh, snapshot) = (Affinity::uniform(self.spec.num_actions), self.snapshot());
        let mut counts = snapshot.counts;
        counts.this_shard.rows_sampled = 0;
        counts.other_shards = Tally::default();
        codec::encode_value(&Snapshot {
            learned: Learned::default(),
            rows_before: 0,
            counts,
            affinity: fresh,
            rng: ChaCha8Rng::seed_from_u64(0),
            statistics: snapshot.statistics.of_stored(),
            starving: false,
            rows: RowsState::Uniform { are_listed: false },
            ..snapshot
        })
    }
}

/// What it says of itself, and what the service around it tells it to count.
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

    /// Transitions of the run that were stored, in all shards as far as heard.
    pub const fn inserted_total(&self) -> u64 {
        self.limiter.inserted_total()
    }

    /// Whether all transitions of the run are in.
    pub fn all_in(&self) -> bool {
        self.limiter.all_in()
    }

    /// What was counted here since the start of the run.
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

    /// The account of itself; what the service alone knows is left at its default.
    pub fn status(&self) -> ReplayStatus {
        let (statistics, counts) = (&self.statistics, self.limiter.counts());
        ReplayStatus {
            transitions_inserted: counts.this_shard.inserted,
            transitions_refilled: counts.refilled,
            transitions_held: self.ring.inserted() - self.ring.oldest(),
            frame_bytes_held: self.ring.frames().bytes_held(),
            transitions_lost: statistics.transitions_lost,
            transitions_duplicated: statistics.transitions_duplicated,
            chunks_retried: statistics.chunks_retried,
            batches_retried: statistics.batches_retried,
            messages_refused: statistics.messages_refused,
            rows_sampled: counts.this_shard.rows_sampled,
            rows_unlearned: statistics.rows_unlearned,
            updates: self.learned.updates,
            updates_relearned: statistics.updates_relearned,
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
            affinity_version: self.affinity.version(),
            finished: self.limiter.all_in(),
            ..ReplayStatus::default()
        }
    }

    /// Episodes that ended after the first `since`, at most as many as one answer holds.
    pub fn episodes_since(&self, since: u64) -> EpisodesReply {
        self.statistics.episodes_since(since)
    }

    /// Somebody has recorded the first so many episodes that ended.
    pub fn note_recorded(&mut self, episodes: u64) {
        self.statistics.note_recorded(episodes);
    }

    /// Checks the ring and the counts; panics at the first that is wrong. Slow: for tests.
    pub fn check_valid(&self) {
        self.ring.check_valid();
        let (ring, episodes) = (&self.ring, &self.episodes);
        self.rows.check_valid(Held { ring, episodes });
        let snapshot = self.snapshot();
        assert_eq!(snapshot.unfit(&snapshot, self.spec.num_actions), None);
    }
}
