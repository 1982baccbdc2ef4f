//! Where a run begins: at nothing, or where its newest checkpoint stands.

/// What was done before a run starts: nothing, or what its newest checkpoint says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ResumePoint {
    /// Updates that the checkpoint has learned.
    pub updates: u64,
    /// Rows from which it has learned.
    pub rows: u64,
    /// Frames of the run by then.
    pub frames: u64,
    /// The replay was kept, and counts all of the run.
    pub replay_is_kept: bool,
}
