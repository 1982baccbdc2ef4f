//! The replay and its log: every change goes to both, and nobody hears of one that is not on disk.
//! What a change is, is the replay's business; how it is written, the journal's.

use std::{borrow::Cow, collections::VecDeque, ops::Deref};

use driml_protocol::{
    ActorJoin, AffinityUpdate, Batch, Buffer, Chunk, Claim, CodecError, Goodbye, InsertReply,
    LogStatus, PriorityUpdate, RequestId, Tally, codec,
};

use super::{
    error::DurableError,
    folder::LogFolder,
    journal::Journal,
    segment::{DurableState, Mark},
};
use crate::{
    replay::{
        Replay, Unready,
        events::{Drawn, Event},
    },
    sampling::{packed_batch::PackedBatch, prioritised::SavedPriorities},
    storage::frame_store::{PackedChunk, Packer},
};

/// Marks that hold: if the newest is of a checkpoint that was not written whole, the one before it is wanted.
const MARKS: usize = 2;

/// A replay and, if it is kept on disk, its log. Whatever changes the replay goes through this.
pub struct DurableReplay {
    replay: Replay,
    /// The learner that is served.
    learner: Option<u64>,
    after_updates: u64,
    log: Option<Log>,
}

/// The log of a replay.
pub(super) struct Log {
    journal: Journal,
    spec_hash: u64,
    /// The last two marks that were not given up, the newest last.
    marks: VecDeque<Marked>,
    _folder: LogFolder,
}

/// A moment to which a replay can go back: what it needs stays in the log.
#[derive(Clone, Copy, Debug)]
pub(super) struct Marked {
    pub(super) mark: Mark,
    /// The oldest transition that was held.
    pub(super) oldest_row: u64,
}

impl Deref for DurableReplay {
    type Target = Replay;

    fn deref(&self) -> &Replay {
        &self.replay
    }
}

impl Log {
    /// The log that `journal` writes in `folder`, which it keeps others out of.
    pub(super) const fn new(journal: Journal, spec_hash: u64, folder: LogFolder) -> Self {
        Self {
            journal,
            spec_hash,
            marks: VecDeque::new(),
            _folder: folder,
        }
    }

    /// The same, to whose beginning `marked` belongs.
    pub(super) fn marked(mut self, marked: Option<Marked>) -> Self {
        self.marks.extend(marked);
        self
    }

    /// Removes the segments that neither the ring nor a mark needs.
    fn prune(&mut self, oldest_row: u64) {
        let Some(first) = self.marks.front() else {
            return self.journal.prune(oldest_row, u64::MAX);
        };
        self.journal
            .prune(oldest_row.min(first.oldest_row), first.mark.segment());
    }
}

impl DurableReplay {
    /// A replay that is kept in memory alone, and goes on after so many updates.
    pub const fn in_memory(replay: Replay, after_updates: u64) -> Self {
        Self {
            replay,
            learner: None,
            after_updates,
            log: None,
        }
    }

    /// A replay whose log is open.
    pub(super) const fn with_log(
        replay: Replay,
        log: Log,
        learner: Option<u64>,
        after_updates: u64,
    ) -> Self {
        Self {
            replay,
            learner,
            after_updates,
            log: Some(log),
        }
    }

    /// [`Replay::with_incarnation`].
    #[must_use]
    pub fn with_incarnation(mut self, incarnation: u64) -> Self {
        self.replay = self.replay.with_incarnation(incarnation);
        self
    }

    /// Counts the rows of a checkpoint after `updates` as served, if the log does not know of them: the disk lost their records.
    pub(super) fn catch_up(&mut self, updates: u64, batch_size: u32, shards: u32) {
        let learned = updates.saturating_mul(batch_size.into());
        let rows = learned.saturating_sub(self.replay.tally().rows_sampled);
        if rows > 0 && shards == 1 {
            tracing::warn!(
                "the learner has learned from {rows} rows more than the log in the replay's folder knows of: they count as served"
            );
            self.replay.count_served_before(rows);
            self.log_event(|| Event::ServedBefore { rows });
        }
    }

