//! Batches on their way out: whether one may be served, its rows, and what becomes of one that did not arrive.
//! The rules of the return, of the anchors and of k are those of `sampling`.

use driml_protocol::{
    AffinityUpdate, Batch, BatchHeader, Buffer, CodecError, RequestId, Tally, Waiting,
};

use super::{Replay, Unready};
use crate::{
    config,
    ledger::requests::{Dedup, Requests},
    sampling::{
        assemble::RowStates,
        needed_frames::NeededFrames,
        packed_batch::{PackedBatch, PackedFrames},
    },
};

/// How far the version of an affinity matrix may be ahead of the rows served, of which a replay that was started anew may not
/// know all.
const VERSION_AHEAD_MAX: u64 = 1 << 32;

impl Replay {
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
        self.limiter.refund(unlearned);
        self.statistics.rows_unlearned += unlearned;
        self.requests = Requests::default();
        self.affinity.expect_another_source();
        Ok(())
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
            if !self.draw_anchor() {
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
        if let Some(priorities) = &self.priorities {
            // All by the masses that are there now: to find that one was no anchor any more makes the others more likely.
            let chance = |index| (priorities.chance(index) as f32).clamp(f32::MIN_POSITIVE, 1.0);
            let drawn = states.iter().map(RowStates::anchor);
            batch.set_draws(drawn.map(|index| (index, chance(index))));
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

    /// Leaves the window of an anchor in `self.window`; false if there is none.
    fn draw_anchor(&mut self) -> bool {
        let (ring, episodes) = (&self.ring, &self.episodes);
        let (rng, window) = (&mut self.rng, &mut self.window);
        match &mut self.priorities {
            None => self.anchors.draw(ring, episodes, rng, window),
            Some(priorities) => priorities.draw(ring, episodes, rng, window),
        }
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
        if !self.begin_request(id) {
            return Err(Unready::Wait(self.limiter.waiting(rows)));
        }
        let draft = self.draw_in(rows, memory)?;
        self.requests.complete(id.client_id, draft.ks.clone());
        Ok(draft)
    }

    /// Takes note of a request, and takes back what an earlier attempt at it was given; `false` if nobody waits for it any more.
    pub(crate) fn begin_request(&mut self, id: RequestId) -> bool {
        let Dedup::Fresh(lost) = self.requests.begin(id) else {
            return false;
        };
        if !lost.is_empty() {
            if !self.quiet {
                tracing::warn!("a batch of {} rows did not reach the learner", lost.len());
            }
            self.limiter.refund(lost.len() as u64);
            self.statistics.refund(&lost);
        }
        true
    }

    /// What a batch of `rows` rows says of itself before any row is written.
    pub(crate) fn batch_header(&self, rows: u32) -> BatchHeader {
        BatchHeader {
            tally: self.limiter.tally(),
            held: self.ring.inserted() - self.ring.oldest(),
            origin: self.priorities.is_some().then_some(self.origin),
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

    /// Takes what the replay's other shards have counted.
    ///
    /// # Errors
    /// More transitions than the run can ever have, or more rows than it gives for these; the reason, for a person.
    pub fn set_other_shards(&mut self, other_shards: Tally) -> Result<(), String> {
        let config = &self.config;
        // Each shard takes what its limiter allows until it hears of the others, at most what it holds.
        let most = |max: u64| max.saturating_add(config.capacity_transitions);
        if let Some(most) = config.transitions_max.map(most)
            && other_shards.inserted > most
        {
            return Err(format!(
                "the other shards are said to have stored {} transitions; this run has at most {most}",
                other_shards.inserted
            ));
        }
        // Rows are given as the replay ratio allows them, or were, before it was lowered. Of others the learner would wait for
        // transitions that never come.
        let heard = self.limiter.other_shards();
        let inserted = other_shards.inserted.max(heard.inserted);
        let inserted = inserted.saturating_add(self.limiter.tally().inserted);
        let allowed = config.replay_ratio * inserted as f64;
        let ahead = config.replay_ratio * most(config.slack_transitions) as f64;
        let most_rows = allowed.max(heard.rows_sampled as f64) + ahead;
        if other_shards.rows_sampled as f64 > most_rows {
            return Err(format!(
                "the other shards are said to have given {} rows; for {inserted} transitions a run gives at most {most_rows:.0}",
                other_shards.rows_sampled
            ));
        }
        self.limiter.set_other_shards(other_shards);
        Ok(())
    }
}
