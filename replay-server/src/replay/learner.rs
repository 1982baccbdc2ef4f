//! The learner of a replay, and the batches that are served to it.
//! `sampling` draws and assembles the rows.

use driml_protocol::{
    AffinityUpdate, Batch, BatchHeader, Buffer, LearnerJoin, LearnerProgress, NotReady,
    PriorityUpdate, RequestId, Waiting,
};

use super::{Replay, VERSION_AHEAD_MAX};
use crate::{
    config,
    ledger::requests::LastRequests,
    persist::snapshot::{COUNT_MAX, ProcessEvent},
    sampling::{batch::PackedBatch, rows::PriorityCounts},
};

/// The learner, its progress and the data it sends.
impl Replay {
    /// Admits a learner; from now on only this learner is served. Its count of learned rows is decisive: rows served beyond it count as not
    /// sampled. An empty replay continues the counts of the learner's checkpoint, and refills before it samples the next row. Returns the
    /// number of updates that the learner repeats.
    ///
    /// # Errors
    /// Another learner has learned in this run, and this one has no checkpoint of it, or has impossible counts. The text says what to do.
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
            // The learner did not receive the reply and retries.
            Some(known) if known.learner == join.learner => return Ok(0),
            Some(known) if known.run == join.run || join.restart => {}
            Some(_) if done == 0 && join.updates == 0 => {}
            Some(_) if done == 0 => {
                return Err(format!(
                    "another learner has begun this run anew, and this learner has a checkpoint after {} updates: start the replay server \
                     again without its stored replay (another --replay-dir), then the actors and this learner",
                    join.updates
                ));
            }
            Some(_) => {
                return Err(format!(
                    "the run has learned {done} updates, and the learner has no checkpoint of it: start the learner with the --run-dir \
                     that holds its checkpoints, or with --restart to begin again from the first update"
                ));
            }
            None => self.resume_counts_if_empty(&join),
        }
        let learned = join.counts.rows_sampled;
        let unlearned = self.counts().rows_sampled.saturating_sub(learned);
        let repeated_updates = done.saturating_sub(join.updates);
        self.limiter.counts.this_shard.rows_sampled = learned;
        self.limiter.counts.other_shards = join.other_shards;
        let state = &mut self.state;
        state.statistics.counted.rows_unlearned += unlearned;
        state.statistics.counted.updates_relearned += repeated_updates;
        state.learned = LearnerProgress {
            updates: join.updates,
            saved_updates: join.updates,
            rows_received: learned,
        };
        state.learner = Some(join);
        state.affinity.from_another = true;
        self.awaits_row_count = false;
        self.requests = LastRequests::default();
        self.append_to_log(ProcessEvent::LearnerJoined(join));
        Ok(repeated_updates)
    }

    /// Continues the counts of a learner's checkpoint, if nothing is stored here.
    fn resume_counts_if_empty(&mut self, join: &LearnerJoin) {
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
        // `RateLimiter::resume_with_refill` needs the counts of all shards to decide whether the run still has rows to sample.
        self.limiter.counts.other_shards = join.other_shards;
        self.limiter
            .resume_with_refill(join.counts, refill, self.batch_size);
        self.state.resumed_after = join.updates;
        self.state.set_rng_stream(self.origin.shard, join.updates);
    }

    /// Returns the learner that is served.
    pub fn learner_id(&self) -> Option<u64> {
        self.state.learner.map(|it| it.learner)
    }

    /// Returns the updates done when the run was resumed without its replay; 0 if it never was, or before its learner has joined.
    pub const fn resumed_after_updates(&self) -> u64 {
        self.state.resumed_after
    }

    /// Takes the learner's progress. If the learner has saved a checkpoint, a replay on disk begins a new segment with a snapshot.
    pub fn set_progress(&mut self, learned: LearnerProgress) -> Result<(), String> {
        let (updates, rows) = (learned.updates, learned.rows_received);
        if updates.max(learned.saved_updates).max(rows) > COUNT_MAX {
            return Err(format!(
                "a learner with {updates} updates and {rows} rows, counts that no run reaches"
            ));
        }
        let rows_sampled = &mut self.limiter.counts.this_shard.rows_sampled;
        if std::mem::take(&mut self.awaits_row_count) {
            *rows_sampled = rows;
        } else if self.state.actors.restored {
            // The learner may count a batch from before the restart only after its first request. Too low a count would let it learn more
            // than the replay ratio allows; this one is never too high, as the learner receives only what was served.
            *rows_sampled = rows.max(*rows_sampled);
        }
        // A request may overtake another.
        if updates >= self.state.learned.updates {
            let has_saved = learned.saved_updates > self.state.learned.saved_updates;
            self.state.learned = learned;
            if has_saved {
                self.begin_segment();
            }
        }
        Ok(())
    }

    /// Notes that the learner has finished the run after `updates` updates: no transition is wanted any more.
    pub(crate) fn end_run(&mut self, updates: u64) {
        let done = &mut self.state.learned.updates;
        *done = updates.min(COUNT_MAX).max(*done);
        self.limiter.is_run_over = true;
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

    /// Sets the priorities of rows that this shard drew; those of other shards are ignored. A repeated update changes nothing, nor does a
    /// row whose transition has been overwritten: both are counted.
    ///
    /// # Errors
    /// The run draws uniformly, or a transition was never stored; the reason, for a person. In these cases nothing has changed.
    pub fn set_priorities(&mut self, update: &PriorityUpdate) -> Result<(), String> {
        let rows = &mut self.sampler.rows;
        rows.set_priorities(&self.ring, update, self.origin)
    }

    /// Returns what became of the priorities received; `None` if rows are drawn uniformly.
    pub fn priority_counts(&self) -> Option<PriorityCounts> {
        self.sampler.rows.priority_counts()
    }
}