    /// Prepares chunks for this replay; it can do so while the replay is in use elsewhere.
    pub fn packer(&self) -> Packer {
        Packer {
            seal_for: self.log.as_ref().map(|log| log.spec_hash),
            ..self.replay.packer()
        }
    }

    /// Whether it is kept on disk.
    pub const fn is_durable(&self) -> bool {
        self.log.is_some()
    }

    /// Bytes of the log; 0 without one.
    pub fn log_bytes(&self) -> u64 {
        self.log.as_ref().map_or(0, |log| log.journal.bytes())
    }

    /// How the log stands; none without one.
    pub fn log_status(&self) -> Option<LogStatus> {
        self.log.as_ref().map(|log| log.journal.status())
    }

    /// The learner that is served.
    pub const fn learner(&self) -> Option<u64> {
        self.learner
    }

    /// Updates after which the run went on when this replay was begun.
    pub const fn after_updates(&self) -> u64 {
        self.after_updates
    }

    /// Whether everything is on disk that was to be: while it is not, nobody is told anything.
    pub fn is_ready(&mut self) -> bool {
        self.log.as_mut().is_none_or(|log| log.journal.is_ready())
    }

    /// Whether a chunk or an event could not be written the last time.
    pub fn is_refused_by_disk(&self) -> bool {
        self.log
            .as_ref()
            .is_some_and(|log| log.journal.is_failing())
    }

    /// All that a restart brings back beside the transitions, as bytes that are the same where it is. For tests.
    ///
    /// # Errors
    /// A state over the codec's limit.
    pub fn state_bytes(&self) -> Result<Vec<u8>, CodecError> {
        codec::encode_value(&DurableState {
            replay: self.replay.snapshot_of_changes(),
            learner: self.learner,
            after_updates: self.after_updates,
        })
    }

    /// Flushes what was written to the disk: nothing more is to come.
    pub fn flush(&mut self) {
        if let Some(log) = &mut self.log {
            log.journal.flush();
        }
    }

    /// Writes down what has just happened.
    fn log_event(&mut self, event: impl FnOnce() -> Event) {
        if let Some(log) = &mut self.log
            && let Err(e) = log.journal.append_event(&event())
        {
            // A value over the codec's limit.
            tracing::error!("an event cannot be written to the replay's log: {e}");
        }
        self.tidy();
    }

    /// Begins another segment when one is full, and removes those that are not needed any more.
    pub(super) fn tidy(&mut self) {
        let Some(log) = &mut self.log else {
            return;
        };
        if log.journal.is_full() {
            if let Some(oldest) = log.journal.over_budget() {
                self.replay.forget_before(oldest);
                if let Err(e) = log.journal.append_event(&Event::Forgotten { oldest }) {
                    tracing::error!("an event cannot be written to the replay's log: {e}");
                }
                log.prune(self.replay.oldest_row());
            }
            let state = state_of(&self.replay, self.learner, self.after_updates);
            if let Err(e) = log.journal.rotate(state) {
                tracing::error!("a segment of the replay's log cannot be begun: {e}");
            }
        }
        log.prune(self.replay.oldest_row());
    }

    /// Marks this moment in the log, on the disk. The log can be opened there again, also after it went on: then all of the
    /// replay is as it is now, to the last bit. The last two marks hold, without those that were given up.
    ///
    /// # Errors
    /// A disk that refuses.
    pub fn mark(&mut self) -> Result<Option<Mark>, DurableError> {
        let Some(log) = &mut self.log else {
            return Ok(None);
        };
        let state = state_of(&self.replay, self.learner, self.after_updates);
        let oldest_row = state.replay.oldest;
        let mark = log.journal.mark(state)?;
        if log.marks.len() == MARKS {
            log.marks.pop_front();
        }
        log.marks.push_back(Marked { mark, oldest_row });
        log.prune(self.replay.oldest_row());
        Ok(Some(mark))
    }

