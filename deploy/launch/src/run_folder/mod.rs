//! A run's folder: the names of its files, what is written there while a run goes on, and reading it again.

mod columns;
mod episodes;
mod evaluations;
mod events;
mod folder;
mod growing_csv;
mod growing_file;
mod metrics;
mod recorder;
mod resume_point;
mod summary;

pub use self::{
    columns::Columns,
    episodes::{Episodes, MeanReturn, rounded},
    evaluations::{Evaluated, sweep},
    folder::{RunFolder, write_whole},
    metrics::{Progress, progress},
    recorder::{Recorded, RunRecorder},
    resume_point::ResumePoint,
    summary::{Earned, LastPlay, Outcome, Summary},
};
pub(crate) use self::{
    evaluations::Candidate,
    summary::{commands, plot},
};