/// The batches that are served to the learner.
impl Replay {
    /// Makes a batch: [`Replay::draw`] and [`PackedBatch::unpack`] in one.
    pub fn sample(&mut self, rows: u32) -> Result<Batch, NotReady> {
        self.draw(rows, Buffer::zeroed).map(PackedBatch::unpack)
    }

    /// Draws a batch for request `id`, as [`Replay::draw`] does. Rows that an earlier attempt of this request was given did not arrive, and
    /// no longer count as sampled.
    ///
    /// # Errors
    /// As [`Replay::draw`]; a request that its client has given up is told to wait.
    pub fn draw_for(
        &mut self,
        id: RequestId,
        rows: u32,
        alloc: impl FnOnce(usize) -> Buffer,
    ) -> Result<PackedBatch, NotReady> {
        let Some(lost) = self.requests.begin(id) else {
            return Err(NotReady::Wait(self.limiter.waiting(rows)));
        };
        if !lost.is_empty() {
            tracing::warn!("a batch of {} rows did not reach the learner", lost.len());
            self.limiter.refund(lost.len() as u64);
            self.state.statistics.refund(&lost);
        }
        let batch = self.draw(rows, alloc)?;
        self.requests.complete(id.client_id, batch.ks.clone());
        Ok(batch)
    }

    /// Draws a batch of `rows` rows, or returns why there is none. Anchors are drawn with replacement by the rule of `replay.sampling`.
    /// Compressed frames are unpacked later by [`PackedBatch::unpack`], which does not need the replay. `alloc` returns a buffer of the
    /// given size; the finished batch overwrites all of it.
    ///
    /// # Errors
    /// The client has to wait, as the limiter has no credit or no anchor is valid; the run is over; or such a batch can never be served.
    pub fn draw(
        &mut self,
        rows: u32,
        alloc: impl FnOnce(usize) -> Buffer,
    ) -> Result<PackedBatch, NotReady> {
        let rows_max = config::rows_max(&self.spec, &self.config.sampling);
        let rows_max = rows_max.min(self.limiter.rows_max());
        if rows == 0 || rows > rows_max {
            self.counters_mut().messages_refused += 1;
            let why = format!(
                "a batch of {rows} rows; this run serves 1 to {rows_max}: change the batch size, or raise slack_transitions"
            );
            return Err(NotReady::Refused { why });
        }
        if self.limiter.is_finished(rows) {
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
            ..BatchHeader::largest(&self.spec, rows)
        };
        let state = &mut self.state;
        let (affinity, rng) = (&state.affinity, &mut state.rng);
        let drawn = self.sampler.draw(&self.ring, affinity, rng, header, alloc);
        let Some(mut drawn) = drawn else {
            state.starving = true;
            if self.limiter.all_stored() {
                let why = format!(
                    "none of the {held} transitions held can be sampled, and no more will come: every environment needs n_step or k_max consecutive ones; raise replay.capacity_transitions or --frames, or use fewer --envs"
                );
                return Err(NotReady::Refused { why });
            }
            return Err(NotReady::Wait(Waiting::LearnerWaitsForActors));
        };
        self.limiter.count_sampled(rows);
        drawn.batch.header.counts = self.limiter.counts();
        state.statistics.counted.mean_age = drawn.batch.header.mean_age;
        state.statistics.count_served(&drawn.ks);
        state.starving = false;
        Ok(drawn)
    }
}
