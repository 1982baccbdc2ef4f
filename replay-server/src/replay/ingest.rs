//! Chunks on their way in: judged, let in by the limiter, and stored exactly once.
//! How chunks wait that are too early is the service's business.

use std::borrow::Cow;

use driml_protocol::{ActorJoin, Chunk, ChunkHeader, Claim, Goodbye, InsertReply};

use super::Replay;
use crate::{
    config,
    ledger::{
        actors::{Difference, Verdict},
        statistics::Statistics,
    },
    storage::{
        frame_store::{PackedChunk, Packer},
        ring::Step,
    },
};

/// Transitions that one life of an actor can have produced, by its own account: three years at three million a second.
const TRANSITIONS_MAX: u64 = 1 << 48;

impl Replay {
    /// Compresses chunks for this replay; it can do so while the replay is in use elsewhere.
    pub fn packer(&self) -> Packer {
        Packer {
            compression: self.config.compression,
            seal_for: None,
        }
    }

    /// Takes part from now on: chunks of this life of the actor are stored, those of an earlier one no longer. Gives the number
    /// of earlier ones.
    ///
    /// # Errors
    /// Too many actors, or a life that another one has replaced; the reason, for a person.
    pub fn join_actor(&mut self, join: ActorJoin) -> Result<u32, String> {
        self.actors.join(join)?;
        Ok(self.actors.earlier_incarnations(join.actor))
    }

    /// The life of `actor` whose chunks are stored; none before it joins.
    pub fn actor_incarnation(&self, actor: u32) -> Option<u64> {
        self.actors.current_incarnation(actor)
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
            _ if self.limiter.all_in() => Some(InsertReply::Finished {
                inserted_total: self.inserted_total(),
            }),
            Verdict::OutOfOrder { .. } if self.actors.insists(&chunk.header) => None,
            Verdict::OutOfOrder { expected } => Some(InsertReply::OutOfOrder { expected }),
            Verdict::Next => None,
        }
    }

    /// Stores a chunk that [`Replay::settle`] has nothing to say of, if the limiter lets it pass or its actor leaves; else the
    /// answer is to wait.
    pub fn admit(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        if self.may_admit(&packed.chunk.header) {
            self.store(packed);
            self.stored()
        } else {
            self.wait()
        }
    }

    /// Whether the limiter lets a chunk pass now, or its actor leaves.
    pub(crate) fn may_admit(&self, header: &ChunkHeader) -> bool {
        self.limiter.may_insert() || self.starving || header.leaving
    }

    /// The answer to a chunk that is not stored yet.
    pub(crate) const fn wait(&self) -> InsertReply {
        InsertReply::Wait {
            inserted_total: self.inserted_total(),
            kept: false,
        }
    }

    pub(crate) fn stored(&self) -> InsertReply {
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

    pub(crate) fn unfit(&self, chunk: &Chunk) -> Option<String> {
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
        let count = header.first_transition.checked_add(transitions);
        if header.sequence == u64::MAX || count.is_none_or(|count| count > TRANSITIONS_MAX) {
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

    /// Stores a chunk that is the next of its actor.
    pub(crate) fn store(&mut self, packed: &PackedChunk<'_>) {
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
            let (link, first) = (stream.link, self.ring.inserted());
            stream.link = self.ring.push_run(frames, rows.clone().map(step), link);
            if let Some(priorities) = &mut self.priorities {
                priorities.stored(&self.ring, &self.episodes, first, link);
            }
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
        if lost == 0 && duplicated == 0 {
            return;
        }
        self.statistics.differences += 1;
        // Whoever sends nonsense could make the line come at any rate.
        if self.statistics.differences.is_power_of_two() && !self.quiet {
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
                None
            }
            Err(why) => {
                self.note_refused_message();
                Some(why)
            }
        }
    }

    /// Who is to be forgotten so that an actor has room, if a run's number of them is reached: those that never sent a chunk and of
    /// which `is_connected` says that their life is gone, as somebody who joins under one number after the other leaves behind.
    pub(crate) fn absent_actors(&self, is_connected: impl Fn(u32, u64) -> bool) -> Vec<u32> {
        self.actors.absent(is_connected)
    }

    /// Forgets these actors.
    pub(crate) fn forget_actors(&mut self, actors: &[u32]) {
        self.actors.forget(actors);
    }
}
