//! What was counted: which chunks of which actor are stored, which request was served what, and the statistics of both.
//! No transition is kept here.

pub(crate) mod actors;
pub(crate) mod requests;
pub(crate) mod statistics;
