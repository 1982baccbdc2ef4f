//! Bookkeeping: which chunks of each actor are stored, which rows each request was given, and statistics of both.

pub(crate) mod actors;
pub(crate) mod requests;
pub(crate) mod statistics;
