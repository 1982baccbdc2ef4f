//! A run's folder: the names of its files, what is written there during a run, and reading it again.

mod episodes;
mod evaluations;
mod events;
mod folder;
mod metrics;
mod recorder;
mod summary;
mod table;

pub(crate) use self::{
    evaluations::Candidate,
    summary::{commands, plot},
};
pub use self::{
    evaluations::{Evaluated, sweep},
    folder::{RunFolder, write_whole},
    metrics::{Progress, ResumePoint, progress},
    recorder::{Recorded, RunRecorder},
    summary::{Earned, LastPlay, Outcome, Summary},
    table::Table,
};
pub use crate::moment::rounded;
