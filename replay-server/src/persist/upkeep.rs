//! What a replay does with its log: snapshots, segments and marks while it runs, and taking a snapshot back.
//! How the log is written is for `journal`, how it is read for `recover`. A replay in memory has none, and does nothing here.

use std::borrow::Cow;

use driml_protocol::{Chunk, ChunkHeader, CodecError, End, ShardCounts, codec};

use super::{
    folder::{Mark, PersistError},
    journal::Journal,
    snapshot::{Note, ReplayState, Snapshot},
};
use crate::{
    replay::Replay,
    sampling::rows::RowsState,
    storage::ring::{Link, Step},
};

/// What is written, and what is reported of it.
impl Replay {
    /// Whether all notes are on disk; until then joins and `Leave`s get no answer.
    pub(crate) fn is_ready(&mut self) -> bool {
        let log = self.log.as_mut();
        log.is_none_or(Journal::is_ready)
    }

    /// Whether the disk refused what was to be written last.
    pub fn is_refused_by_disk(&self) -> bool {
        let log = self.log.as_ref();
        log.is_some_and(Journal::is_failing)
    }

    /// Marks this moment in the log, on the disk. The log can be opened there again, also after it was continued: then all of the
    /// replay is the same as now, to the last bit. The last two marks hold, without those that were given up.
    pub fn mark(&mut self) -> Result<Option<Mark>, PersistError> {
        let snapshot = self.snapshot();
        let marked = self.log.as_mut().map(|log| log.mark(&snapshot));
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

    pub(crate) fn note(&mut self, note: Note) {
        if let Some(log) = &mut self.log {
            log.append_note(&note);
        }
        self.tidy();
    }

    /// Begins another segment when one is full, and removes those that are not needed any more.
    pub(crate) fn tidy(&mut self) {
        if let Some(log) = self.log.as_ref().filter(|log| log.is_full()) {
            if let Some(oldest) = log.over_budget(|| self.snapshot()) {
                self.forget_before(oldest);
                self.prune();
            }
            self.begin_segment();
        }
        self.prune();
    }

    pub(crate) fn begin_segment(&mut self) {
        let snapshot = self.log.is_some().then(|| self.snapshot());
        if let (Some(log), Some(snapshot)) = (&mut self.log, snapshot) {
            log.rotate(&snapshot);
        }
    }

    fn prune(&mut self) {
        let oldest = self.ring.oldest();
        self.log.iter_mut().for_each(|log| log.prune(oldest));
    }

    fn forget_before(&mut self, oldest: u64) {
        self.ring.forget_before(oldest);
        self.sampler.rows.forget(&self.ring);
    }
}

/// What is read back.
impl Replay {
    /// All of it but the transitions.
    pub(crate) fn snapshot(&self) -> Snapshot {
        Snapshot {
            inserted: self.ring.inserted(),
            oldest: self.ring.oldest(),
            capacity: self.ring.capacity(),
            counts: self.limiter.counts,
            rows: self.sampler.rows.state(&self.ring),
            state: ReplayState {
                statistics: self.state.statistics.logged(),
                ..self.state.clone()
            },
        }
    }

    /// Takes back a snapshot. The transitions between what is stored and those that the snapshot knows are gone: they leave a gap, or,
    /// where it is larger than the ring, an empty ring. The error says for a person why the snapshot is not of this run.
    pub(super) fn restore(&mut self, snapshot: Snapshot) -> Result<(), String> {
        snapshot.check(&self.state)?;
        let Snapshot {
            inserted,
            oldest,
            mut state,
            ..
        } = snapshot;
        let stored = self.ring.inserted();
        let is_empty = self.ring.first() == stored;
        if !is_empty && inserted < stored {
            return Err(format!(
                "a state after {inserted} transitions, where {stored} are stored"
            ));
        }
        if !is_empty && inserted > stored {
            state.actors.cut_streams(stored);
        }
        if is_empty || inserted - stored >= self.ring.capacity() {
            self.ring.start_at(inserted);
        } else {
            self.push_gone(inserted - stored);
        }
        self.forget_before(oldest);
        self.limiter.counts = snapshot.counts;
        let rows = &mut self.sampler.rows;
        rows.restore(&self.ring, oldest, &snapshot.rows);
        state.actors.restored = true;
        let statistics = &mut state.statistics;
        statistics.keep_newest_of(&mut self.state.statistics);
        self.state = state;
        Ok(())
    }

    /// Takes the place of `count` transitions that are gone, which hang together with nothing and cannot be anchors.
    fn push_gone(&mut self, count: u64) {
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
                .push_run(packed.run(0), [step].into_iter(), Link::Lost);
        }
    }

    /// What was drawn since the last snapshot is not known: the learner says it, and other numbers are drawn from here on.
    pub(super) fn await_learner(&mut self) {
        self.awaits_learner = self.state.learner.is_some();
        let stored = self.ring.inserted();
        self.state.draw_anew(self.origin.shard, stored);
    }

    /// All but the transitions, as bytes that are the same where it is: what a mark brings back. For tests.
    pub fn state_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let mut snapshot = self.snapshot();
        snapshot.state.statistics = snapshot.state.statistics.of_changes();
        codec::encode_value(&snapshot)
    }

    /// The same without what was drawn: what a log brings back after its server died at any moment. For tests.
    pub fn stored_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let Snapshot {
            mut counts, state, ..
        } = self.snapshot();
        counts.this_shard.rows_sampled = 0;
        counts.other_shards = ShardCounts::default();
        codec::encode_value(&Snapshot {
            counts,
            rows: RowsState::Uniform { are_listed: false },
            state: ReplayState {
                actors: state.actors,
                learner: state.learner,
                resumed_after: state.resumed_after,
                inserted_before: state.inserted_before,
                statistics: state.statistics.of_stored(),
                ..ReplayState::new(&self.spec, self.origin.shard)
            },
            ..self.snapshot()
        })
    }
}
