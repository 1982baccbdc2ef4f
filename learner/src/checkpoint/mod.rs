//! Checkpoints: all of a learner's state in one folder, from which a run resumes bit for bit.
//! It does not decide when to save, and never falls back to an older checkpoint by itself.

mod contents;
mod description;
mod error;
mod folder;
mod load;

pub use contents::{AVERAGE, Extras, LearnerState, check_state, save};
pub use description::{METADATA_KEY, describe, read_description};
pub use error::CheckpointError;
pub(crate) use folder::retry_until_writable;
pub use folder::{FOLDER, RETRY_MAX, list, lock, prune, store};
pub use load::{load, load_latest, read_affinity, read_companion, read_run_counts};
