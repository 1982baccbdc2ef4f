//! The learner of a replay, and the batches that it is served.
//! How rows are drawn and put together is for `sampling`.

use driml_protocol::{
    AffinityUpdate, Batch, BatchHeader, Buffer, Learned, LearnerJoin, NotReady, PriorityUpdate,
    RequestId, Waiting,
};

use super::{Replay, VERSION_AHEAD_MAX};
use crate::{
    config,
    ledger::requests::Requests,
    persist::snapshot::{COUNT_MAX, Note},
    sampling::{batch::PackedBatch, rows::PriorityCounts},
};

/// Who learns, and what it says it has learned.
impl Replay {
    /// Serves this learner from now on, and it alone. How many rows were learned is what it says: what was served beyond them counts as
    /// not sampled. A replay that is empty counts on from where its checkpoint stands, and fills again before the next row is sampled.
    /// Gives the number of updates that are learned again.
    ///
    /// # Errors
    /// Another learner has learned in this run, and this one has no checkpoint of it; what to do, for a person.
    pub fn join_learner(&mut self, join: LearnerJoin) -> Result<u64, String> {
        let counted = join.counts + join.other_shards;
        if join.updates.max(counted.inserted).max(counted.rows_sampled) > COUNT_MAX {
            return Err(format!(
                "a learner after {} updates, {:?} and {:?}: counts that no run reaches",
                join.updates, join.counts, join.other_shards
            ));
        }
        let done = self.state.learned.updates;
        match self.state.learner {
            // It did not receive the answer.
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
        let learned = join.counts.rows_sampled;
        let unlearned = self.counts().rows_sampled.saturating_sub(learned);
        let again = done.saturating_sub(join.updates);
        self.limiter.refund(unlearned);
        self.limiter.counts.this_shard.rows_sampled = learned;
        self.limiter.counts.other_shards = join.other_shards;
        let state = &mut self.state;
        state.statistics.counted.rows_unlearned += unlearned;
        state.statistics.counted.updates_relearned += again;
        state.learned = Learned {
            updates: join.updates,
            saved_updates: join.updates,
            rows_received: learned,
        };
        state.learner = Some(join);
        state.affinity.expect_another_source();
        self.awaits_learner = false;
        self.requests = Requests::default();
        self.note(Note::LearnerJoined(join));
        Ok(again)
    }

    /// Counts on from a learner's checkpoint, if nothing is stored here.
    fn resume_empty(&mut self, join: &LearnerJoin) {
        if join.updates == 0 || self.ring.inserted() > 0 {
            return;
        }
        let config = &self.config;
        let stored = (join.counts + join.other_shards).inserted;
        let refill = config.refill_transitions.min(stored);
        let refill = refill
            .min(config.capacity_transitions)
            .max(config.warmup_transitions);
        let refill = refill.div_ceil(config.shards.into());
        // All shards' credit decides whether anything is left to fill it for.
        self.limiter.counts.other_shards = join.other_shards;
        self.limiter
            .resume_empty(join.counts, refill, self.batch_size);
        self.state.resumed_after = join.updates;
        self.state.draw_anew(self.origin.shard, join.updates);
    }

    /// The learner that is served.
    pub fn learner(&self) -> Option<u64> {
        self.state.learner.map(|it| it.learner)
    }

    /// Updates after which the run was resumed without its replay; 0 if it never was, or before its learner has joined.
    pub const fn resumed_after(&self) -> u64 {
        self.state.resumed_after
    }

    /// Takes what the learner says it has done. If it has saved a checkpoint, so does a replay that is kept on disk.
    pub fn note_learned(&mut self, learned: Learned) -> Result<(), String> {
        let (updates, rows) = (learned.updates, learned.rows_received);
        if updates.max(learned.saved_updates).max(rows) > COUNT_MAX {
            return Err(format!(
                "a learner with {updates} updates and {rows} rows, counts that no run reaches"
            ));
        }
        if std::mem::take(&mut self.awaits_learner) {
            self.limiter.counts.this_shard.rows_sampled = rows;
        }
        // A request may overtake another.
        if updates >= self.state.learned.updates {
            let has_saved = learned.saved_updates > self.state.learned.saved_updates;
            self.state.learned = learned;
            if has_saved {
                self.next_segment();
            }
        }
        Ok(())
    }

    pub(crate) fn note_updates(&mut self, updates: u64) {
        let done = &mut self.state.learned.updates;
        *done = updates.min(COUNT_MAX).max(*done);
    }

    /// Takes a newer affinity matrix; one that is not newer than this learner's last is ignored.
    pub fn set_affinity(&mut self, update: &AffinityUpdate) -> Result<(), String> {
        // A version is a count of updates, each of at least one row.
        let rows = self.limiter.rows_sampled_total();
        if update.version.saturating_sub(rows) > VERSION_AHEAD_MAX {
            return Err(format!(
                "version {} of the affinity, in a run that has served {rows} rows",
                update.version
            ));
        }
        let affinity = &mut self.state.affinity;
        affinity.update(update).map_err(|e| e.to_string())
    }

    /// Takes the priorities of rows that were drawn here; those of other shards are none of its business. An update that has come
    /// before changes nothing, nor does a row whose transition was overwritten meanwhile: both are counted.
    ///
    /// # Errors
    /// A run that draws uniformly, or a transition that was never stored; the reason, for a person. Nothing has then changed.
    pub fn set_priorities(&mut self, update: &PriorityUpdate) -> Result<(), String> {
        self.sampler.rows.update(&self.ring, update, self.origin)
    }

    /// What became of the priorities that came; none where rows are drawn uniformly.
    pub fn priority_counts(&self) -> Option<PriorityCounts> {
        self.sampler.rows.priority_counts()
    }
}

/// The batches that it is served.
impl Replay {
    /// Makes a batch: [`Replay::draw`] and [`PackedBatch::unpack`] in one.
    pub fn sample(&mut self, rows: u32) -> Result<Batch, NotReady> {
        self.draw(rows, Buffer::zeroed).map(PackedBatch::unpack)
    }

