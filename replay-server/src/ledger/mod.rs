//! What was counted: which chunks of which actor are stored, which request was served what, and the statistics of both.

pub(crate) mod actors;
pub(crate) mod requests;
pub(crate) mod statistics;
