//! Priorities that the learner sends back, each taken once, and what of them is kept where a run is to go on exactly.
//! What they do to draws is `sampling::prioritised`'s business.

use driml_protocol::PriorityUpdate;

use super::Replay;
use crate::sampling::prioritised::{PriorityCounts, SavedPriorities};

impl Replay {
    /// The same, drawing under this number: priorities of rows that were drawn under another one are counted and change nothing.
    /// Whoever starts a replay server again that numbers its transitions anew, or lost some, gives another.
    #[must_use]
    pub const fn with_incarnation(mut self, incarnation: u64) -> Self {
        self.origin.incarnation = incarnation;
        self
    }

    /// Takes the priorities of rows that were drawn here; those of other shards are none of its business. An update that has come
    /// before changes nothing, nor does a row whose transition was overwritten meanwhile: both are counted.
    ///
    /// # Errors
    /// A run that draws uniformly, or a transition that was never stored; the reason, for a person. Nothing has then changed.
    pub fn set_priorities(&mut self, update: &PriorityUpdate) -> Result<(), String> {
        let Some(priorities) = &mut self.priorities else {
            return Err("priorities, in a run that draws uniformly".into());
        };
        let own = || {
            let parts = update.parts.iter();
            parts.filter(|part| part.origin.shard == self.origin.shard)
        };
        let stored = self.ring.inserted();
        for part in own().filter(|part| part.origin == self.origin) {
            if let Some(index) = part.transitions.iter().find(|&&index| index >= stored) {
                return Err(format!(
                    "a priority of transition {index}, where {stored} were stored"
                ));
            }
        }
        let is_new = priorities.is_new(update.learner, update.number);
        for part in own() {
            let rows = part.transitions.len();
            if !is_new {
                priorities.note_repeated(rows);
            } else if part.origin == self.origin {
                priorities.update(&self.ring, part);
            } else {
                priorities.note_gone(rows);
            }
        }
        Ok(())
    }

    /// What became of the priorities that came; none where rows are drawn uniformly.
    pub fn priority_counts(&self) -> Option<PriorityCounts> {
        Some(self.priorities.as_ref()?.counts())
    }

    /// What a run that is to go on exactly keeps of priorities; none where rows are drawn uniformly.
    pub fn saved_priorities(&self) -> Option<SavedPriorities> {
        Some(self.priorities.as_ref()?.saved(&self.ring))
    }

    /// Takes back [`Replay::saved_priorities`] of a replay that held what this one does.
    ///
    /// # Errors
    /// It held something else, or drew by another rule; the reason, for a person.
    pub fn restore_priorities(&mut self, saved: Option<&SavedPriorities>) -> Result<(), String> {
        match (&mut self.priorities, saved) {
            (None, None) => Ok(()),
            (Some(priorities), Some(saved)) => priorities.restore(&self.ring, saved),
            _ => Err("replay.sampling is another rule than it was".into()),
        }
    }

    /// Takes note that transitions were let go.
    pub(super) fn forget_priorities(&mut self) {
        if let Some(priorities) = &mut self.priorities {
            priorities.forget(&self.ring);
        }
    }
}
