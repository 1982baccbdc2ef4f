//! Transitions on their way from an actor to the replay server, the question about those that have to wait, and the answers.
//! It does not decide what is stored: exactly-once and order are the replay server's.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::wire::{buffers::Buffer, codec, error::CodecError};

/// Bytes of one transition in a chunk beside its frame: an action, an end and a reward.
pub const TRANSITION_BYTES: usize = size_of::<u8>() + size_of::<End>() + size_of::<f32>();
const _: () = assert!(TRANSITION_BYTES == 6);

/// What a step ended, if anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum End {
    /// The episode continues with the next step.
    Running = 0,
    /// A level: a boundary for DIM, not for the return.
    LevelChange = 1,
    /// The episode, by its step limit.
    TimedOut = 2,
    /// The episode, by the rules of the world.
    Terminal = 3,
}

impl End {
    /// The end that `byte` stands for.
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

/// What a chunk says of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChunkHeader {
    /// Which actor, unique in the run.
    pub actor: u32,
    /// Which life of that actor: drawn anew at each start.
    pub incarnation: u64,
    /// Number of the chunk within the incarnation, from 0.
    pub sequence: u64,
    /// Transitions that this incarnation produced before this chunk: the second count, by which loss shows.
    pub first_transition: u64,
    /// The weights that chose every action of this chunk; 0 before the first.
    pub weights_version: u64,
    /// The actor was told to stop and sends what it has left: the rate limiter lets it pass.
    pub leaving: bool,
    /// Environments, one stream each.
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

    /// Bytes of the payload of such a chunk; none if they are more than the address space.
    pub fn payload_bytes(&self) -> Option<usize> {
        self.transitions()
            .checked_mul(self.frame_bytes as usize + TRANSITION_BYTES)
    }

    pub(super) fn checked(&self, payload: &[u8]) -> Result<(), CodecError> {
        if self.payload_bytes() == Some(payload.len()) && self.transitions() > 0 {
            return Ok(());
        }
        Err(CodecError::Header(format!(
            "{} streams of {} steps of {} bytes do not fill {} bytes of payload",
            self.streams,
            self.steps,
            self.frame_bytes,
            payload.len()
        )))
    }
}

/// Transitions that a chunk of any run may have: an actor may step so many environments, whatever the settings say.
const TRANSITIONS_LEAST: u64 = 4096;

/// Transitions that the longest chunk of a run has, by its settings `actor.envs`, `steps_per_chunk` and `round_transitions_max`;
/// at least 4,096, as an actor may step up to so many environments (`--envs`).
pub fn transitions_max(envs: u32, steps_per_chunk: u32, round_transitions_max: Option<u64>) -> u64 {
    let envs = u64::from(envs);
    let whole = envs.saturating_mul(steps_per_chunk.into());
    let longest = round_transitions_max.map_or(whole, |round| whole.min(round.max(envs)));
    longest.max(TRANSITIONS_LEAST)
}

/// Consecutive steps of several streams: row `stream * steps + step` is (s_t, a_t, r_t, what a_t ended).
///
/// Buffer, one after the other: frames [rows, frame bytes], actions [rows], ends [rows], rewards [rows] f32 little-endian.
#[derive(Clone, Debug, PartialEq)]
pub struct Chunk {
    /// What it says of itself.
    pub header: ChunkHeader,
    payload: Buffer,
}

impl Chunk {
    /// A chunk of zeros, to be filled in place.
    pub fn zeroed(header: ChunkHeader) -> Self {
        let bytes = header
            .payload_bytes()
            .expect("an actor's chunk is far below the address space");
        Self::in_memory(header, Buffer::zeroed(bytes))
    }

    /// A chunk in memory that may hold anything: every row is to be written.
    pub fn in_memory(header: ChunkHeader, payload: Buffer) -> Self {
        let bytes = header.payload_bytes();
        assert_eq!(Some(payload.len()), bytes, "memory for a chunk");
        Self { header, payload }
    }

    /// Where its frames, actions, ends and rewards lie in the payload, one after the other.
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

    /// Where row's frame is written.
    pub fn frame_mut(&mut self, row: usize) -> &mut [u8] {
        let bytes = self.header.frame_bytes as usize;
        &mut self.payload[row * bytes..(row + 1) * bytes]
    }

    /// Writes everything of one row but its frame.
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

    /// The payload, to travel after the header.
    pub fn into_payload(self) -> Buffer {
        self.payload
    }

    /// Reads a chunk in one piece and checks lengths, ends and rewards.
    pub fn decode(bytes: &[u8], spec_hash: u64) -> Result<Self, CodecError> {
        let (header, payload) = codec::decode(bytes, Some(spec_hash))?;
        Self::from_payload(header, payload.to_vec().into())
    }

    /// The chunk of a header and payload that were received; checks all that [`Chunk::decode`] does.
    pub fn from_payload(header: ChunkHeader, payload: Buffer) -> Result<Self, CodecError> {
        header.checked(&payload)?;
        let chunk = Self { header, payload };
        if let Some(end) = chunk.ends().iter().find(|&&e| End::from_byte(e).is_none()) {
            return Err(CodecError::Header(format!("end {end} is none that exists")));
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

/// Asks what became of a chunk that the replay server keeps until its limiter opens: the chunk's header without its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChunkPoll {
    /// The actor's number in the run.
    pub actor: u32,
    /// Which life of that actor.
    pub incarnation: u64,
    /// Number of the chunk within the incarnation.
    pub sequence: u64,
    /// The actor was told to stop: the rate limiter lets the chunk pass.
    pub leaving: bool,
}

/// The replay server's answer to a chunk or a poll.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum InsertReply {
    /// Stored, now or by an earlier try: the actor may forget it.
    Stored {
        /// Transitions that the run has stored.
        inserted_total: u64,
        /// Actors that are connected, by which they choose the length of their chunks.
        actors: u32,
        /// Whether the chunk had to wait for the rate limiter.
        waited: bool,
    },
    /// Not stored yet: the rate limiter has no room.
    Wait {
        /// Transitions that the run has stored.
        inserted_total: u64,
        /// Whether the replay server keeps the chunk and will store it: then a [`ChunkPoll`] is enough, else it must be sent again.
        kept: bool,
    },
    /// Not stored: chunks before it are missing. The sender repeats them from its first that was not acknowledged.
    OutOfOrder {
        /// The sequence number that is expected, for a person.
        expected: u64,
    },
    /// Not stored, and no longer wanted: the run has all the transitions it asked for.
    Finished {
        /// Transitions that the run has stored.
        inserted_total: u64,
    },
    /// Not stored, and never will be: the reason, for a person.
    Refused {
        /// The replay server's reason, a sentence.
        why: String,
    },
}
