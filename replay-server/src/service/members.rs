//! Who takes part: which actors and which learner have joined, and who of them is connected.
//! It keeps no counts of transitions or rows: those are the core's.

use std::collections::HashSet;

use driml_protocol::{ActorJoin, Alive, Hello, JoinReply, Kind, LearnerJoin};
use zenoh::{query::Query, sample::SampleKind};

use super::{Service, State};
use crate::replay::Replay;

/// What is known of the parts of the run.
#[derive(Default)]
pub(super) struct Members {
    connected: HashSet<Alive>,
    /// Actors of which a chunk has come.
    acting: HashSet<u32>,
    /// The learner that is served.
    learner: Option<u64>,
}

impl Members {
    /// Takes note that a part is connected, or no longer.
    fn note(&mut self, who: Alive, is_connected: bool) {
        if is_connected {
            self.connected.insert(who);
        } else {
            self.connected.remove(&who);
        }
    }

    /// Actors that are connected and have joined.
    fn actors(&self, replay: &Replay) -> u32 {
        let takes_part = |who: &&Alive| match **who {
            Alive::Actor { actor, epoch } => replay.actor_epoch(actor) == Some(epoch),
            Alive::Learner(_) => false,
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

impl Service {
    pub(super) fn note_alive(&self, who: Alive, kind: SampleKind) {
        let mut state = self.state();
        state.members.note(who, kind == SampleKind::Put);
        state.count_actors();
    }

    pub(super) fn hello(&self, query: Query) {
        let state = self.state();
        let (inserted_total, tally) = (state.replay.inserted_total(), state.replay.tally());
        drop(state);
        let hello = Hello {
            config_toml: self.config_toml.clone(),
            inserted_total,
            tally,
            after_updates: self.after_updates,
            shard: self.shard,
            shared_memory: self.shared_memory,
        };
        self.reply(&query, Kind::Hello, &hello);
    }

    pub(super) fn join_actor(&self, query: Query) {
        if let Some(join) = self.read::<ActorJoin>(&query, Kind::ActorJoin) {
            let reply = self.state().join_actor(join);
            self.welcome(&query, reply);
        }
    }

    pub(super) fn join_learner(&self, query: Query) {
        if let Some(join) = self.read::<LearnerJoin>(&query, Kind::LearnerJoin) {
            let reply = self.state().join_learner(join);
            self.changed.notify_all();
            self.welcome(&query, reply);
        }
    }

    /// Answers a part that joins: how many lives it had before, or why it is not taken.
    fn welcome(&self, query: &Query, joined: Result<u32, Rejection>) {
        let reply = match joined {
            Ok(earlier_lives) => JoinReply::Welcome {
                inserted_total: self.state().replay.inserted_total(),
                weights_version: self.weights().version(),
                earlier_lives,
            },
            Err(Rejection::Taken(why)) => JoinReply::Taken { why },
            Err(Rejection::Refused(why)) => {
                tracing::warn!("a part was not let in: {why}");
                self.state().replay.note_refused_message();
                JoinReply::Refused { why }
            }
        };
        self.reply(query, Kind::JoinReply, &reply);
    }
}

/// Why a part is not taken.
enum Rejection {
    /// Not yet: another process is connected that plays it.
    Taken(String),
    /// Never.
    Refused(String),
}

impl State {
    fn count_actors(&mut self) {
        let actors = self.members.actors(&self.replay);
        self.replay.set_actors(actors);
    }

    /// Takes an actor that may take part; gives the number of its earlier lives.
    fn join_actor(&mut self, join: ActorJoin) -> Result<u32, Rejection> {
        let ActorJoin { actor, epoch } = join;
        let other = self
            .replay
            .actor_epoch(actor)
            .filter(|&other| other != epoch);
        let connected = |epoch| {
            self.members
                .connected
                .contains(&Alive::Actor { actor, epoch })
        };
        if other.is_some_and(connected) {
            return Err(Rejection::Taken(format!(
                "another process is actor {actor} of this run: give each actor a number of its own (--id)"
            )));
        }
        let earlier_lives = self.replay.join_actor(join).map_err(Rejection::Refused)?;
        self.count_actors();
        if other.is_some() {
            // A chunk that was left behind.
            self.chunks.take(actor);
        }
        Ok(earlier_lives)
    }

    fn join_learner(&mut self, join: LearnerJoin) -> Result<u32, Rejection> {
        let LearnerJoin {
            learner,
            rows_sampled,
        } = join;
        let other = self.members.learner.filter(|&other| other != learner);
        let connected = |other| self.members.connected.contains(&Alive::Learner(other));
        if other.is_some_and(connected) {
            let why = "another learner takes part in this run, which has one alone";
            return Err(Rejection::Taken(why.into()));
        }
        // The same one asks again when it has not heard the answer.
        if self.members.learner != Some(learner) {
            self.replay
                .learner_starts(rows_sampled)
                .map_err(Rejection::Refused)?;
            self.members.learner = Some(learner);
            self.requests.keep_only(learner);
        }
        Ok(0)
    }
}
