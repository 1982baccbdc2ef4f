//! Compresses a chunk before it is stored, so that the replay is not locked meanwhile.
//! It stores nothing and does not judge the chunk.

use std::borrow::Cow;

use driml_protocol::{Chunk, codec};
use lz4_flex::block::{compress_into, compress_into_with_dict, get_maximum_output_size};

use super::layout::{Layout, PartEnds};
use crate::config::Compression;

/// Prepares chunks for one replay.
#[derive(Clone, Copy, Debug)]
pub struct Packer {
    pub(crate) compression: Compression,
    /// Hash of the run spec where chunks are also kept on disk, as messages.
    pub(crate) seal_for: Option<u64>,
}

/// A chunk with its frames as the replay will keep them.
pub struct PackedChunk<'a> {
    pub(crate) chunk: Cow<'a, Chunk>,
    /// With compression: of each stream.
    packed: Vec<PackedRun>,
    /// Where chunks are kept on disk: prefix and header of the message, if the chunk makes one.
    pub(crate) sealed: Option<Vec<u8>>,
}

/// Consecutive frames of one stream as blocks, the first frame's first.
#[derive(Default)]
pub(crate) struct PackedRun {
    pub(crate) blocks: Vec<PackedBlock>,
    /// Of each block: its parts, one after the other. A part is the frames themselves if it has as many bytes.
    pub(crate) bytes: Vec<u8>,
}

/// A block that is not stored yet.
pub(crate) struct PackedBlock {
    pub(crate) frames: usize,
    /// Bytes up to the end of each part, from the start of the block.
    pub(crate) part_ends: PartEnds,
}

/// One stream's frames, on their way into the replay.
#[derive(Clone, Copy)]
pub(crate) enum Run<'a> {
    Plain(&'a [u8]),
    Packed(&'a PackedRun),
}

impl Packer {
    /// Compresses the chunk's frames, or leaves them as they are.
    pub fn pack<'a>(&self, chunk: Cow<'a, Chunk>) -> PackedChunk<'a> {
        let packed = match self.compression {
            Compression::None => Vec::new(),
            Compression::Lz4 => runs(&chunk)
                .map(|run| PackedRun::new(run, Layout::new(chunk.header.frame_bytes as usize)))
                .collect(),
        };
        let seal = |hash| codec::seal(hash, &chunk.header, chunk.payload()).ok();
        let sealed = self.seal_for.and_then(seal);
        PackedChunk {
            chunk,
            packed,
            sealed,
        }
    }
}

impl PackedChunk<'_> {
    /// Bytes of memory that it takes, roughly.
    pub(crate) fn bytes(&self) -> usize {
        let packed: usize = self.packed.iter().map(|run| run.bytes.len()).sum();
        self.chunk.header.payload_bytes().unwrap_or(usize::MAX) + packed
    }

    /// The frames of each stream.
    pub(crate) fn runs(&self) -> impl Iterator<Item = Run<'_>> {
        let plain = self.packed.is_empty();
        let plain = plain.then(|| runs(&self.chunk).map(Run::Plain));
        let packed = self.packed.iter().map(Run::Packed);
        plain.into_iter().flatten().chain(packed)
    }
}

/// The frames of each stream. A chunk of nothing, which will be refused, has none.
fn runs(chunk: &Chunk) -> impl Iterator<Item = &[u8]> {
    let run_bytes = chunk.header.steps as usize * chunk.header.frame_bytes as usize;
    chunk.frames().chunks_exact(run_bytes.max(1))
}

impl PackedRun {
    fn new(frames: &[u8], layout: Layout) -> Self {
        let mut run = Self::default();
        let mut scratch = Vec::new();
        for block in frames.chunks(layout.block_frames_max() * layout.frame_bytes) {
            let frames = block.len() / layout.frame_bytes;
            let (key, start) = (&block[..layout.frame_bytes], run.bytes.len());
            let mut part_ends = PartEnds::default();
            let parts = layout.parts(frames);
            for (part, end) in part_ends.iter_mut().enumerate().take(parts) {
                let range = layout.frames_of(part, frames);
                let plain =
                    &block[range.start * layout.frame_bytes..range.end * layout.frame_bytes];
                scratch.resize(get_maximum_output_size(plain.len()), 0);
                let packed = match part {
                    0 => compress_into(plain, &mut scratch),
                    _ => compress_into_with_dict(plain, &mut scratch, key),
                };
                run.bytes.extend_from_slice(match packed {
                    Ok(length) if length < plain.len() => &scratch[..length],
                    // It would not become smaller.
                    _ => plain,
                });
                *end = (run.bytes.len() - start) as u32;
            }
            run.blocks.push(PackedBlock { frames, part_ends });
        }
        run
    }
}
