//! The actors of a replay, and the chunks that they send.
//! The ledger decides which chunk of an actor comes next; the rate limiter decides when a chunk may be stored.

use std::borrow::Cow;

use driml_protocol::{ActorJoin, Chunk, ChunkPoll, EndedEpisode, InsertReply, Leave, Totals};

use super::Replay;
use crate::{
    ledger::actors::{ChunkOrder, Difference},
    persist::{journal::Journal, snapshot::ProcessEvent},
    storage::{
        pack::{PackedChunk, Packer},
        ring::Step,
    },
};

/// Maximum transitions that one incarnation of an actor may report: three years at three million per second.
const PRODUCED_MAX: u64 = 1 << 48;

impl Replay {
    /// Admits an incarnation of an actor: only its chunks are stored from now on. Returns the number of earlier incarnations.
    ///
    /// # Errors
    /// Too many actors, or an incarnation that another one has replaced; the reason, for a person.
    pub fn join_actor(&mut self, join: ActorJoin) -> Result<u32, String> {
        let before = self.actor_incarnation(join.actor);
        let earlier_incarnations = self.state.actors.join(join)?;
        if before != Some(join.incarnation) {
            self.append_to_log(ProcessEvent::ActorJoined(join));
        }
        Ok(earlier_incarnations)
    }

    /// If the run has no room for the actor `joining`, forgets those that never sent a chunk and are not connected. Returns their numbers.
    pub(crate) fn forget_absent(
        &mut self,
        joining: u32,
        is_connected: impl Fn(u32, u64) -> bool,
    ) -> Vec<u32> {
        let absent = self.state.actors.forgettable(joining, is_connected);
        if !absent.is_empty() {
            self.state.actors.forget(&absent);
            self.append_to_log(ProcessEvent::Forgotten(absent.clone()));
        }
        absent
    }

    /// Returns the incarnation of `actor` whose chunks are stored; `None` before the actor joins.
    pub fn actor_incarnation(&self, actor: u32) -> Option<u64> {
        self.state.actors.current_incarnation(actor)
    }

    /// Returns a packer that compresses chunks for this replay. It can be used without a lock on the replay.
    pub(crate) fn packer(&self) -> Packer {
        Packer {
            compression: self.config.compression,
            spec_hash: self.journal.as_ref().map(Journal::spec_hash),
        }
    }

    /// Stores a whole chunk, or replies why not.
    pub fn insert(&mut self, chunk: &Chunk) -> InsertReply {
        self.insert_packed(&self.packer().pack(Cow::Borrowed(chunk)))
    }

    /// Does the same as [`Replay::insert`] for a chunk that this replay's packer has packed.
    pub(crate) fn insert_packed(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        self.early_reply(packed)
            .unwrap_or_else(|| self.store_if_allowed(packed))
    }

    /// Returns the reply to a chunk that must not be stored: it is already stored, out of order, invalid, or comes after the end of the
    /// run. `None` if [`Replay::store_if_allowed`] has to decide.
    ///
    /// A retry is answered `Stored`, whatever the limiter allows. An out-of-order chunk is stored only if its actor insists on it.
    pub(crate) fn early_reply(&mut self, packed: &PackedChunk<'_>) -> Option<InsertReply> {
        let header = &packed.chunk.header;
        let order = self.check_chunk(&packed.chunk);
        let order = order.and_then(|()| self.state.actors.chunk_order(header));
        match order {
            Err(why) => Some(self.reject(why)),
            Ok(ChunkOrder::Retried) => {
                self.counters_mut().chunks_retried += 1;
                Some(self.stored_reply())
            }
            Ok(_) if self.limiter.all_stored() => Some(self.finished_reply()),
            Ok(ChunkOrder::OutOfOrder { .. }) if self.state.actors.accepts_gap(header) => None,
            Ok(ChunkOrder::OutOfOrder { expected }) => Some(InsertReply::OutOfOrder { expected }),
            Ok(ChunkOrder::Next) => None,
        }
    }

    /// Stores a chunk for which [`Replay::early_reply`] returned `None`, on disk before in memory. Replies `Wait` while the disk rejects
    /// writes, and if the limiter has no room, unless the actor is leaving (`Actors::passes_limiter`) or the last draw found no anchor.
    pub(crate) fn store_if_allowed(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        let may_insert = self.limiter.may_insert() || self.is_starving();
        if !(may_insert || self.state.actors.passes_limiter(&packed.chunk.header)) {
            return self.wait_reply(false);
        }
        let journal = self.journal.as_mut();
        match journal.map_or(Ok(true), |journal| journal.append_chunk(packed)) {
            Ok(true) => {}
            Ok(false) => return self.wait_reply(false),
            Err(why) => return InsertReply::Refused { why },
        }
        self.store(packed);
        self.rotate_and_prune();
        self.stored_reply()
    }

    /// Returns what became of a chunk: stored, no longer wanted, or never to be stored. `None` if the chunk has not arrived or is parked.
    pub fn answer_poll(&mut self, poll: &ChunkPoll) -> Option<InsertReply> {
        match self.state.actors.is_stored(poll) {
            Ok(true) => Some(self.stored_reply()),
            Ok(false) => self.limiter.all_stored().then(|| self.finished_reply()),
            Err(why) => Some(self.reject(why)),
        }
    }

    /// Returns the reply that a chunk has to wait. `kept` tells whether the server keeps the chunk meanwhile.
    pub(crate) fn wait_reply(&self, kept: bool) -> InsertReply {
        InsertReply::Wait {
            inserted_total: self.inserted_total(),
            kept,
        }
    }

