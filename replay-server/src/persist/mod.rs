//! Keeps a running replay on disk. After its process has died, the replay is restored with every transition, exactly once, and each actor's
//! place. The number of rows learned is not restored: the learner reports it.
//!
//! The log in the folder holds the chunks as received and, between them, events: joins and leaves. It consists of segments, each of which
//! begins with a snapshot: the replay's state without the transitions. A segment begins when the one before is full, when the learner has
//! saved a checkpoint, and at marks. It is removed once all its transitions have left the ring. So the oldest segment's snapshot and all
//! later records restore the replay. A damaged segment costs only its own transitions, as the next segment has a complete snapshot.
//! The log does not record batches, priorities and affinities between two snapshots. After a recovery, transitions stored since the last
//! snapshot have the highest priority, and the learner sends its affinity with its next update.
//!
//! The server writes before it replies, so all acknowledged data survives the death of the process at any moment. Flushed data survives a
//! power cut too; `replay.fsync_ms` is the period between flushes.

pub(crate) mod folder;
pub(crate) mod journal;
mod record;
mod recover;
pub(crate) mod snapshot;
mod sync;
mod upkeep;

#[cfg(test)]
mod tests;

pub(crate) use folder::shard_dir;
pub use folder::{KeptSize, Mark, PersistArgs, PersistError, ReplayFolder, kept_size};
pub use recover::{RecoveryControl, RecoveryReport};
