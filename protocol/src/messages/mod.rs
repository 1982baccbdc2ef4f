//! Everything that is sent, one file a message.
//! `wire` turns messages into bytes; each process decides what it answers.

pub(crate) mod affinity;
pub(crate) mod batch;
pub(crate) mod batch_frames;
pub(crate) mod batch_header;
mod batch_layout;
pub(crate) mod batch_request;
pub(crate) mod batch_rows;
pub(crate) mod chunk;
pub(crate) mod done;
pub(crate) mod episodes;
pub(crate) mod goodbye;
pub(crate) mod hello;
pub(crate) mod insert_reply;
pub(crate) mod join;
pub(crate) mod parts;
pub(crate) mod priorities;
pub(crate) mod recovering;
pub(crate) mod report;
pub(crate) mod status;
pub(crate) mod tally;
pub(crate) mod weights;
