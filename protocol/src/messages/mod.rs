//! The messages, grouped in files by topic; `table` lists all of them.
//! `wire` turns messages into bytes; each process decides what it replies.

pub(crate) mod affinity;
pub(crate) mod batch;
pub(crate) mod batch_frames;
pub(crate) mod batch_header;
pub(crate) mod batch_request;
pub(crate) mod chunk;
pub(crate) mod episodes;
pub(crate) mod join;
pub(crate) mod priorities;
pub(crate) mod recovering;
pub(crate) mod report;
pub(crate) mod status;
pub(crate) mod table;
pub(crate) mod weights;
