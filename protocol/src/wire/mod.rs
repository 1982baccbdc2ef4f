//! How messages become bytes, the memory that holds these bytes, and the keys at which messages are sent.
//! The meaning of messages is not known here.

pub(crate) mod buffers;
pub mod codec;
pub(crate) mod error;
pub(crate) mod keys;
pub(crate) mod message;
pub mod shared_memory;
