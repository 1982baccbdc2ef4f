//! Opening the folder of a replay: what is there is taken up, and a log is continued or begun.
//! Reading it back is for `recover`.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use driml_protocol::{RunSpec, Shutdown, TRANSITION_BYTES};

use super::{
    folder::{FORMAT, LogFolder, LogId, Mark, PersistError},
    journal::{Journal, LogLimits},
    recover::{Reading, Recovery, find_id, go_back, recover},
};
use crate::{
    config::{Config, SEGMENT_BYTES_MIN},
    replay::Replay,
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
        let started = Instant::now();
        let (folder, id) = (self.folder, self.id);
        if let Some(mark) = self.mark {
            go_back(&folder, mark)?;
        }
        let (place, mut recovery) = recover(&folder, id, &mut replay, self.mark, reading)?;
        if !recovery.found {
            folder.write_id(&id)?;
        }
        let snapshot = replay.snapshot();
        let journal = Journal::begin(folder, id, place, self.limits, &snapshot)?;
        replay.log = Some(journal);
        replay.tidy();
        recovery.took = started.elapsed();
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
