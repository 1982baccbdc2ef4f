//! Where a replay server's replay comes from: nowhere, as it begins, or a folder, which is read back in a second step.
//! How a log is read is `persist`'s.

use std::path::{Path, PathBuf};

use driml_protocol::RunSpec;

use super::{run_args::RunArgs, weights_store::WeightsStore};
use crate::{
    config::Config,
    persist::{KeptReplay, PersistArgs, PersistError, Reading, shard_dir},
    replay::Replay,
};

/// Where the replay comes from.
pub(super) enum Origin {
    /// It begins empty, and is kept in memory alone.
    Memory(Box<Replay>),
    /// It is kept in this folder, and not read yet.
    Folder(PathBuf, Box<KeptReplay>),
}

impl Origin {
    /// Finds it at once, however much is kept.
    ///
    /// # Errors
    /// Settings that cannot work, memory that the system does not grant, a folder that cannot be used.
    pub(super) fn find(
        args: &RunArgs,
        spec: &RunSpec,
        config: &Config,
        batch_size: u32,
    ) -> Result<Self, PersistError> {
        let Some(dir) = &args.dir else {
            let replay = Replay::shard(spec, config, batch_size, args.shard)?;
            return Ok(Self::Memory(Box::new(replay)));
        };
        let dir = shard_dir(dir, args.shard, config.shards);
        let kept = PersistArgs {
            dir: dir.clone(),
            shard: args.shard,
            segment_bytes: None,
            mark: None,
        };
        let kept = KeptReplay::find(&kept, spec, config, batch_size)?;
        Ok(Self::Folder(dir, Box::new(kept)))
    }

    /// The replay, and the newest weights that were handed over.
    ///
    /// # Errors
    /// Those of [`KeptReplay::read`].
    pub(super) fn read(
        self,
        reading: &Reading,
        spec_hash: u64,
    ) -> Result<(Replay, WeightsStore), PersistError> {
        match self {
            Self::Memory(replay) => Ok((*replay, WeightsStore::default())),
            Self::Folder(dir, kept) => {
                let replay = read_kept(&dir, *kept, reading)?;
                Ok((replay, WeightsStore::kept_in(&dir, spec_hash)))
            }
        }
    }
}

/// Reads the replay that is kept in `dir`, and says what was found.
fn read_kept(dir: &Path, kept: KeptReplay, reading: &Reading) -> Result<Replay, PersistError> {
    let (replay, recovery) = kept.read(reading)?;
    for warning in &recovery.warnings {
        tracing::warn!("{}: {warning}", dir.display());
    }
    if recovery.found {
        let status = replay.status();
        tracing::info!(
            "goes on with the replay in {}: {} transitions stored, {} held, {} rows served; {} MiB read in {:.1} s",
            dir.display(),
            status.transitions_inserted,
            status.transitions_held,
            status.rows_sampled,
            recovery.bytes >> 20,
            recovery.took.as_secs_f64()
        );
        if replay.priority_counts().is_some() {
            tracing::info!(
                "priorities are those of the last checkpoint: each transition that came later has the highest one"
            );
        }
    } else {
        tracing::info!("keeps the replay in {}", dir.display());
    }
    Ok(replay)
}
