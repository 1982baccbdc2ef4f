//! Processes that join: the information that they receive about the run, and whether they are admitted.
//! `participants` tracks which processes are connected.

use std::time::Instant;

use driml_protocol::{
    ActorJoin, Incoming, JoinReply, LearnerJoin, Peer, ProcessName, Request, RunInfo, Welcome,
};
use zenoh::sample::SampleKind;

use super::{
    limits::SHARED_INCARNATIONS_MAX,
    server::{Service, State},
};

impl Service {
    pub(super) fn update_connection(&self, who: Peer, kind: SampleKind) {
        let (mut state, now) = (self.state(), Instant::now());
        let is_connected = kind == SampleKind::Put;
        state.participants.set_connected(who, is_connected, now);
        let joined = match who.process {
            ProcessName::Actor(actor) => state.replay.actor_incarnation(actor),
            ProcessName::Learner => state.replay.learner_id(),
        };
        // A process that joined before the server restarted with its replay does not join again.
        if joined.is_some_and(|number| Peer::new(who.process, number) == who) {
            state.participants.add_joined(who, now);
        }
        state.update_actor_count();
    }

    pub(super) fn run_info(&self, incoming: Incoming<RunInfo>) {
        let state = self.state();
        let incarnations = state.participants.actor_incarnations();
        let run_info = RunInfo {
            config_toml: self.config_toml.clone(),
            inserted_total: state.replay.inserted_total(),
            has_learner: state.replay.learner_id().is_some(),
            after_updates: state.replay.resumed_after_updates(),
            shard: self.shard,
            shared_memory: self.reads_shared_memory && incarnations < SHARED_INCARNATIONS_MAX,
        };
        drop(state);
        incoming.into_responder().reply(&run_info);
    }

    /// Answers a process that joins: its number of earlier incarnations, or why it is rejected or has to wait.
    pub(super) fn join<J: Request<Reply = JoinReply>>(
        &self,
        incoming: Incoming<J>,
        join: impl Fn(&mut State, J) -> Result<u32, JoinReply>,
    ) {
        let weights_version = self.weights().newest_version();
        self.answer(incoming, |state, request| {
            // Each join that the disk rejects would make the pending records longer, so at most one is among them.
            let joined = state.replay.write_pending().then(|| join(state, request));
            let (Some(joined), true) = (joined, state.replay.write_pending()) else {
                let why = "the replay server cannot write its log; its output says why".into();
                return Some(JoinReply::Wait { why });
            };
            let reply = match joined {
                Ok(earlier_incarnations) => JoinReply::Welcome(Welcome {
                    inserted_total: state.replay.inserted_total(),
                    weights_version,
                    earlier_incarnations,
                }),
                Err(rejected) => rejected,
            };
            if let JoinReply::Refused { why } = &reply {
                state.reject(J::NAME, why);
            }
            self.changed.notify_all();
            Some(reply)
        });
    }
}

fn refused_reply(why: String) -> JoinReply {
    JoinReply::Refused { why }
}

impl State {
    fn update_actor_count(&mut self) {
        self.replay.counters_mut().actors = self.participants.actors_connected();
    }

    /// Checks that `learner` is the learner that is served. If not, the error says what happened, for a person.
    pub(super) fn check_learner(&self, learner: u64) -> Result<(), String> {
        match self.replay.learner_id() {
            Some(served) if served == learner => Ok(()),
            Some(_) => Err("another learner has joined the run since this one did: a run has one learner".into()),
            None => Err("this replay server does not know the learner: the server has restarted since the learner joined, and has lost \
                         its transitions. Start the learner and the actors again: the learner resumes from its newest checkpoint"
                .into()),
        }
    }

    pub(super) fn join_actor(&mut self, join: ActorJoin) -> Result<u32, JoinReply> {
        let ActorJoin { actor, incarnation } = join;
        let known = self.replay.actor_incarnation(actor);
        let other = known.filter(|&other| other != incarnation);
        let participants = &mut self.participants;
        let is_connected = |actor, it| participants.is_connected(Peer::actor(actor, it));
        if other.is_some_and(|it| is_connected(actor, it)) {
            let why = format!(
                "another process is actor {actor} of this run: give each actor another number (--id)"
            );
            return Err(JoinReply::Taken { why });
        }
        // Otherwise a process that joins under one number after another would use up all numbers.
        let absent = self.replay.forget_absent(actor, is_connected);
        participants.forget(&absent);
        let earlier_incarnations = self.replay.join_actor(join).map_err(refused_reply)?;
        participants.add_joined(Peer::actor(actor, incarnation), Instant::now());
        self.update_actor_count();
        if other.is_some() {
            // Drops a parked chunk of the earlier incarnation.
            self.chunks.remove(actor);
        }
        Ok(earlier_incarnations)
    }

    pub(super) fn join_learner(&mut self, join: LearnerJoin) -> Result<u32, JoinReply> {
        let (learner, updates) = (join.learner, join.updates);
        let served = self.replay.learner_id();
        let other = served.filter(|&other| other != learner);
        if other.is_some() && self.participants.is_run_over() {
            let done = self.replay.status().updates;
            return Err(refused_reply(format!(
                "the run is finished, with {done} updates; to continue the training, resume it with more --frames"
            )));
        }
        if other.is_some_and(|other| self.participants.is_connected(Peer::learner(other))) {
            let why = "another learner takes part in this run, which has only one".into();
            return Err(JoinReply::Taken { why });
        }
        let repeated = self.replay.join_learner(join).map_err(refused_reply)?;
        if repeated > 0 {
            tracing::warn!(
                "the learner resumes from its checkpoint after {updates} updates, and repeats the later ones: {repeated}"
            );
        }
        if served != Some(learner) {
            self.requests.retain(|it| it.request.learner == learner);
            self.participants
                .add_joined(Peer::learner(learner), Instant::now());
        }
        Ok(0)
    }
}
