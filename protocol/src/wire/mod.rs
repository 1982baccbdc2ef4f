//! How messages become bytes, the memory those lie in, and the keys they travel under.
//! What a message means is not known here.

pub(crate) mod buffers;
pub mod codec;
pub(crate) mod error;
pub(crate) mod keys;
pub(crate) mod message;
pub mod shared_memory;
