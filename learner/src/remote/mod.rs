//! The learner as a process of a run. All code that uses zenoh is here.
//! It does not know what is learned, or how: `learner` does.

pub mod batch_source;
mod fetcher;
mod publish;
pub mod run;
mod same_run;
mod shards;
