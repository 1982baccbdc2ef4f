//! The replay server as a process: messages over zenoh around the core, the connected processes, and the shutdown.
//! The core decides what is stored, sampled and allowed. This module receives queries and decides when replies are sent.
//!
//! No thread that receives queries waits for the limiter: a chunk or request that comes too early is parked, and a separate thread serves
//! it when the limiter allows. Frames are compressed and unpacked without a lock on the core.
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
