//! A run's folder: the names of its files, what a run writes into them, and how they are read.

mod episodes;
mod evaluations;
mod events;
mod folder;
mod metrics;
mod recorder;
mod summary;
mod table;

pub(crate) use self::metrics::{BeforeReplay, read_last_row};
pub(crate) use self::{
    evaluations::Candidate,
    summary::{LastPlay, ReturnInterval, format_commands, plot_command},
    table::AppendLog,
};
pub use self::{
    evaluations::EvaluationRow,
    folder::RunFolder,
    metrics::{Progress, ResumePoint, read_progress},
    recorder::RunRecorder,
    summary::{Outcome, Summary},
    table::{Table, write_atomically},
};
