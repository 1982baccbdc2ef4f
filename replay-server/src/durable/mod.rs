//! The replay, kept on disk as it runs: after its process has died it goes on as if nothing had happened.
//! What is stored, drawn and allowed is the replay's; here is only that each change is on disk before anybody hears of it.
//!
//! The log in the folder is the replay's history: the chunks as they came and, between them, what else changed it, in the order in
//! which it happened. It lies in segments that begin with all of the replay's state but the transitions. A segment is removed once
//! all its transitions have left the ring. So the oldest segment's state, and all records since, give the replay again, and a
//! segment that is damaged costs its own transitions alone: the state of the next one is whole.
//!
//! What was answered has been written: it survives the death of the process at any moment. What was flushed, once in
//! `replay.fsync_ms`, survives a power cut too.

mod error;
mod folder;
mod journal;
mod record;
mod recovery;
mod segment;
mod sync;

use std::{
    ops::Deref,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use driml_protocol::{
    ActorJoin, AffinityUpdate, Buffer, Claim, Goodbye, InsertReply, RequestId, RunSpec, Tally,
    codec,
};

pub use error::DurableError;

use self::{
    folder::LogFolder,
    journal::{Journal, Limits},
    recovery::{Recovered, find_id, recover},
    segment::{DurableState, FORMAT, LogId},
};
use crate::{
    config::{Config, SEGMENT_BYTES_MIN},
    replay::{
        Replay, Unready,
        events::{Drawn, Event},
    },
    sampling::packed_batch::PackedBatch,
    storage::frame_store::{PackedChunk, Packer},
};

/// How often the log is flushed unless the settings say so.
const FSYNC_DEFAULT: Duration = Duration::from_secs(1);
/// Largest segment unless its size is given: small enough that little is kept beyond what the ring holds.
const SEGMENT_BYTES_MAX: u64 = 1 << 26;
/// Segments that the ring, or the disk budget, is to span at least.
const SEGMENTS: u64 = 16;

/// Where a replay is kept, and which part of the run it is.
#[derive(Clone, Debug)]
pub struct DurableArgs {
    /// The folder, for this replay alone.
    pub dir: PathBuf,
    /// Which of the replay's shards it is.
    pub shard: u32,
    /// Updates of the learner after which the run goes on; 0 starts it.
    pub after_updates: u64,
    /// Size from which a segment is followed by another, if not what suits the ring.
    pub segment_bytes: Option<u64>,
}

/// What was found in the folder.
#[derive(Clone, Debug, Default)]
pub struct Recovery {
    /// There was a replay.
    pub found: bool,
    /// Bytes of the log that were read.
    pub bytes: u64,
    /// How long that took.
    pub took: Duration,
    /// Damage, and what came of it: sentences for a person.
    pub warnings: Vec<String>,
}

/// A replay and, if it is kept on disk, its log. Whatever changes the replay goes through this.
pub struct DurableReplay {
    replay: Replay,
    /// The learner that is served.
    learner: Option<u64>,
    after_updates: u64,
    log: Option<Log>,
}

struct Log {
    journal: Journal,
    spec_hash: u64,
    _folder: LogFolder,
}

impl Deref for DurableReplay {
    type Target = Replay;

    fn deref(&self) -> &Replay {
        &self.replay
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

    /// The replay of a run that is kept in a folder: as it was, if it was kept there before, else an empty one.
    ///
    /// # Errors
    /// Settings that cannot work; a folder that cannot be written, is in use, or holds the replay of another run. Damage is no
    /// error: what is left is used, and what was lost is said.
    pub fn open(
        args: &DurableArgs,
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
    ) -> Result<(Self, Recovery), DurableError> {
        let started = Instant::now();
        let mut replay = Replay::shard(spec, config, batch_size, args.shard)?;
        let folder = LogFolder::open(&args.dir)?;
        let ours = LogId {
            format: FORMAT,
            identity: rand::random(),
            spec_hash: spec.hash(),
            shard: (args.shard, config.shards),
        };
        let known = match folder.read_id()? {
            Some(id) => Some(id),
            None => find_id(&folder)?,
        };
        let id = known.unwrap_or(ours);
        folder.check(&id, &ours)?;
        let found = match known {
            Some(id) => recover(&folder, id, spec.num_actions, &mut replay)?,
            None => None,
        };
        let mut recovery = Recovery::default();
        let (found, is_new) = match found {
            Some(found) => (found, false),
            None => {
                let next = folder.first_number()?;
                (Recovered::nothing(next, args.after_updates), true)
            }
        };
        if is_new {
            folder.write_id(&id)?;
            if args.after_updates > 0 {
                replay = replay.resumed_at(args.after_updates, args.shard);
            }
        }
        recovery.found = !is_new;
        recovery.bytes = found.bytes;
        recovery.warnings = found.warnings;
        let state = DurableState {
            replay: replay.snapshot(),
            learner: found.learner,
            after_updates: found.after_updates,
        };
        let fsync = config.fsync_ms.map_or(FSYNC_DEFAULT, Duration::from_millis);
        let journal = Journal::begin(
            journal::Place {
                folder: args.dir.clone(),
                id,
                number: found.number,
                ordinal: found.ordinal,
            },
            &found.segments,
            limits(args, spec, config),
            fsync,
            state,
        )?;
        let mut this = Self {
            replay,
            learner: found.learner,
            after_updates: found.after_updates,
            log: Some(Log {
                journal,
                spec_hash: id.spec_hash,
                _folder: folder,
            }),
        };
        this.catch_up(args.after_updates, batch_size, config.shards);
        this.tidy();
        recovery.took = started.elapsed();
        Ok((this, recovery))
    }

    /// Counts the rows of a checkpoint after `updates` as served, if the log does not know of them: the disk lost their records.
    fn catch_up(&mut self, updates: u64, batch_size: u32, shards: u32) {
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

    /// All that a restart brings back beside the transitions, as bytes that are the same where it is. For tests.
    ///
    /// # Errors
    /// A state over the codec's limit.
    pub fn state_bytes(&self) -> Result<Vec<u8>, driml_protocol::CodecError> {
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
    fn tidy(&mut self) {
        let Some(log) = &mut self.log else {
            return;
        };
        if log.journal.is_full() {
            if let Some(oldest) = log.journal.over_budget() {
                self.replay.forget_before(oldest);
                if let Err(e) = log.journal.append_event(&Event::Forgotten { oldest }) {
                    tracing::error!("an event cannot be written to the replay's log: {e}");
                }
                log.journal.prune(self.replay.oldest_row());
            }
            let state = DurableState {
                replay: self.replay.snapshot(),
                learner: self.learner,
                after_updates: self.after_updates,
            };
            if let Err(e) = log.journal.rotate(state) {
                tracing::error!("a segment of the replay's log cannot be begun: {e}");
            }
        }
        log.journal.prune(self.replay.oldest_row());
    }

    /// [`Replay::join_actor`].
    ///
    /// # Errors
    /// As there.
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
    /// As there.
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
    /// As there.
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
    /// As there.
    pub fn set_affinity(
        &mut self,
        update: &AffinityUpdate,
    ) -> Result<(), driml_protocol::CodecError> {
        self.replay.set_affinity(update)?;
        self.log_event(|| Event::Affinity(update.clone()));
        Ok(())
    }

    /// [`Replay::set_other_shards`].
    ///
    /// # Errors
    /// As there.
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

/// How large a segment is, and what all may take.
fn limits(args: &DurableArgs, spec: &RunSpec, config: &Config) -> Limits {
    let shards = u64::from(config.shards);
    let disk_bytes_max = config.disk_bytes_max.map(|max| max / shards);
    let row_bytes = spec.frame_bytes() as u64 + driml_protocol::TRANSITION_BYTES as u64;
    let ring = (config.capacity_transitions / shards).saturating_mul(row_bytes);
    let all = disk_bytes_max.map_or(ring, |max| max.min(ring));
    let fitting = (all / SEGMENTS).clamp(SEGMENT_BYTES_MIN, SEGMENT_BYTES_MAX);
    Limits {
        segment_bytes: args.segment_bytes.unwrap_or(fitting),
        disk_bytes_max,
    }
}

/// The folder of shard `shard` of `shards` in a run's `--replay-dir`.
pub(crate) fn shard_dir(dir: &Path, shard: u32, shards: u32) -> PathBuf {
    match shards {
        1 => dir.to_owned(),
        _ => dir.join(format!("shard-{shard}")),
    }
}
