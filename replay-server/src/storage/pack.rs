//! Compresses a chunk before it is stored, and unpacks frames after they are drawn, both without a lock on the replay.
//! It stores nothing and does not validate the chunk.
//!
//! The unit of compression is a block: consecutive frames of one stream, the first of which is the key. Each part of a block is a separate
//! LZ4 block: the key alone, then a few frames each, with the key as LZ4's dictionary. To read a frame, only its part and the key are
//! unpacked. Frames are not stored as differences: LZ4 also finds common content if the picture scrolls, where differences would destroy
//! it.

use std::{borrow::Cow, ops::Range, sync::Arc};

use driml_protocol::{Chunk, codec};
use lz4_flex::block::{
    compress_into, compress_into_with_dict, decompress_into, decompress_into_with_dict,
    get_maximum_output_size,
};

use crate::config::Compression;

/// Maximum bytes of a part before compression, unless one frame is longer: three frames of Procgen.
///
/// Longer parts compress better; a single frame is faster to read from a shorter part.
const PART_BYTES_MAX: usize = 36 << 10;
/// Maximum parts of a block besides its key. With three frames each, a block has 16 frames, as many as an actor's chunk has steps.
const PARTS_MAX: usize = 5;

/// Prepares chunks for one replay.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Packer {
    pub(crate) compression: Compression,
    /// Hash of the run spec, if chunks are also written to disk, as messages.
    pub(crate) spec_hash: Option<u64>,
}

/// A chunk with its frames as the replay will keep them.
pub(crate) struct PackedChunk<'a> {
    pub(crate) chunk: Cow<'a, Chunk>,
    /// The blocks of each stream; empty without compression.
    blocks: Vec<Vec<Arc<Block>>>,
    /// Prefix and header of the chunk's message, if chunks are written to disk and this chunk fits into a message.
    pub(crate) message_head: Option<Vec<u8>>,
}

/// Consecutive frames of one stream, compressed.
pub(crate) struct Block {
    pub(crate) frames: usize,
    /// The end of each part in `bytes`; 0 for parts that the block does not have.
    part_ends: [u32; 1 + PARTS_MAX],
    /// The parts in order. A part that has as many bytes as its frames is not compressed.
    pub(crate) bytes: Box<[u8]>,
}

/// The frames of one stream, to be stored in the replay.
#[derive(Clone, Copy)]
pub(crate) enum StreamFrames<'a> {
    Plain(&'a [u8]),
    Packed(&'a [Arc<Block>]),
}

impl Packer {
    /// Compresses the chunk's frames if the replay compresses, and encodes the message's head if the replay is on disk.
    pub(crate) fn pack<'a>(&self, chunk: Cow<'a, Chunk>) -> PackedChunk<'a> {
        let blocks = match self.compression {
            Compression::None => Vec::new(),
            Compression::Lz4 => frames_by_stream(&chunk)
                .map(|frames| pack_blocks(frames, chunk.header.frame_bytes as usize))
                .collect(),
        };
        let seal = |hash| codec::encode_head(hash, &chunk.header, chunk.payload()).ok();
        let message_head = self.spec_hash.and_then(seal);
        PackedChunk {
            chunk,
            blocks,
            message_head,
        }
    }
}

impl PackedChunk<'_> {
    /// Returns the approximate bytes of memory that the chunk takes.
    pub(crate) fn memory_bytes(&self) -> usize {
        let bytes = self.blocks.iter().flatten().map(|block| block.bytes.len());
        self.chunk.header.payload_bytes().unwrap_or(usize::MAX) + bytes.sum::<usize>()
    }

    pub(crate) fn stream_frames(&self, stream: usize) -> StreamFrames<'_> {
        match self.blocks.get(stream) {
            Some(blocks) => StreamFrames::Packed(blocks),
            None => {
                let frames = frames_by_stream(&self.chunk).nth(stream);
                StreamFrames::Plain(frames.expect("a chunk that is stored has all its streams"))
            }
        }
    }
}

/// Returns the frames of each stream. An empty chunk, which will be rejected, has none.
fn frames_by_stream(chunk: &Chunk) -> impl Iterator<Item = &[u8]> {
    let stream_bytes = chunk.header.steps as usize * chunk.header.frame_bytes as usize;
    chunk.frames().chunks_exact(stream_bytes.max(1))
}

/// Compresses a stream's frames into consecutive blocks.
fn pack_blocks(frames: &[u8], frame_bytes: usize) -> Vec<Arc<Block>> {
    let layout = BlockLayout::new(frame_bytes);
    let blocks = frames.chunks(layout.block_frames_max() * frame_bytes);
    let packed = blocks.map(|block| Arc::new(Block::new(block, layout)));
    packed.collect()
}

/// How a block is divided into parts.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlockLayout {
    pub(crate) frame_bytes: usize,
    /// Frames of each part but the key; the last part may have fewer.
    part_frames: usize,
}

impl BlockLayout {
    pub(crate) fn new(frame_bytes: usize) -> Self {
        Self {
            frame_bytes,
            part_frames: (PART_BYTES_MAX / frame_bytes).max(1),
        }
    }

    const fn block_frames_max(&self) -> usize {
        1 + PARTS_MAX * self.part_frames
    }

    /// Returns the part that holds a frame of the block; 0 is the key.
    pub(crate) const fn part_of(&self, frame: usize) -> usize {
        frame.div_ceil(self.part_frames)
    }

    /// Returns the frames of one part of a block of `frames` frames.
    pub(crate) fn frames_in_part(&self, part: usize, frames: usize) -> Range<usize> {
        match part {
            0 => 0..1,
            _ => {
                let start = 1 + (part - 1) * self.part_frames;
                start..(start + self.part_frames).min(frames)
            }
        }
    }
}

impl Block {
    fn new(frames: &[u8], layout: BlockLayout) -> Self {
        let key = &frames[..layout.frame_bytes];
        let count = frames.len() / layout.frame_bytes;
        let (mut bytes, mut scratch) = (Vec::new(), Vec::new());
        let mut part_ends = [0; 1 + PARTS_MAX];
        let parts = 1 + layout.part_of(count - 1);
        for (part, end) in part_ends.iter_mut().enumerate().take(parts) {
            let range = layout.frames_in_part(part, count);
            let plain = &frames[range.start * layout.frame_bytes..range.end * layout.frame_bytes];
            scratch.resize(get_maximum_output_size(plain.len()), 0);
            let packed = match part {
                0 => compress_into(plain, &mut scratch),
                _ => compress_into_with_dict(plain, &mut scratch, key),
            };
            bytes.extend_from_slice(match packed {
                Ok(length) if length < plain.len() => &scratch[..length],
                // Compression does not make this part smaller.
                _ => plain,
            });
            *end = bytes.len() as u32;
        }
        Self {
            frames: count,
            part_ends,
            // A copy without the vector's spare capacity.
            bytes: bytes.as_slice().into(),
        }
    }

    /// Unpacks a part into `to`, which has exactly the size of its frames. `key` is the block's first frame, which part 0 does not need.
    pub(crate) fn unpack(&self, part: usize, key: &[u8], to: &mut [u8]) {
        let end = |part: usize| self.part_ends[part] as usize;
        let stored = &self.bytes[part.checked_sub(1).map_or(0, end)..end(part)];
        if stored.len() == to.len() {
            return to.copy_from_slice(stored);
        }
        let unpacked = match part {
            0 => decompress_into(stored, to),
            _ => decompress_into_with_dict(stored, to, key),
        };
        let unpacked = unpacked.expect("we packed this part");
        assert_eq!(unpacked, to.len(), "a part has all its frames");
    }
}