    /// Nothing will go back to `mark`, as the checkpoint that was to name it could not be saved: it does not take the place of one
    /// to which a checkpoint goes back.
    pub fn give_up_mark(&mut self, mark: Mark) {
        if let Some(log) = &mut self.log {
            log.marks.retain(|it| it.mark != mark);
        }
    }

    /// [`Replay::sample`], of which the log learns with the next mark: for whoever goes back to marks alone.
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn sample_between_marks(&mut self, rows: u32) -> Result<Batch, Unready> {
        self.replay.sample(rows)
    }

    /// [`Replay::insert`].
    pub fn insert(&mut self, chunk: &Chunk) -> InsertReply {
        self.insert_packed(&self.packer().pack(Cow::Borrowed(chunk)))
    }

    /// [`Replay::join_actor`].
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn join_actor(&mut self, join: ActorJoin) -> Result<u32, String> {
        let before = self.replay.actor_incarnation(join.actor);
        let joined = self.replay.join_actor(join)?;
        if before != Some(join.incarnation) {
            self.log_event(|| Event::ActorJoined(join));
        }
        Ok(joined)
    }

    /// [`Replay::insert_packed`].
    pub fn insert_packed(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        self.settle(packed).unwrap_or_else(|| self.admit(packed))
    }

    /// [`Replay::settle`]. While the disk refuses, nothing is said to be stored.
    pub fn settle(&mut self, packed: &PackedChunk<'_>) -> Option<InsertReply> {
        let reply = self.replay.settle(packed)?;
        if matches!(reply, InsertReply::Stored { .. }) && !self.is_ready() {
            return Some(self.replay.wait());
        }
        Some(reply)
    }

    /// [`Replay::admit`], on disk before in memory; while the disk refuses, the answer is to wait.
    pub fn admit(&mut self, packed: &PackedChunk<'_>) -> InsertReply {
        if !self.replay.may_admit(&packed.chunk.header) {
            return self.replay.wait();
        }
        if let Some(log) = &mut self.log {
            let head = match &packed.sealed {
                Some(Ok(head)) => Ok(Some(head)),
                Some(Err(e)) => Err(e.to_string()),
                None => Ok(None),
            };
            let written = head.and_then(|head| match head {
                Some(head) => Ok(log.journal.append_chunk(head, packed.chunk.payload())),
                None => packed
                    .chunk
                    .seal(log.spec_hash)
                    .map(|(head, payload)| log.journal.append_chunk(&head, payload))
                    .map_err(|e| e.to_string()),
            });
            match written {
                Ok(true) => {}
                Ok(false) => return self.replay.wait(),
                Err(why) => return InsertReply::Refused { why },
            }
        }
        self.replay.store(packed);
        self.tidy();
        self.replay.stored()
    }

    /// [`Replay::claim`]. While the disk refuses, nothing is said to be stored.
    pub fn claim(&mut self, claim: &Claim) -> Option<InsertReply> {
        let reply = self.replay.claim(claim)?;
        if matches!(reply, InsertReply::Stored { .. }) && !self.is_ready() {
            return Some(self.replay.wait());
        }
        Some(reply)
    }

    /// Makes room for an actor if a run's number of them is reached: forgets those that never sent a chunk and of which
    /// `is_connected` says that their life is gone.
    pub fn forget_absent_actors(&mut self, is_connected: impl Fn(u32, u64) -> bool) {
        let absent = self.replay.absent_actors(is_connected);
        if !absent.is_empty() {
            self.replay.forget_actors(&absent);
            self.log_event(|| Event::ActorsForgotten(absent));
        }
    }

