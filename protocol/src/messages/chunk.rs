//! Chunks of transitions that actors send to the replay server, the question about chunks that wait, and the replies.
//! The replay server decides what it stores, and ensures order and exactly-once storage.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::wire::{buffers::Buffer, codec, error::CodecError};

/// Bytes of one transition in a chunk without its frame: an action, an end and a reward.
pub const TRANSITION_BYTES: usize = size_of::<u8>() + size_of::<End>() + size_of::<f32>();
const _: () = assert!(TRANSITION_BYTES == 6);

/// What ended with a step, if anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum End {
    /// The episode continues with the next step.
    Running = 0,
    /// A level ended: a boundary for DIM, not for the return.
    LevelChange = 1,
    /// The episode ended at its step limit.
    TimedOut = 2,
    /// The episode ended by the rules of the world.
    Terminal = 3,
}

impl End {
    /// Returns the end that `byte` encodes, if it encodes one.
    pub const fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Running),
            1 => Some(Self::LevelChange),
            2 => Some(Self::TimedOut),
            3 => Some(Self::Terminal),
            _ => None,
        }
    }

    /// Whether the episode is over, for whatever reason.
    pub const fn is_episode_end(self) -> bool {
        matches!(self, Self::TimedOut | Self::Terminal)
    }
}

/// The header of a chunk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChunkHeader {
    /// The actor's number, unique in the run.
    pub actor: u32,
    /// The actor's incarnation, drawn at each start of the process.
    pub incarnation: u64,
    /// Number of the chunk within the incarnation, from 0.
    pub sequence: u64,
    /// Transitions that this incarnation produced before this chunk. This second count reveals losses.
    pub first_transition: u64,
    /// Version of the weights that chose every action of this chunk; 0 before the first version.
    pub weights_version: u64,
    /// Whether the actor is shutting down and sends its remaining transitions. The rate limiter lets 128 such chunks pass.
    pub leaving: bool,
    /// Number of environments, each of which is a stream.
    pub streams: u32,
    /// Consecutive steps of each stream in this chunk.
    pub steps: u32,
    /// Bytes of one frame.
    pub frame_bytes: u32,
}

impl ChunkHeader {
    /// Transitions in the chunk.
    pub const fn transitions(&self) -> usize {
        self.streams as usize * self.steps as usize
    }

    /// Bytes of the chunk's payload; `None` if they exceed the address space.
    pub fn payload_bytes(&self) -> Option<usize> {
        self.transitions()
            .checked_mul(self.frame_bytes as usize + TRANSITION_BYTES)
    }

    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        let (streams, steps, bytes) = (self.streams, self.steps, self.frame_bytes);
        let fits = self.payload_bytes() == Some(payload.len()) && self.transitions() > 0;
        let why = format_args!(
            "{streams} streams of {steps} steps of {bytes} bytes do not fill {} bytes of payload",
            payload.len()
        );
        CodecError::check(fits, why)
    }
}

/// Transitions that a chunk of any run may have, because an actor may have this many environments whatever the settings say.
const TRANSITIONS_MAX_LEAST: u64 = 4096;

/// Returns the transitions in the longest chunk of a run, from its settings `actor.envs`, `steps_per_chunk` and `round_transitions_max`.
/// The result is at least 4,096, because an actor may have up to that many environments (`--envs`).
pub fn transitions_max(envs: u32, steps_per_chunk: u32, round_transitions_max: Option<u64>) -> u64 {
    let envs = u64::from(envs);
    let whole = envs.saturating_mul(steps_per_chunk.into());
    let longest = round_transitions_max.map_or(whole, |round| whole.min(round.max(envs)));
    longest.max(TRANSITIONS_MAX_LEAST)
}

/// Consecutive steps of several streams: row `stream * steps + step` is (s_t, a_t, r_t, end of step t).
///
/// The buffer holds, one after the other: frames [rows, frame bytes], actions [rows], ends [rows], rewards [rows] f32 little-endian.
#[derive(Clone, Debug, PartialEq)]
pub struct Chunk {
    /// The chunk's header.
    pub header: ChunkHeader,
    payload: Buffer,
}

impl Chunk {
    /// Creates a chunk of zeros, to be filled in place.
    pub fn zeroed(header: ChunkHeader) -> Self {
        let bytes = header
            .payload_bytes()
            .expect("an actor's chunk is far below the address space");
        Self::with_buffer(header, Buffer::zeroed(bytes))
    }

    /// Creates a chunk in memory with arbitrary content; the caller must write every row.
    pub fn with_buffer(header: ChunkHeader, payload: Buffer) -> Self {
        let bytes = header.payload_bytes();
        assert_eq!(Some(payload.len()), bytes, "memory for a chunk");
        Self { header, payload }
    }

    /// The ranges of frames, actions, ends and rewards in the payload, one after the other.
    fn columns(&self) -> [Range<usize>; 4] {
        let rows = self.header.transitions();
        let frame_bytes = self.header.frame_bytes as usize;
        let mut end = 0;
        [frame_bytes, 1, size_of::<End>(), size_of::<f32>()].map(|bytes| {
            let start = end;
            end += rows * bytes;
            start..end
        })
    }

