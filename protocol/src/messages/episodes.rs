//! The ended episodes, one by one, for the recorder of the run.
//! The newest returns and their mean are in `status`.

use serde::{Deserialize, Serialize};

use crate::wire::{error::CodecError, message::check_no_payload};

/// Most episodes in one reply; the requester asks again for the rest. With the longest numbers, a reply takes half of the longest header.
pub const EPISODES_MAX: usize = 8_192;

/// Asks for the episodes that ended after the first `since`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EpisodesRequest {
    /// Episodes that the requester already has.
    pub since: u64,
    /// Whether the requester is the run's launcher. The replay server keeps the newest 32,768 episodes until the launcher has
    /// them, whatever others have, and 1,024 on disk.
    pub is_launcher: bool,
}

/// An episode that ended: by the rules of the world, or by its step limit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EndedEpisode {
    /// Transitions that the run had stored once it had stored the chunk with the episode's end.
    pub frames: u64,
    /// The actor that played it.
    pub actor: u32,
    /// The actor's environment in which it was played, from 0.
    pub env: u32,
    /// Return and length of the whole episode; `None` if a part of it was lost.
    pub totals: Option<Totals>,
}

/// Return and length of an episode of which no part was lost, up to some step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Totals {
    /// Sum of the rewards as the world gave them, undiscounted.
    pub episode_return: f64,
    /// Environment steps, the last one included.
    pub steps: u64,
}

/// Episodes in the order in which their ends were stored.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodesReply {
    /// Number of episodes that ended in all. If it is less than the requester has, this replay server has restarted its count.
    pub ended: u64,
    /// Number of episodes that ended before the first of these. If it is more than `since`, those between are no longer kept.
    pub before: u64,
    /// The episodes, at most [`EPISODES_MAX`].
    pub episodes: Vec<EndedEpisode>,
}

impl EpisodesReply {
    /// Number of episodes that ended up to the last of these.
    pub const fn next_since(&self) -> u64 {
        self.before.saturating_add(self.episodes.len() as u64)
    }

    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        let (count, before, ended) = (self.episodes.len(), self.before, self.ended);
        let fits = self.next_since() <= ended && count <= EPISODES_MAX;
        let why = format_args!("{count} episodes after {before}, but only {ended} have ended");
        CodecError::check(fits, why)?;
        check_no_payload(payload)
    }
}
