//! The replay server as a process: zenoh around the core, who takes part, and the last word to everyone.
//! What is stored, sampled and allowed is the core's; here is only who asks and when the answer goes out.
//!
//! No thread that answers waits for the limiter: a chunk or a request that is too early is parked, and a thread that does
//! nothing else deals with it when the limiter opens. Compressing and unpacking frames is done outside the lock on the core.
//!
//! A chunk goes from `chunks` through `storage::pack` to `replay::actors`, which stores it, or waits in `parked`. A request waits in
//! `parked` until `batches` serves it: `replay::learner` decides that a batch may be drawn, and `sampling::batch` makes it.

mod batches;
mod chunks;
mod joining;
mod limits;
mod parked;
mod participants;
mod run;
mod server;
mod status;
mod timings;
mod weights;
mod weights_store;

pub use limits::shared_memory_bytes;
pub use run::{RunArgs, run};