    /// [`Replay::goodbye`].
    pub fn goodbye(&mut self, goodbye: &Goodbye) -> Option<String> {
        let refused = self.replay.goodbye(goodbye);
        if refused.is_none() {
            self.log_event(|| Event::Goodbye(*goodbye));
        }
        refused
    }

    /// [`Replay::learner_starts`] for `learner`, which is served from now on.
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn learner_starts(&mut self, learner: u64, rows_sampled: u64) -> Result<(), String> {
        self.replay.learner_starts(rows_sampled)?;
        self.learner = Some(learner);
        self.log_event(|| Event::LearnerStarted {
            learner,
            rows_sampled,
        });
        Ok(())
    }

    /// [`Replay::draw_for`]. While the disk refuses, the answer is to wait.
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn draw_for(
        &mut self,
        id: RequestId,
        rows: u32,
        memory: impl FnOnce(usize) -> Buffer,
    ) -> Result<PackedBatch, Unready> {
        if !self.is_ready() {
            return Err(Unready::Wait(self.replay.waiting()));
        }
        let before = self.replay.draw_point();
        let drawn = self.replay.draw_for(id, rows, memory);
        let after = self.replay.draw_point();
        if self.log.is_some() && after != before {
            let (ks, mean_age) = match &drawn {
                Ok(batch) => (batch.ks.clone(), batch.batch.header.mean_age),
                Err(_) => (Vec::new(), 0.0),
            };
            self.log_event(|| {
                Event::Drawn(Drawn {
                    id,
                    ks,
                    mean_age,
                    after,
                })
            });
            if drawn.is_ok() && !self.is_ready() {
                // It was given and will not arrive: the learner asks again, and then it is taken back.
                return Err(Unready::Wait(self.replay.waiting()));
            }
        }
        drawn
    }

    /// [`Replay::set_affinity`].
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn set_affinity(&mut self, update: &AffinityUpdate) -> Result<(), CodecError> {
        self.replay.set_affinity(update)?;
        self.log_event(|| Event::Affinity(update.clone()));
        Ok(())
    }

    /// [`Replay::set_priorities`]. The log knows nothing of priorities: after a recovery each transition has the highest one.
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn set_priorities(&mut self, update: &PriorityUpdate) -> Result<(), String> {
        self.replay.set_priorities(update)
    }

    /// [`Replay::restore_priorities`].
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn restore_priorities(&mut self, saved: Option<&SavedPriorities>) -> Result<(), String> {
        self.replay.restore_priorities(saved)
    }

    /// [`Replay::set_other_shards`].
    ///
    /// # Errors
    /// Those of the replay's own function.
    pub fn set_other_shards(&mut self, other_shards: Tally) -> Result<(), String> {
        let before = self.replay.other_shards();
        self.replay.set_other_shards(other_shards)?;
        let after = self.replay.other_shards();
        if after != before {
            self.log_event(|| Event::OtherShards(after));
        }
        Ok(())
    }

    /// [`Replay::note_refused_message`].
    pub fn note_refused_message(&mut self) {
        self.replay.note_refused_message();
    }

    /// [`Replay::note_recorded`].
    pub fn note_recorded(&mut self, episodes: u64) {
        self.replay.note_recorded(episodes);
    }

    /// [`Replay::note_learner_waited`].
    pub fn note_learner_waited(&mut self, seconds: f64) {
        self.replay.note_learner_waited(seconds);
    }

    /// [`Replay::note_actors_waited`].
    pub fn note_actors_waited(&mut self, seconds: f64) {
        self.replay.note_actors_waited(seconds);
    }

    /// [`Replay::set_actors`].
    pub fn set_actors(&mut self, actors: u32) {
        self.replay.set_actors(actors);
    }
}

/// All of a replay but its transitions.
fn state_of(replay: &Replay, learner: Option<u64>, after_updates: u64) -> DurableState {
    DurableState {
        replay: replay.snapshot(),
        learner,
        after_updates,
    }
}
