//! Tests of the network from outside: kernels against stock candle operations, weights, the policy.
//! They know nothing of losses; the learner's tests check the gradients of those.
#![allow(clippy::unwrap_used, missing_docs)]

mod conv;
mod head;
mod linear;
mod network;
mod policy;
mod support;
mod weights;
