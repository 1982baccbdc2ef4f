//! Tests of the replay server's core as its service uses it: messages in, batches out.
//! They open no socket and start no thread.
#![allow(clippy::unwrap_used)]

mod batches;
mod calls;
mod compression;
mod exactly_once;
mod history;
mod horizon;
mod law;
mod limits;
mod persist;
mod persist_damage;
mod persist_marks;
mod resume;
mod rows;
