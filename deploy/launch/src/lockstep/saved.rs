//! What a checkpoint of a run in lockstep holds beside the learner: how the other parts stand.
//! The replay's transitions are not in it; they lie in the run's folder, and this says up to where they count.

use anyhow::Context;
use driml_actor::CollectorState;
use driml_learner::checkpoint;
use driml_machine::error::usage;
use driml_protocol::{LearnerStatus, Weights, WeightsHeader, codec};
use driml_replay_server::{Mark, SavedPriorities};
use serde::{Deserialize, Serialize};

use crate::run_folder::RunFolder;

/// How it is written; another way is refused.
const FORMAT: u32 = 1;
/// The same with priorities after it: of a run that draws by them.
const FORMAT_PRIORITISED: u32 = 2;

/// How the parts of a run in lockstep stand, without the learner.
pub(super) struct SavedParts {
    pub(super) actors: Vec<CollectorState>,
    pub(super) next_actor: usize,
    pub(super) unwanted: Vec<u64>,
    pub(super) replay: Mark,
    /// Where rows are drawn by priority: the replay's log does not have them.
    pub(super) priorities: Option<SavedPriorities>,
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
    ///
    /// # Errors
    /// More than a file of this kind may hold.
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
        let (format, value) = match &self.priorities {
            None => (FORMAT, codec::encode_value(&written)),
            Some(priorities) => {
                let value = codec::encode_value(&(&written, priorities));
                (FORMAT_PRIORITISED, value)
            }
        };
        let mut bytes = format.to_le_bytes().to_vec();
        bytes.extend(value.context("writing how the parts stand")?);
        Ok(bytes)
    }

    /// What the newest checkpoint in a run's folder holds.
    ///
    /// # Errors
    /// No checkpoint, one of a run that is not in lockstep, a damaged one.
    pub(super) fn read(run_dir: &RunFolder) -> anyhow::Result<Self> {
        let all = checkpoint::list(&run_dir.checkpoints())?;
        let (_, path) = all.last().context("there is no checkpoint")?;
        let bytes = checkpoint::companion(path)?
            .with_context(|| format!("{} is not of a run in lockstep", path.display()))?;
        let reading = || format!("reading the parts in {}", path.display());
        let (written, priorities) = if let Some(content) = bytes.strip_prefix(&FORMAT.to_le_bytes())
        {
            let written: Written = codec::decode_value(content).with_context(reading)?;
            (written, None)
        } else if let Some(content) = bytes.strip_prefix(&FORMAT_PRIORITISED.to_le_bytes()) {
            let (written, priorities) =
                codec::decode_value::<(Written, _)>(content).with_context(reading)?;
            (written, Some(priorities))
        } else {
            return Err(usage!(
                "{} holds the parts of a run in lockstep in the form of another version of driml: go on with that one",
                path.display()
            )
            .into());
        };
        let (header, safetensors) = written.acting;
        Ok(Self {
            actors: written.actors,
            next_actor: written.next_actor,
            unwanted: written.unwanted,
            replay: written.replay,
            priorities,
            status: written.status,
            acting: Weights {
                header,
                safetensors,
            },
            published: written.published,
        })
    }
}
