//! Makes batches from the transitions held: draws anchors, walks the episode around each, and computes the row and its k.
//! Nothing here changes what is stored or decides whether a batch may be served.

pub(crate) mod batch;
pub(crate) mod episodes;
pub mod horizon;
pub(crate) mod rows;
