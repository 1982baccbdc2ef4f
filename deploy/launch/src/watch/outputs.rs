//! What `driml watch` leaves of a run, as its flags say.
//! It writes nothing.

use std::path::PathBuf;

use crate::run_folder::RunFolder;

/// What is left of a run that is watched.
#[derive(Clone, Debug, Default)]
pub struct Outputs {
    /// Where settings, metrics and summary go; none to only look.
    pub run_dir: Option<RunFolder>,
    /// Write TensorBoard's events there, too.
    pub tensorboard: bool,
    /// Where the numbers go in Prometheus' text format, at each answer.
    pub prometheus: Option<PathBuf>,
}
