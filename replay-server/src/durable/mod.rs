//! The replay, kept on disk as it runs: after its process has died it goes on as if nothing had happened.
//! What is stored, drawn and allowed is the replay's; here is only that each change is on disk before anybody hears of it.
//!
//! The log in the folder is the replay's history: the chunks as they came and, between them, what else changed it, in the order in
//! which it happened. It lies in segments that begin with all of the replay's state but the transitions. A segment is removed once
//! all its transitions have left the ring. So the oldest segment's state, and all records since, give the replay again, and a
//! segment that is damaged costs its own transitions alone: the state of the next one is whole.
//!
//! What was answered has been written: it survives the death of the process at any moment. What was flushed, once in
//! `replay.fsync_ms`, survives a power cut too.

mod error;
mod folder;
mod journal;
mod opening;
mod progress;
mod record;
mod recovery;
mod replay;
mod segment;
mod sync;

pub use error::DurableError;
pub(crate) use opening::shard_dir;
pub use opening::{DurableArgs, KeptReplay, Recovery};
pub use progress::Reading;
pub use replay::DurableReplay;
pub use segment::Mark;
