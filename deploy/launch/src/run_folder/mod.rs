//! A run's folder: the names of its files, what is written there during a run, and reading it again.

mod episodes;
mod evaluations;
mod events;
mod folder;
mod metrics;
mod recorder;
mod summary;
mod table;

pub(crate) use self::metrics::Uncounted;
pub(crate) use self::{
    evaluations::Candidate,
    summary::{Earned, LastPlay, commands, plot},
    table::AppendLog,
};
pub use self::{
    evaluations::Evaluated,
    folder::RunFolder,
    metrics::{Progress, ResumePoint, progress},
    recorder::RunRecorder,
    summary::{Outcome, Summary},
    table::{Table, write_whole},
};
