//! The small messages that need no file of their own: an actor's goodbye, the learner's affinity, and the status.
//! None of them ever waits.

use driml_protocol::{AffinityUpdate, Done, Goodbye};
use zenoh::query::Query;

use super::server::Service;

impl Service {
    pub(super) fn goodbye(&self, query: Query) {
        if let Some(goodbye) = self.read::<Goodbye>(&query) {
            self.state().replay.goodbye(&goodbye);
            self.reply(&query, &Done);
        }
    }

    pub(super) fn affinity(&self, query: Query) {
        let Some(update) = self.read::<AffinityUpdate>(&query) else {
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
        drop(state);
        match set {
            Ok(()) => self.reply(&query, &Done),
            Err(why) => tracing::warn!("an affinity matrix was refused: {why}"),
        }
    }

    pub(super) fn status(&self, query: Query) {
        let state = self.state();
        let mut status = state.replay.status();
        status.actors_acting = state.members.actors_acting();
        status.actors_waiting = state.chunks.len() as u32;
        status.answer_ms = state.timings.answer_ms();
        status.insert_ms = state.timings.insert_ms();
        status.weights_behind_s = state.timings.weights_behind_s();
        status.weights_behind_updates = state.timings.weights_behind_updates();
        drop(state);
        self.reply(&query, &status);
    }
}