    fn reject(&mut self, why: String) -> InsertReply {
        self.counters_mut().messages_refused += 1;
        InsertReply::Refused { why }
    }

    fn stored_reply(&self) -> InsertReply {
        let actors = self.state.statistics.counted.actors;
        InsertReply::Stored {
            inserted_total: self.inserted_total(),
            actors: actors.saturating_mul(self.config.shards),
            waited: false,
        }
    }

    fn finished_reply(&self) -> InsertReply {
        InsertReply::Finished {
            inserted_total: self.inserted_total(),
        }
    }

    /// Checks the sizes, counts, rewards and actions of a chunk against the run's settings. The error says what is wrong.
    pub(crate) fn check_chunk(&self, chunk: &Chunk) -> Result<(), String> {
        let (spec, capacity) = (&self.spec, self.ring.capacity());
        let header = &chunk.header;
        let (sent, frame_bytes) = (header.frame_bytes, spec.frame_bytes());
        if sent as usize != frame_bytes {
            return Err(format!(
                "frames of {sent} bytes; this run has {frame_bytes}"
            ));
        }
        let transitions = header.transitions() as u64;
        if transitions == 0 || transitions > capacity {
            return Err(format!(
                "{transitions} transitions in one chunk; the replay holds {capacity}: use 1 to that many"
            ));
        }
        let bytes = transitions * frame_bytes as u64;
        let max = self.config.compressed_bytes_max;
        let share = max.map(|max| max / u64::from(self.config.shards));
        if let Some(share) = share.filter(|&share| share < bytes) {
            return Err(format!(
                "a chunk that may take {bytes} bytes; this shard's share of compressed_bytes_max is {share}"
            ));
        }
        let (sequence, first) = (header.sequence, header.first_transition);
        let count = first.checked_add(transitions);
        if sequence == u64::MAX || count.is_none_or(|count| count > PRODUCED_MAX) {
            return Err(format!(
                "counts that no run reaches: chunk {sequence}, transition {first}"
            ));
        }
        let reward_max = f32::MAX / spec.n_step as f32;
        let mut rewards = (0..header.transitions()).map(|row| chunk.reward(row));
        if let Some(reward) = rewards.find(|reward| reward.is_nan() || reward.abs() > reward_max) {
            return Err(format!(
                "a reward of {reward:e}; returns of {} steps are float32, so a reward is at most {reward_max:e}: scale the world's rewards",
                spec.n_step
            ));
        }
        let mut actions = chunk.actions().iter();
        match actions.find(|&&action| u32::from(action) >= spec.num_actions) {
            Some(action) => Err(format!(
                "action {action}; this run has {}",
                spec.num_actions
            )),
            None => Ok(()),
        }
    }

    /// Stores an accepted chunk in memory, and counts it.
    pub(crate) fn store(&mut self, packed: &PackedChunk<'_>) {
        let chunk = &*packed.chunk;
        let header = chunk.header;
        let statistics = &mut self.state.statistics;
        let (streams, difference) = self.state.actors.accept(&header);
        self.limiter.count_inserted(header.transitions() as u64);
        let steps = header.steps as usize;
        // The count of all shards, by their last reports.
        let total = self.limiter.inserted_total();
        for (number, stream) in streams.iter_mut().enumerate() {
            let rows = number * steps..(number + 1) * steps;
            let step = |row| {
                let (action, reward) = (chunk.actions()[row], chunk.reward(row));
                Step::new(action, reward, chunk.end(row), header.weights_version)
            };
            let (link, first) = (stream.link, self.ring.inserted());
            let frames = packed.stream_frames(number);
            stream.link = self.ring.push_steps(frames, rows.clone().map(step), link);
            self.sampler.rows.add_stored(&self.ring, first, link);
            for step in rows.map(step) {
                statistics.counted.action_histogram[usize::from(step.action)] += 1;
                if let Some(episode) = &mut stream.episode {
                    episode.episode_return += f64::from(step.reward);
                    episode.steps += 1;
                }
                if step.end.is_episode_end() {
                    statistics.count_episode(EndedEpisode {
                        frames: total,
                        actor: header.actor,
                        env: number as u32,
                        totals: stream.episode.replace(Totals::default()),
                    });
                }
            }
        }
        self.state.starving = false;
        self.count_difference(header.actor, difference);
    }

    fn count_difference(&mut self, actor: u32, difference: Difference) {
        let Difference { lost, duplicated } = difference;
        // `Statistics::count_difference` limits the rate of this line, which a faulty actor could trigger with every message.
        if self.state.statistics.count_difference(difference) && !self.is_recovering {
            tracing::warn!(
                "actor {actor}: {lost} transitions lost, {duplicated} stored twice, by its own count"
            );
        }
    }

    /// Takes an actor's `Leave`. Transitions that it produced and that are not stored count as lost, the reverse as duplicated. Returns the
    /// reason if the message is rejected: its incarnation never joined, or its count is impossible.
    pub fn leave(&mut self, leave: &Leave) -> Option<String> {
        let result = match leave.produced {
            0..=PRODUCED_MAX => self.state.actors.leave(leave),
            produced => Err(format!(
                "actor {} reports {produced} transitions, a count that no run reaches",
                leave.actor
            )),
        };
        match result {
            Ok(Some(difference)) => {
                self.count_difference(leave.actor, difference);
                self.append_to_log(ProcessEvent::Leave(*leave));
            }
            Ok(None) => {}
            Err(_) => self.counters_mut().messages_refused += 1,
        }
        result.err()
    }
}
