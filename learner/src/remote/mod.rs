//! The learner as a process of a run: everything that knows zenoh stands here.
//! What is learned, and how, it does not know: `learner` does.

pub mod batch_source;
mod error;
mod fetcher;
mod publish;
pub mod run;
mod shards;

pub use error::BatchError;
