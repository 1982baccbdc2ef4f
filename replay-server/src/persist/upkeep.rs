//! Connects a replay to its log: recovers the replay, begins segments and sets marks as the replay runs, takes and restores snapshots.
//! `journal` writes the log; `recover` reads it. A replay in memory has no log, and these methods do nothing.

use std::borrow::Cow;

use driml_protocol::{Chunk, ChunkHeader, CodecError, End, RunSpec, Shutdown, codec};

use super::{
    folder::{Mark, PersistArgs, PersistError, ReplayFolder},
    journal::Journal,
    recover::{RecoveryControl, RecoveryReport, recover, roll_back},
    snapshot::{ProcessEvent, ReplayState, Snapshot},
};
use crate::{
    config::Config,
    replay::Replay,
    storage::ring::{Link, Step},
};

impl Replay {
    /// Opens the replay of a run in a folder: restores it if it was kept there before, otherwise creates an empty one.
    pub fn open(
        args: &PersistArgs,
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
    ) -> Result<(Self, RecoveryReport), PersistError> {
        let empty = Self::shard(spec, config, batch_size, args.shard)?;
        let kept = ReplayFolder::open(args, spec, config)?;
        kept.recover(empty, &RecoveryControl::new(Shutdown::default()))
    }
}

impl ReplayFolder {
    /// Reads the log into `replay`, which must be empty.
    ///
    /// # Errors
    /// The folder cannot be read or written, nothing in it is usable, or `reading` was stopped ([`PersistError::Stopped`]). Damage alone is
    /// not an error: the rest is used, and the warnings name the losses.
    pub fn recover(
        self,
        mut replay: Replay,
        control: &RecoveryControl,
    ) -> Result<(Replay, RecoveryReport), PersistError> {
        if let Some(mark) = self.mark {
            roll_back(&self, mark)?;
        }
        let (position, recovery) = recover(&self, &mut replay, control)?;
        if !recovery.found {
            self.write_id()?;
        }
        let snapshot = replay.snapshot();
        replay.journal = Some(Journal::begin(self, position, &snapshot)?);
        replay.keep_within_disk_budget();
        Ok((replay, recovery))
    }
}

/// Writing to the log.
impl Replay {
    /// Writes events that the disk rejected before. Returns whether all are written; until then joins and `Leave`s get no reply.
    pub(crate) fn write_pending(&mut self) -> bool {
        self.journal.as_mut().is_none_or(Journal::write_pending)
    }

    /// Whether the last write to the disk failed.
    pub fn is_disk_failing(&self) -> bool {
        self.journal.as_ref().is_some_and(Journal::is_failing)
    }

    /// Marks this moment in the log, flushed to disk. The log can be opened at the mark even after it has grown, which restores the replay
    /// bit for bit. The last two marks are kept, not counting those discarded. `None` if the replay is in memory.
    pub fn mark(&mut self) -> Result<Option<Mark>, PersistError> {
        let snapshot = self.snapshot();
        let marked = self.journal.as_mut().map(|journal| journal.mark(&snapshot));
        self.prune();
        marked.transpose()
    }

    /// Discards `mark`, as its checkpoint could not be saved. So it does not displace a mark to which a saved checkpoint refers.
    pub fn discard_mark(&mut self, mark: Mark) {
        if let Some(journal) = &mut self.journal {
            journal.discard_mark(mark);
        }
    }

    pub(crate) fn append_to_log(&mut self, event: ProcessEvent) {
        if let Some(journal) = &mut self.journal {
            journal.append_event(&event);
        }
        self.rotate_and_prune();
    }

    /// Begins a new segment if the newest is full, and removes segments that are no longer needed.
    pub(crate) fn rotate_and_prune(&mut self) {
        if self.journal.as_ref().is_some_and(Journal::needs_rotation) {
            self.begin_segment();
        }
        self.prune();
    }

    /// Drops the oldest transitions, if the disk budget has no room for a whole segment more. Then removes unneeded segments.
    fn keep_within_disk_budget(&mut self) {
        let journal = self.journal.as_ref();
        if let Some(oldest) = journal.and_then(|it| it.oldest_within_budget(|| self.snapshot())) {
            self.forget_before(oldest);
        }
        self.prune();
    }

