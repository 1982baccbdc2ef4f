//! Tests of the network through its public interface: kernels against candle's operations, weights, the policy.
//! They know nothing of losses, whose gradients the learner's tests check.
#![allow(clippy::unwrap_used, missing_docs)]

mod head;
mod layers;
mod network;
mod policy;
mod support;
mod weights;