    /// Frames [rows, frame bytes].
    pub fn frames(&self) -> &[u8] {
        let [frames, ..] = self.columns();
        &self.payload[frames]
    }

    /// Actions [rows].
    pub fn actions(&self) -> &[u8] {
        let [_, actions, ..] = self.columns();
        &self.payload[actions]
    }

    /// Ends [rows], as bytes of [`End`].
    pub fn ends(&self) -> &[u8] {
        let [_, _, ends, _] = self.columns();
        &self.payload[ends]
    }

    /// The end of one row; every byte was checked when the chunk was made or decoded.
    pub fn end(&self, row: usize) -> End {
        End::from_byte(self.ends()[row]).expect("checked when the chunk was decoded")
    }

    /// The reward of one row.
    pub fn reward(&self, row: usize) -> f32 {
        let [.., rewards] = self.columns();
        let (rewards, _) = self.payload[rewards].as_chunks();
        f32::from_le_bytes(rewards[row])
    }

    /// The place of `row`'s frame, for writing.
    pub fn frame_mut(&mut self, row: usize) -> &mut [u8] {
        let bytes = self.header.frame_bytes as usize;
        &mut self.payload[row * bytes..(row + 1) * bytes]
    }

    /// Writes action, reward and end of one row.
    pub fn set(&mut self, row: usize, action: u8, reward: f32, end: End) {
        let rows = self.header.transitions();
        assert!(row < rows, "row {row} of a chunk of {rows}");
        let [_, actions, ends, rewards] = self.columns();
        self.payload[actions][row] = action;
        self.payload[ends][row] = end as u8;
        let (rewards, _) = self.payload[rewards].as_chunks_mut();
        rewards[row] = reward.to_le_bytes();
    }

    /// The payload: all columns, one after the other.
    pub fn payload(&self) -> &[u8] {
        &self.payload
    }

    /// The payload, to be sent after the header.
    pub fn into_payload(self) -> Buffer {
        self.payload
    }

    /// Decodes a chunk in one buffer and checks lengths, ends and rewards.
    pub fn decode(bytes: &[u8], spec_hash: u64) -> Result<Self, CodecError> {
        let (header, payload) = codec::decode(bytes, Some(spec_hash))?;
        Self::from_payload(header, payload.to_vec().into())
    }

    /// Makes a chunk of a received header and payload, with all checks of [`Chunk::decode`].
    pub fn from_payload(header: ChunkHeader, payload: Buffer) -> Result<Self, CodecError> {
        header.check_payload(&payload)?;
        let chunk = Self { header, payload };
        if let Some(end) = chunk.ends().iter().find(|&&e| End::from_byte(e).is_none()) {
            return Err(CodecError::Header(format!("unknown end {end}")));
        }
        let mut rows = 0..header.transitions();
        if let Some(row) = rows.find(|&row| !chunk.reward(row).is_finite()) {
            return Err(CodecError::Header(format!(
                "the reward of row {row} is not finite"
            )));
        }
        Ok(chunk)
    }
}

/// Asks whether the replay server has stored a chunk that it keeps until its rate limiter has room. An actor that makes its environments
/// asks about its first chunk, to learn whether the run is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChunkPoll {
    /// The actor's number in the run.
    pub actor: u32,
    /// The actor's incarnation.
    pub incarnation: u64,
    /// Number of the chunk within the incarnation.
    pub sequence: u64,
    /// Whether the actor is shutting down. The rate limiter then lets the chunk pass.
    pub leaving: bool,
}

impl ChunkPoll {
    /// The poll of an actor that stays.
    pub const fn new(actor: u32, incarnation: u64, sequence: u64) -> Self {
        Self {
            actor,
            incarnation,
            sequence,
            leaving: false,
        }
    }
}

/// The replay server's reply to a chunk or a poll.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum InsertReply {
    /// The chunk is stored, now or by an earlier attempt. The actor may drop it.
    Stored {
        /// Transitions that the run has stored.
        inserted_total: u64,
        /// Number of connected actors, from which actors choose the length of their chunks.
        actors: u32,
        /// Whether the chunk had to wait for the rate limiter.
        waited: bool,
    },
    /// The chunk is not stored yet: the rate limiter has no room.
    Wait {
        /// Transitions that the run has stored.
        inserted_total: u64,
        /// Whether the replay server keeps the chunk to store it later. If not, the actor must resend it instead of polling.
        kept: bool,
    },
    /// The chunk is not stored, because chunks before it are missing. The actor resends from its first unacknowledged chunk on.
    OutOfOrder {
        /// The expected sequence number, for messages to the user.
        expected: u64,
    },
    /// The chunk is not stored: the run has all its transitions.
    Finished {
        /// Transitions that the run has stored.
        inserted_total: u64,
    },
    /// The chunk will never be stored.
    Refused {
        /// The replay server's reason, a sentence.
        why: String,
    },
}
