//! What the replay holds: the transitions in a ring, and their frames, plain or compressed.
//! Nothing here draws a sample or knows which actor sent what.

pub(crate) mod frame_store;
pub(crate) mod pack;
pub(crate) mod ring;
