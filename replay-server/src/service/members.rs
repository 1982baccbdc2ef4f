//! Who takes part: which actors and which learner have joined, and who of them is connected.
//! It keeps no counts of transitions or rows: those are the core's.

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
    /// The learner that is served.
    pub(super) learner: Option<u64>,
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

    /// A chunk of an actor has come.
    pub(super) fn note_acting(&mut self, actor: u32) {
        self.acting.insert(actor);
    }

    /// Actors of which a chunk has come, those that have ended too.
    pub(super) fn actors_acting(&self) -> u32 {
        self.acting.len() as u32
    }

    /// Whether `learner` is the one that is served.
    ///
    /// # Errors
    /// It is not; what happened, for a person.
    pub(super) fn check_learner(&self, learner: u64) -> Result<(), String> {
        match self.learner {
            Some(served) if served == learner => Ok(()),
            Some(_) => Err("another learner has joined the run since this one did: a run has one learner".into()),
            None => Err("this replay server does not know the learner: it was started anew since the learner joined, and what it \
                         held is gone. To go on with the run, start it with --after-updates and the number of the newest checkpoint, \
                         and then the learner and the actors again"
                .into()),
        }
    }
}
