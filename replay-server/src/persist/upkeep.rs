//! What a replay does with its log: opening its folder, snapshots, segments and marks while it runs, and taking a snapshot back.
//! How the log is written is for `journal`, how it is read for `recover`. A replay in memory has none, and does nothing here.

use std::{
    borrow::Cow,
    path::{Path, PathBuf},
    time::Duration,
};

use driml_protocol::{
    Chunk, ChunkHeader, CodecError, End, RunSpec, Shutdown, TRANSITION_BYTES, codec,
};

use super::{
    folder::{FORMAT, LogFolder, LogId, Mark, PersistError},
    journal::{Journal, LogLimits},
    recover::{Reading, Recovery, find_id, go_back, recover},
    snapshot::{Note, ReplayState, Snapshot},
};
use crate::{
    config::{Config, SEGMENT_BYTES_MIN},
    replay::Replay,
    storage::ring::{Link, Step},
};

/// How often the log is flushed unless the settings say so.
const FSYNC_DEFAULT: Duration = Duration::from_secs(1);
/// Largest segment unless its size is given: small enough that little is kept beyond what the ring holds.
const SEGMENT_BYTES_MAX: u64 = 1 << 26;
/// Segments that the ring, or the disk budget, is to span at least.
const SEGMENTS: u64 = 16;

/// Where a replay is kept, and which process of the run it is.
#[derive(Clone, Debug)]
pub struct PersistArgs {
    /// The folder, for this replay alone.
    pub dir: PathBuf,
    /// Which of the replay's shards it is.
    pub shard: u32,
    /// Size from which a segment is followed by another, if not what suits the ring.
    pub segment_bytes: Option<u64>,
    /// Go back to this mark: what the log says after it is removed.
    pub mark: Option<Mark>,
}

impl Replay {
    /// The replay of a run that is kept in a folder: as it was, if it was kept there before, else an empty one.
    pub fn open(
        args: &PersistArgs,
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
    ) -> Result<(Self, Recovery), PersistError> {
        let empty = Self::shard(spec, config, batch_size, args.shard)?;
        let kept = KeptReplay::find(args, spec, config)?;
        kept.read(empty, &Reading::begin(Shutdown::default()))
    }
}

/// The folder of a replay, which no other process uses any more and which is this run's. What is kept there is not read yet.
pub struct KeptReplay {
    mark: Option<Mark>,
    id: LogId,
    limits: LogLimits,
    folder: LogFolder,
}

impl KeptReplay {
    /// Takes the folder and looks whose replay is in it, if any: at once, however much there is.
    pub fn find(args: &PersistArgs, spec: &RunSpec, config: &Config) -> Result<Self, PersistError> {
        config.check_on_disk()?;
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
        Ok(Self {
            mark: args.mark,
            id,
            limits: limits(args, spec, config),
            folder,
        })
    }

    pub(crate) fn dir(&self) -> &Path {
        &self.folder.path
    }

    /// Reads what is kept into `replay`, which is empty.
    ///
    /// # Errors
    /// A folder that cannot be read or written; [`PersistError::Stopped`] if `reading` is told so. Damage is not an error: what is left
    /// is used, and what was lost is in the warnings.
    pub fn read(
        self,
        mut replay: Replay,
        reading: &Reading,
    ) -> Result<(Replay, Recovery), PersistError> {
        let (folder, id) = (self.folder, self.id);
        if let Some(mark) = self.mark {
            go_back(&folder, mark)?;
        }
        let (place, recovery) = recover(&folder, id, &mut replay, self.mark, reading)?;
        if !recovery.found {
            folder.write_id(&id)?;
        }
        let snapshot = replay.snapshot();
        let journal = Journal::begin(folder, id, place, self.limits, &snapshot)?;
        replay.log = Some(journal);
        replay.tidy();
        Ok((replay, recovery))
    }
}

/// How large a segment is, what all may take, and how often they are flushed.
fn limits(args: &PersistArgs, spec: &RunSpec, config: &Config) -> LogLimits {
    let shards = u64::from(config.shards);
    let disk_bytes_max = config.disk_bytes_max.map(|max| max / shards);
    let row_bytes = spec.frame_bytes() as u64 + TRANSITION_BYTES as u64;
    let ring = (config.capacity_transitions / shards).saturating_mul(row_bytes);
    let all = disk_bytes_max.map_or(ring, |max| max.min(ring));
    let fitting = (all / SEGMENTS).clamp(SEGMENT_BYTES_MIN, SEGMENT_BYTES_MAX);
    LogLimits {
        segment_bytes: args.segment_bytes.unwrap_or(fitting),
        disk_bytes_max,
        fsync: config.fsync_ms.map_or(FSYNC_DEFAULT, Duration::from_millis),
    }
}

pub(crate) fn shard_dir(dir: &Path, shard: u32, shards: u32) -> PathBuf {
    match shards {
        1 => dir.to_owned(),
        _ => dir.join(format!("shard-{shard}")),
    }
}

/// What is written, and what is reported of it.
impl Replay {
    /// Writes notes that the disk refused before; until all are written, joins and `Leave`s get no answer.
    pub(crate) fn write_pending(&mut self) -> bool {
        let log = self.log.as_mut();
        log.is_none_or(Journal::write_pending)
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
        if self.log.as_ref().is_some_and(Journal::is_full) {
            self.next_segment();
        }
        self.prune();
    }

    /// Begins another segment; where the disk budget does not allow it, the oldest transitions go first.
    pub(crate) fn next_segment(&mut self) {
        let log = self.log.as_ref();
        if let Some(oldest) = log.and_then(|log| log.over_budget(|| self.snapshot())) {
            self.forget_before(oldest);
            self.prune();
        }
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
        let (inserted, oldest) = (snapshot.inserted, snapshot.oldest);
        let mut state = snapshot.state;
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

    /// All but the transitions, as bytes that are the same where it is: what a mark brings back. For tests.
    pub fn state_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let mut snapshot = self.snapshot();
        snapshot.state.statistics = snapshot.state.statistics.of_changes();
        codec::encode_value(&snapshot)
    }

    /// The same without what was drawn: what a log brings back after its server died at any moment. For tests.
    pub fn stored_bytes(&self) -> Result<Vec<u8>, CodecError> {
        let snapshot = self.snapshot();
        let (counts, state) = (snapshot.counts, snapshot.state);
        codec::encode_value(&(
            (snapshot.inserted, snapshot.oldest, snapshot.capacity),
            (counts.this_shard.inserted, counts.refilled),
            (counts.refill_left, state.resumed_after),
            (state.actors, state.learner),
            state.statistics.of_stored(),
        ))
    }
}
