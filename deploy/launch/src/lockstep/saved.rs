//! What a checkpoint of a run in lockstep holds beside the learner: the state of the other components.
//! The replay's transitions are not in it; they lie in the run's folder, and this says up to where they count.

use anyhow::Context;
use driml_actor::CollectorState;
use driml_learner::checkpoint;
use driml_machine::error::usage;
use driml_protocol::{LearnerStatus, WeightsHeader, codec};
use driml_replay_server::Mark;
use serde::{Deserialize, Serialize};

use crate::run_folder::RunFolder;

/// How it is written; another way is rejected.
const FORMAT: u32 = 4;

/// The state of a run in lockstep, without the learner.
#[derive(Serialize, Deserialize)]
pub(super) struct SavedParts {
    pub(super) actors: Vec<CollectorState>,
    pub(super) replay: Mark,
    pub(super) turn: Turn,
}

/// Which actor is next, and with which weights.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Turn {
    pub(super) next_actor: usize,
    /// Transitions of each actor that came after the run's last.
    pub(super) unwanted: Vec<u64>,
    pub(super) status: LearnerStatus,
    /// The weights with which the actors act, a safetensors file, and the updates after which they were published.
    pub(super) acting: (WeightsHeader, Vec<u8>),
    pub(super) published: u64,
}

impl SavedParts {
    pub(super) fn to_bytes(&self) -> anyhow::Result<Vec<u8>> {
        let mut bytes = FORMAT.to_le_bytes().to_vec();
        bytes.extend(codec::encode_value(self).context("writing actors and replay")?);
        Ok(bytes)
    }

    /// What the newest checkpoint in a run's folder holds.
    pub(super) fn read(run_dir: &RunFolder) -> anyhow::Result<Self> {
        let all = checkpoint::list(&run_dir.checkpoints())?;
        let (_, path) = all.last().context("there is no checkpoint")?;
        let bytes = checkpoint::companion(path)?
            .with_context(|| format!("{} is not a checkpoint of a lockstep run", path.display()))?;
        let Some(content) = bytes.strip_prefix(&FORMAT.to_le_bytes()) else {
            return Err(usage!(
                "{} is a lockstep checkpoint of another version of driml: resume with that version",
                path.display()
            )
            .into());
        };
        codec::decode_value(content)
            .with_context(|| format!("reading actors and replay in {}", path.display()))
    }
}
