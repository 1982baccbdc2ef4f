//! Selects a checkpoint and weights in a run's folder.
//! This module reads only the settings; the player reads the weights.

use std::{path::PathBuf, str::FromStr};

use anyhow::Context;
use clap::ValueEnum;
use driml_learner::checkpoint;
use driml_machine::{error::usage, units::count, whole_number};
use driml_settings::config::RunConfig;

use crate::run_folder::RunFolder;

/// Which checkpoint of a run to use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CheckpointChoice {
    /// The checkpoint with the most updates.
    #[default]
    Newest,
    /// The checkpoint after this many updates.
    After(u64),
    /// The checkpoint that earned most when checkpoints were evaluated.
    Best,
}

/// Which weights of a checkpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum WeightsChoice {
    /// Averaged weights if the run has them (learner.update.average_tau), else online weights
    #[default]
    Average,
    /// Weights of the last update
    Online,
}

impl FromStr for CheckpointChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "best" => Ok(Self::Best),
            "newest" => Ok(Self::Newest),
            "average" => Err(
                "averaged weights play by default if a run has them: leave --checkpoint out".into(),
            ),
            _ => whole_number::within(1..=u64::MAX)(text)
                .map(Self::After)
                .map_err(|_| "give the updates of a checkpoint, \"best\" or \"newest\"".to_owned()),
        }
    }
}

/// Reads the settings of the run in `folder`.
pub fn read_config(folder: &RunFolder) -> anyhow::Result<RunConfig> {
    let path = folder.config();
    let text = std::fs::read_to_string(&path).map_err(|e| {
        usage!(
            "{} is not the folder of a run: reading {}: {e}; give a folder that `driml train` or `driml watch --run-dir` made",
            folder.display(),
            path.display()
        )
    })?;
    Ok(RunConfig::parse(&path.display().to_string(), &text)?)
}

pub(crate) fn checkpoint_path(
    folder: &RunFolder,
    choice: CheckpointChoice,
) -> anyhow::Result<PathBuf> {
    let run = folder.display();
    let parent = match choice {
        CheckpointChoice::Best => folder.best(),
        CheckpointChoice::Newest | CheckpointChoice::After(_) => folder.checkpoints(),
    };
    let mut all = checkpoint::list(&parent)?;
    let known: Vec<_> = all.iter().map(|(updates, _)| updates.to_string()).collect();
    let chosen = match choice {
        CheckpointChoice::After(wanted) => all.into_iter().find(|(updates, _)| *updates == wanted),
        CheckpointChoice::Newest | CheckpointChoice::Best => all.pop(),
    };
    chosen.map(|(_, path)| path).with_context(|| match choice {
        CheckpointChoice::Best => usage!(
            "{run} has no best checkpoint: none was evaluated. Train with --eval-interval UPDATES, or evaluate one \
             with `driml evaluate {run} --checkpoint UPDATES --keep`"
        ),
        CheckpointChoice::After(wanted) if !known.is_empty() => usage!(
            "{run} has no checkpoint after {}; it has those after {}. learner.checkpoints_kept sets how many are kept",
            count(wanted, "update"),
            known.join(", ")
        ),
        _ => usage!("{run} has no checkpoint yet: let the run continue, or start it again"),
    })
}
