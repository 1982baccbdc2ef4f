//! The small messages that need no file of their own: an actor's goodbye, the learner's affinity, and the status.
//! None of them ever waits.

use driml_protocol::{AffinityUpdate, Done, Goodbye, Incoming, ReplayStatus, Responder};

use super::server::Service;

impl Service {
    pub(super) fn goodbye(&self, incoming: Incoming<Goodbye>) {
        if let Some(goodbye) = self.read(&incoming) {
            let mut state = self.state();
            if let Some(why) = state.replay.goodbye(&goodbye) {
                state.say("goodbye", &format!("a goodbye was refused: {why}"));
            }
            drop(state);
            // Whoever says goodbye has nothing to do any more, with whatever it has said.
            incoming.into_responder().reply(&Done);
        }
    }

    pub(super) fn affinity(&self, incoming: Incoming<AffinityUpdate>) {
        let Some(update) = self.read(&incoming) else {
            return;
        };
        let mut state = self.state();
        let set = match state.members.check_learner(update.learner) {
            Ok(()) => state
                .replay
                .set_affinity(&update)
                .map_err(|e| e.to_string()),
            Err(why) => {
                state.replay.note_refused_message();
                Err(why)
            }
        };
        if let Err(why) = set {
            state.say(
                "affinity",
                &format!("an affinity matrix was refused: {why}"),
            );
            return;
        }
        drop(state);
        incoming.into_responder().reply(&Done);
    }

    pub(super) fn status(&self, responder: Responder<ReplayStatus>) {
        let state = self.state();
        let mut status = state.replay.status();
        status.connections_refused = state.connections_refused;
        status.actors_acting = state.members.actors_acting();
        status.actors_waiting = state.chunks.len() as u32;
        status.answer_ms = state.timings.answer_ms();
        status.insert_ms = state.timings.insert_ms();
        status.weights_behind_s = state.timings.weights_behind_s();
        status.weights_behind_updates = state.timings.weights_behind_updates();
        drop(state);
        responder.reply(&status);
    }
}
