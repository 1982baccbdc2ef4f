//! From the transitions held to a batch: anchors, the episode around each, the row made of it, and k.
//! Nothing here changes what is stored or decides whether a batch may be served.

pub(crate) mod batch;
pub(crate) mod episodes;
pub mod horizon;
pub(crate) mod rows;
