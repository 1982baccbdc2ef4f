//! What a checkpoint of a run in lockstep holds beside the learner: how the other parts stand.
//! The replay's transitions are not in it; they lie in the run's folder, and this says up to where they count.

use anyhow::Context;
use driml_actor::CollectorState;
use driml_learner::checkpoint;
use driml_machine::error::usage;
use driml_protocol::{LearnerStatus, Weights, WeightsHeader, codec};
use driml_replay_server::Mark;
use serde::{Deserialize, Serialize};

use crate::run_folder::RunFolder;

/// How it is written; another way is rejected.
const FORMAT: u32 = 3;

/// How the parts of a run in lockstep stand, without the learner.
pub(super) struct SavedParts {
    pub(super) actors: Vec<CollectorState>,
    pub(super) next_actor: usize,
    pub(super) unwanted: Vec<u64>,
    pub(super) replay: Mark,
    pub(super) status: LearnerStatus,
    pub(super) acting: Weights,
    pub(super) published: u64,
}

/// [`SavedParts`] as they are written.
#[derive(Serialize, Deserialize)]
struct Written {
    actors: Vec<CollectorState>,
    next_actor: usize,
    unwanted: Vec<u64>,
    replay: Mark,
    status: LearnerStatus,
    acting: (WeightsHeader, Vec<u8>),
    published: u64,
}

impl SavedParts {
    /// The bytes of a checkpoint's companion.
    pub(super) fn to_bytes(&self) -> anyhow::Result<Vec<u8>> {
        let Weights {
            header,
            safetensors,
        } = &self.acting;
        let written = Written {
            actors: self.actors.clone(),
            next_actor: self.next_actor,
            unwanted: self.unwanted.clone(),
            replay: self.replay,
            status: self.status.clone(),
            acting: (*header, safetensors.clone()),
            published: self.published,
        };
        let mut bytes = FORMAT.to_le_bytes().to_vec();
        bytes.extend(codec::encode_value(&written).context("writing how the processes stand")?);
        Ok(bytes)
    }

    /// What the newest checkpoint in a run's folder holds.
    pub(super) fn read(run_dir: &RunFolder) -> anyhow::Result<Self> {
        let all = checkpoint::list(&run_dir.checkpoints())?;
        let (_, path) = all.last().context("there is no checkpoint")?;
        let bytes = checkpoint::companion(path)?
            .with_context(|| format!("{} is not a checkpoint of a lockstep run", path.display()))?;
        let reading = || format!("reading the lockstep state in {}", path.display());
        let Some(content) = bytes.strip_prefix(&FORMAT.to_le_bytes()) else {
            return Err(usage!(
                "{} is a lockstep checkpoint of another version of driml: resume with that version",
                path.display()
            )
            .into());
        };
        let written: Written = codec::decode_value(content).with_context(reading)?;
        let (header, safetensors) = written.acting;
        Ok(Self {
            actors: written.actors,
            next_actor: written.next_actor,
            unwanted: written.unwanted,
            replay: written.replay,
            status: written.status,
            acting: Weights {
                header,
                safetensors,
            },
            published: written.published,
        })
    }
}
