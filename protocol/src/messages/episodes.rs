//! The episodes that ended, one by one, for the recorder of the run.
//! Means over the newest of them are in `status`.

use serde::{Deserialize, Serialize};

use crate::wire::{error::CodecError, message::no_payload};

/// Most episodes in one answer; those after it are asked for again. With the longest numbers it takes half of what a header may.
pub const EPISODES_MAX: usize = 8_192;

/// Asks for the episodes that ended after the first `since`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EpisodesRequest {
    /// Episodes that the asker knows of already.
    pub since: u64,
    /// The asker is the run's launcher: what it does not know of is kept, whatever others know.
    pub is_launcher: bool,
}

/// An episode that ended: by the rules of the world, or by its step limit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EndedEpisode {
    /// Transitions that the run had stored with the chunk that held its end.
    pub frames: u64,
    /// The actor that played it.
    pub actor: u32,
    /// The actor's environment in which it was played, from 0.
    pub env: u32,
    /// What all of it earned; none if a part of it was lost.
    pub played: Option<Played>,
}

/// What is known of an episode of which all was seen, up to some step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Played {
    /// Sum of the rewards as the world gave them, undiscounted.
    pub episode_return: f64,
    /// Environment steps, the last one included.
    pub steps: u64,
}

/// Episodes in the order in which their ends were stored.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodesReply {
    /// How many ended in all. Fewer than the asker knows of: this replay server counts anew.
    pub ended: u64,
    /// How many ended before the first of these. More than were asked for: those between are not kept any more.
    pub before: u64,
    /// At most [`EPISODES_MAX`].
    pub episodes: Vec<EndedEpisode>,
}

impl EpisodesReply {
    /// How many ended up to the last of these.
    pub const fn up_to(&self) -> u64 {
        self.before.saturating_add(self.episodes.len() as u64)
    }

    pub(super) fn checked(&self, payload: &[u8]) -> Result<(), CodecError> {
        if self.up_to() > self.ended || self.episodes.len() > EPISODES_MAX {
            return Err(CodecError::Header(format!(
                "{} episodes after {}, where {} ended",
                self.episodes.len(),
                self.before,
                self.ended
            )));
        }
        no_payload(payload)
    }
}
