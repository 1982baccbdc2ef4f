//! The replay on disk as it runs: after its process has died it has every transition again, exactly once, and each actor's place.
//! How many rows were learned is not its business: the learner says it.
//!
//! The log in the folder holds the chunks as they came and, between them, who came and went. It lies in segments that begin with a
//! snapshot: all of the replay's state but the transitions. A segment begins when the one before is full, when the learner has saved a
//! checkpoint, and at marks. It is removed once all its transitions have left the ring. So the oldest segment's snapshot, and all records
//! since, give the replay again, and a segment that is damaged costs its own transitions alone: the snapshot of the next one is whole.
//! Between two snapshots batches, priorities and affinities are not written down: after a recovery transitions that came since have the
//! largest priority, and the learner sends its affinity with its next update.
//!
//! What was answered has been written: it survives the death of the process at any moment. What was flushed, once in
//! `replay.fsync_ms`, survives a power cut too.

pub(crate) mod folder;
pub(crate) mod journal;
mod record;
mod recover;
pub(crate) mod snapshot;
mod sync;
mod upkeep;

#[cfg(test)]
mod tests;

pub use folder::{Mark, PersistError};
pub use recover::{Reading, Recovery};
pub(crate) use upkeep::shard_dir;
pub use upkeep::{KeptReplay, PersistArgs};
