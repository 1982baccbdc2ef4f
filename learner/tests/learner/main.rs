//! The learner as its process uses it: updates on synthetic batches, and checkpoints.
//! `parity` checks the arithmetic; these tests check what must hold for any batch.

#![allow(clippy::unwrap_used)]

mod agents;
mod augment;
mod checkpoint;
mod checkpoint_damage;
#[cfg(feature = "cuda")]
mod cuda;
mod deduplicate;
mod errors;
mod insight;
mod parity;
mod ranges;
mod served;
mod synthetic;
mod update;
