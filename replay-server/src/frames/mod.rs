//! How the frames of the transitions held are kept: plain, or compressed without loss.
//! It knows neither links, episodes nor stacks, and it never stores a frame twice.

mod compressed;
mod layout;
mod log;
mod pack;
mod plain;
mod unpack;

use serde::{Deserialize, Serialize};

pub(crate) use compressed::{CompressedFrames, OVERHEAD_BYTES_MAX};
pub(crate) use pack::Run;
pub use pack::{PackedChunk, Packer};
pub(crate) use plain::PlainFrames;
pub use unpack::Draft;
pub(crate) use unpack::PackedStates;

/// How frames are kept in memory. Batches are the same, bit for bit, whatever it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Compression {
    /// As they came: the least work.
    #[default]
    None,
    /// Consecutive frames of one stream together, by LZ4: a fifth of the memory or less on many Procgen games, not on all, and
    /// more work a chunk and a batch.
    Lz4,
}

/// The frames of all transitions held.
pub(crate) enum Frames {
    Plain(PlainFrames),
    Compressed(CompressedFrames),
}

impl Frames {
    /// Stores the frames of the next transitions; those before `oldest` are no longer wanted. Gives the oldest that is held.
    pub(crate) fn push(&mut self, run: Run<'_>, oldest: u64) -> u64 {
        match (self, run) {
            (Self::Plain(frames), Run::Plain(run)) => {
                frames.push(run);
                oldest
            }
            (Self::Compressed(frames), Run::Packed(run)) => frames.push(run, oldest),
            _ => panic!("a chunk was packed for a replay with another compression"),
        }
    }

    /// Bytes of memory taken for frames.
    pub(crate) fn bytes_held(&self) -> u64 {
        match self {
            Self::Plain(frames) => frames.bytes_held(),
            Self::Compressed(frames) => frames.bytes_held(),
        }
    }

    /// Checks that the transitions `oldest..inserted` have their frames; panics if not. Slow: for tests.
    pub(crate) fn check_valid(&self, oldest: u64, inserted: u64) {
        match self {
            Self::Plain(frames) => frames.check_valid(inserted - oldest),
            Self::Compressed(frames) => frames.check_valid(oldest, inserted),
        }
    }
}
