//! Tests of the replay server's core as its service uses it: messages in, batches out.
//! They open no socket and start no thread.
#![allow(clippy::unwrap_used)]

mod anchors;
mod batches;
mod calls;
mod compression;
mod config;
mod durable;
mod durable_damage;
mod durable_marks;
mod exactly_once;
mod history;
mod horizon;
mod law;
mod limits;
mod priorities;
mod rate_limiter;
mod resume;
