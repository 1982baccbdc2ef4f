//! A run's folder: the names of its files, what is written there while a run goes on, and reading it again.

mod columns;
mod evaluations;
mod events;
mod folder;
mod growing_csv;
mod growing_file;
mod metrics;
mod recorder;
mod resume_point;
mod returns;
mod summary;

pub(crate) use self::evaluations::Candidate;
pub use self::{
    columns::Columns,
    evaluations::{Evaluated, sweep},
    folder::{RunFolder, write_whole},
    metrics::{Progress, progress},
    recorder::RunRecorder,
    resume_point::ResumePoint,
    returns::{Episodes, MeanReturn},
    summary::{Outcome, Summary},
};
