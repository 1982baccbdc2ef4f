//! Where a replay server's replay comes from: nowhere, as it begins, or a folder, which is read back in a second step.
//! How a log is read is `durable`'s.

use std::path::{Path, PathBuf};

use driml_protocol::RunSpec;

use super::{run_args::RunArgs, weights_store::WeightsStore};
use crate::{
    config::Config,
    durable::{DurableArgs, DurableError, DurableReplay, KeptReplay, Reading, shard_dir},
    replay::Replay,
};

/// Where the replay comes from.
pub(super) enum Origin {
    /// It begins empty, and is kept in memory alone.
    Memory(Box<DurableReplay>),
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
    ) -> Result<Self, DurableError> {
        let Some(dir) = &args.dir else {
            let mut replay = Replay::shard(spec, config, batch_size, args.shard)?;
            if args.after_updates > 0 {
                replay = replay.resumed_at(args.after_updates, args.shard);
            }
            let replay = DurableReplay::in_memory(replay, args.after_updates);
            return Ok(Self::Memory(Box::new(replay)));
        };
        let dir = shard_dir(dir, args.shard, config.shards);
        let durable = DurableArgs {
            dir: dir.clone(),
            shard: args.shard,
            after_updates: args.after_updates,
            segment_bytes: None,
            mark: None,
        };
        let kept = KeptReplay::find(&durable, spec, config, batch_size)?;
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
    ) -> Result<(DurableReplay, WeightsStore), DurableError> {
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
fn read_kept(
    dir: &Path,
    kept: KeptReplay,
    reading: &Reading,
) -> Result<DurableReplay, DurableError> {
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
                "priorities are not kept on disk: each transition has the highest one until it is learned from"
            );
        }
    } else {
        tracing::info!("keeps the replay in {}", dir.display());
    }
    Ok(replay)
}