    /// [`Replay::draw`] for request `id`. What an earlier attempt at this request was given did not arrive: from now on it does not
    /// count as sampled.
    ///
    /// # Errors
    /// As [`Replay::draw`]; a request that its client has given up is told to wait.
    pub fn draw_for(
        &mut self,
        id: RequestId,
        rows: u32,
        memory: impl FnOnce(usize) -> Buffer,
    ) -> Result<PackedBatch, NotReady> {
        let Some(lost) = self.requests.begin(id) else {
            return Err(NotReady::Wait(self.limiter.waiting(rows)));
        };
        if !lost.is_empty() {
            tracing::warn!("a batch of {} rows did not reach the learner", lost.len());
            self.limiter.refund(lost.len() as u64);
            self.state.statistics.refund(&lost);
        }
        let draft = self.draw(rows, memory)?;
        self.requests.complete(id.client_id, draft.ks.clone());
        Ok(draft)
    }

    /// A batch of `rows` rows, anchors drawn with replacement by the rule of `replay.sampling`, or why there is none. With
    /// compression its frames are left to be unpacked, which needs the replay no more. `memory` gives so many bytes, all of which are
    /// written by then.
    ///
    /// # Errors
    /// The limiter or the lack of any valid anchor asks to wait; the run is over; `rows` can never be served.
    pub fn draw(
        &mut self,
        rows: u32,
        memory: impl FnOnce(usize) -> Buffer,
    ) -> Result<PackedBatch, NotReady> {
        let rows_max = config::rows_max(&self.spec, &self.config.sampling);
        let rows_max = rows_max.min(self.limiter.rows_max());
        if rows == 0 || rows > rows_max {
            self.counted().messages_refused += 1;
            let why = format!(
                "a batch of {rows} rows; this run serves 1 to {rows_max}: change the batch size, or raise slack_transitions"
            );
            return Err(NotReady::Refused { why });
        }
        if self.limiter.finished(rows) {
            return Err(NotReady::Finished);
        }
        if !self.limiter.may_sample(rows) {
            return Err(NotReady::Wait(self.limiter.waiting(rows)));
        }
        let is_prioritised = self.config.sampling.is_prioritised();
        let held = self.ring.inserted() - self.ring.oldest();
        let header = BatchHeader {
            held,
            origin: is_prioritised.then_some(self.origin),
            ..BatchHeader::of(&self.spec, rows)
        };
        let state = &mut self.state;
        let (affinity, rng) = (&state.affinity, &mut state.rng);
        let drawn = self.sampler.draw(&self.ring, affinity, rng, header, memory);
        let Some(mut drawn) = drawn else {
            if self.limiter.all_in() {
                let why = format!(
                    "none of the {held} transitions held can be sampled, and no more will come: every environment needs n_step or k_max consecutive ones; raise capacity_transitions or transitions_max, or use fewer environments"
                );
                return Err(NotReady::Refused { why });
            }
            state.starving = true;
            return Err(NotReady::Wait(Waiting::LearnerWaitsForActors));
        };
        self.limiter.sampled(rows);
        drawn.batch.header.counts = self.limiter.counts();
        state.statistics.counted.mean_age = drawn.batch.header.mean_age;
        state.statistics.served(&drawn.ks);
        state.starving = false;
        Ok(drawn)
    }
}
