//! Who is connected, and which actors have delivered.
//! Who has joined, and all counts, are the core's.

use std::collections::HashSet;

use driml_protocol::Alive;

use crate::{ledger::actors::ACTORS_MAX, replay::Replay};

/// Parts that are known to be connected at a time, far more than take part: further ones count as absent.
const CONNECTED_MAX: usize = 4 * ACTORS_MAX;

/// What is known of the parts of the run.
#[derive(Default)]
pub(super) struct Members {
    pub(super) connected: HashSet<Alive>,
    /// Actors of which a chunk has come.
    acting: HashSet<u32>,
}

impl Members {
    /// Takes note that a part is connected, or no longer.
    pub(super) fn note(&mut self, who: Alive, is_connected: bool) {
        if is_connected {
            if self.connected.len() < CONNECTED_MAX {
                self.connected.insert(who);
            }
        } else {
            self.connected.remove(&who);
        }
    }

    /// Whether this life of an actor is connected.
    pub(super) fn is_connected(&self, actor: u32, incarnation: u64) -> bool {
        self.connected.contains(&Alive::actor(actor, incarnation))
    }

    /// Actors that are connected and have joined.
    pub(super) fn actors(&self, replay: &Replay) -> u32 {
        let takes_part = |who: &&Alive| match **who {
            Alive::Actor { actor, .. } => replay
                .actor_incarnation(actor)
                .is_some_and(|life| Alive::actor(actor, life) == **who),
            Alive::Learner { .. } => false,
        };
        self.connected.iter().filter(takes_part).count() as u32
    }

    /// Nobody is connected yet; chunks of these actors have come before.
    pub(super) fn with_acting(actors: impl Iterator<Item = u32>) -> Self {
        Self {
            connected: HashSet::new(),
            acting: actors.collect(),
        }
    }

    /// A chunk of an actor has come.
    pub(super) fn note_acting(&mut self, actor: u32) {
        self.acting.insert(actor);
    }

    /// Actors of which a chunk has come, those that have ended too.
    pub(super) fn actors_acting(&self) -> u32 {
        self.acting.len() as u32
    }
}
