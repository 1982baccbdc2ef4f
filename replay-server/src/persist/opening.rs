//! Opening the folder of a replay: what is there is taken up, and a log goes on or begins.
//! Reading it back is for `recovery`.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use driml_protocol::{RunSpec, Shutdown, TRANSITION_BYTES};

use super::{
    error::PersistError,
    folder::LogFolder,
    journal::{Journal, Limits, Place},
    log::{Log, Marked},
    progress::Reading,
    recover::{Recovered, find_id, go_back, recover},
    segment::{FORMAT, LogId, Mark},
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

/// Where a replay is kept, and which part of the run it is.
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

impl Replay {
    /// The replay of a run that is kept in a folder: as it was, if it was kept there before, else an empty one.
    ///
    /// # Errors
    /// Those of [`KeptReplay::find`] and [`KeptReplay::read`].
    pub fn open(
        args: &PersistArgs,
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
    ) -> Result<(Self, Recovery), PersistError> {
        let kept = KeptReplay::find(args, spec, config, batch_size)?;
        kept.read(&Reading::begin(Shutdown::default()))
    }
}

/// The folder of a replay, which nobody else uses any more and which is this run's. What is kept there is not read yet.
pub struct KeptReplay {
    args: PersistArgs,
    /// Of this run and shard, if the log is new.
    id: LogId,
    is_new: bool,
    limits: Limits,
    folder: LogFolder,
    replay: Replay,
}

impl KeptReplay {
    /// Takes the folder and looks whose replay is in it, if any: at once, however much there is.
    ///
    /// # Errors
    /// Settings that cannot work; a folder that cannot be written, is in use, or holds the replay of another run.
    pub fn find(
        args: &PersistArgs,
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
    ) -> Result<Self, PersistError> {
        let replay = Replay::shard(spec, config, batch_size, args.shard)?;
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
            args: args.clone(),
            id,
            is_new: known.is_none(),
            limits: limits(args, spec, config),
            folder,
            replay,
        })
    }

    /// Reads what is kept: the replay as it was, or an empty one.
    ///
    /// # Errors
    /// A folder that cannot be read or written; [`PersistError::Stopped`] if `reading` is told so. Damage is no error: what is left is
    /// used, and what was lost is said.
    pub fn read(self, reading: &Reading) -> Result<(Replay, Recovery), PersistError> {
        let started = Instant::now();
        let Self {
            args,
            id,
            is_new,
            limits,
            folder,
            mut replay,
        } = self;
        if let Some(mark) = args.mark {
            go_back(&folder, mark)?;
        }
        let known = match is_new {
            false => recover(&folder, id, &mut replay, args.mark, reading)?,
            true => None,
        };
        let was_found = known.is_some();
        let found = match known {
            Some(found) => found,
            None => {
                folder.write_id(&id)?;
                Recovered::nothing(folder.first_number()?)
            }
        };
        let fsync = replay
            .config
            .fsync_ms
            .map_or(FSYNC_DEFAULT, Duration::from_millis);
        let journal = Journal::begin(
            Place {
                folder: args.dir.clone(),
                id,
                number: found.number,
                ordinal: found.ordinal,
            },
            &found.segments,
            limits,
            fsync,
            &replay.snapshot(),
        )?;
        let oldest_row = replay.ring.oldest();
        let marked = args.mark.map(|mark| Marked { mark, oldest_row });
        replay.log = Some(Log {
            journal,
            spec_hash: id.spec_hash,
            marks: marked.into_iter().collect(),
            _folder: folder,
        });
        replay.tidy();
        let recovery = Recovery {
            found: was_found,
            bytes: found.bytes,
            took: started.elapsed(),
            warnings: found.warnings,
        };
        Ok((replay, recovery))
    }
}

/// How large a segment is, and what all may take.
fn limits(args: &PersistArgs, spec: &RunSpec, config: &Config) -> Limits {
    let shards = u64::from(config.shards);
    let disk_bytes_max = config.disk_bytes_max.map(|max| max / shards);
    let row_bytes = spec.frame_bytes() as u64 + TRANSITION_BYTES as u64;
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
