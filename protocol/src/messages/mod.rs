//! Everything that is sent: `table` lists it, and each message has a file.
//! `wire` turns messages into bytes; each process decides what it answers.

pub(crate) mod ack;
pub(crate) mod affinity;
pub(crate) mod batch;
pub(crate) mod batch_frames;
pub(crate) mod batch_header;
mod batch_layout;
pub(crate) mod batch_request;
pub(crate) mod batch_rows;
pub(crate) mod chunk;
pub(crate) mod episodes;
pub(crate) mod insert_reply;
pub(crate) mod join;
pub(crate) mod leave;
pub(crate) mod priorities;
pub(crate) mod processes;
pub(crate) mod recovering;
pub(crate) mod report;
pub(crate) mod run_info;
pub(crate) mod shard_counts;
pub(crate) mod status;
pub(crate) mod table;
pub(crate) mod weights;