    /// Begins a new segment, for which the disk budget makes room.
    pub(crate) fn begin_segment(&mut self) {
        self.keep_within_disk_budget();
        let snapshot = self.journal.is_some().then(|| self.snapshot());
        if let (Some(journal), Some(snapshot)) = (&mut self.journal, snapshot) {
            journal.rotate(&snapshot);
        }
    }

    fn prune(&mut self) {
        let oldest = self.ring.oldest();
        self.journal.iter_mut().for_each(|it| it.prune(oldest));
    }

    fn forget_before(&mut self, oldest: u64) {
        self.ring.forget_before(oldest);
        self.sampler.rows.forget_overwritten(&self.ring);
    }
}

/// Snapshots of the state.
impl Replay {
    pub(crate) fn snapshot(&self) -> Snapshot {
        Snapshot {
            inserted: self.ring.inserted(),
            oldest: self.ring.oldest(),
            capacity: self.ring.capacity(),
            compressed_bytes_max: self.config.compressed_bytes_max,
            counts: self.limiter.counts,
            rows: self.sampler.rows.state(&self.ring),
            state: ReplayState {
                statistics: self.state.statistics.for_snapshot(),
                ..self.state.clone()
            },
        }
    }

    /// Restores a snapshot. Transitions that it counts beyond those stored are gone: they leave a gap, or an empty ring if the gap
    /// is as large as the ring. The error says why the snapshot is not of this run, for a person.
    pub(super) fn restore(&mut self, snapshot: Snapshot) -> Result<(), String> {
        snapshot.check(&self.state)?;
        let (inserted, oldest) = (snapshot.inserted, snapshot.oldest);
        let mut state = snapshot.state;
        let stored = self.ring.inserted();
        let is_empty = self.ring.first_index() == stored;
        if !is_empty && inserted < stored {
            return Err(format!(
                "a state after {inserted} transitions, where {stored} are stored"
            ));
        }
        if !is_empty && inserted > stored {
            state.actors.unlink_streams(stored);
        }
        if is_empty || inserted - stored >= self.ring.capacity() {
            self.ring.restart_at(inserted);
        } else {
            self.push_placeholders(inserted - stored);
        }
        self.forget_before(oldest);
        self.limiter.counts = snapshot.counts;
        let rows = &mut self.sampler.rows;
        rows.restore(&self.ring, oldest, &snapshot.rows);
        state.actors.restored = true;
        state.statistics.take_episodes(&mut self.state.statistics);
        self.state = state;
        Ok(())
    }

    /// Fills the places of `count` lost transitions with steps that have no links and cannot be anchors.
    fn push_placeholders(&mut self, count: u64) {
        let chunk = Chunk::zeroed(ChunkHeader {
            streams: 1,
            steps: 1,
            frame_bytes: self.spec.frame_bytes() as u32,
            ..ChunkHeader::default()
        });
        let packed = self.packer().pack(Cow::Owned(chunk));
        for _ in 0..count {
            let step = Step::new(0, 0.0, End::Running, 0);
            self.ring
                .push_steps(packed.stream_frames(0), [step].into_iter(), Link::Lost);
        }
    }

    /// Encodes the state without the transitions, for tests. Equal states give equal bytes. A mark restores all of this state.
    pub fn state_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let mut snapshot = self.snapshot();
        snapshot.state.statistics = snapshot.state.statistics.without_transient();
        codec::encode_value(&snapshot)
    }

    /// Encodes the state without transitions and draws, for tests: the part that a log restores after its server died at any moment.
    pub fn stored_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let snapshot = self.snapshot();
        let (counts, state) = (snapshot.counts, snapshot.state);
        codec::encode_value(&(
            (snapshot.inserted, snapshot.oldest, snapshot.capacity),
            (counts.this_shard.inserted, counts.refilled),
            (counts.refill_left, state.resumed_after),
            (state.actors, state.learner),
            state.statistics.without_draws(),
        ))
    }
}
