//! Prioritised sampling, the proportional rule: the chance of an anchor is its priority to the power of alpha, over the sum of all.
//! It does not weigh rows (the learner does, by the chances that travel with a batch) and computes no priority.
//!
//! Source: Schaul et al. 2016, Prioritized Experience Replay; Hessel et al. 2018, Rainbow, where a priority is the row's C51 loss.
//! A transition that nothing was learned from has the highest priority seen, as in both. Rows are drawn with replacement and each from
//! all, not one from each of B strata: every row follows the law.

use std::collections::{BTreeMap, VecDeque};

use driml_protocol::PriorityPart;
use rand::Rng;
use serde::{Deserialize, Serialize};

use super::{
    episodes::{Episodes, Window},
    sum_tree::SumTree,
};
use crate::storage::ring::{Link, Ring};

/// What is added to a priority before its power is taken, so that each transition can still be drawn. Castro et al. 2018, Dopamine,
/// add as much to the loss.
pub const PRIORITY_MIN: f64 = 1e-10;

/// Largest error of the chance that a batch says of a row, as a share of it: half of an f32's last place. One below 1.2e-38 is said to
/// be that.
pub const CHANCE_ERROR: f64 = 6.1e-8;

/// The highest priority before the first is known, as in Dopamine: any would do, as all are equal then.
const FIRST_PRIORITY: f64 = 1.0;

/// What became of the priorities that the learner has sent, in rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PriorityCounts {
    /// Rows whose transition has the priority now.
    pub set: u64,
    /// Rows whose transition was overwritten meanwhile, or was drawn by an earlier life of the replay server.
    pub gone: u64,
    /// Rows of updates that had come before.
    pub repeated: u64,
}

/// What cannot be told from the transitions held: for a run that is to go on exactly.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedPriorities {
    /// The highest priority seen.
    highest: f64,
    /// Of each transition held, the oldest first, its mass.
    masses: Vec<f64>,
    last: Option<(u64, u64)>,
    counts: PriorityCounts,
}

/// The priorities of the transitions held, those that can be anchors alone.
pub(crate) struct Priorities {
    alpha: f64,
    capacity: u64,
    /// Steps that must follow an anchor in its episode.
    reach: usize,
    /// By slot, the index modulo the capacity, (priority + [`PRIORITY_MIN`])^alpha; 0 where no anchor is.
    masses: SumTree,
    /// The highest priority seen.
    highest: f64,
    /// Transitions before this one have mass 0.
    oldest: u64,
    /// Transitions that more steps must follow, in the order of their episode, by the newest of each stream.
    open: BTreeMap<u64, VecDeque<u64>>,
    /// The learner that the last update came from, and its number.
    last: Option<(u64, u64)>,
    counts: PriorityCounts,
}

impl Priorities {
    /// Those of an empty ring of `capacity` transitions, where `reach` steps must follow an anchor.
    ///
    /// # Errors
    /// The system refuses to reserve that much memory: the bytes asked for.
    pub(crate) fn new(alpha: f64, capacity: u64, reach: u32) -> Result<Self, u64> {
        Ok(Self {
            alpha,
            capacity,
            reach: reach as usize,
            masses: SumTree::new(capacity)?,
            highest: FIRST_PRIORITY,
            oldest: 0,
            open: BTreeMap::new(),
            last: None,
            counts: PriorityCounts::default(),
        })
    }

    fn slot(&self, index: u64) -> usize {
        (index % self.capacity) as usize
    }

    fn mass(&self, priority: f64) -> f64 {
        (priority + PRIORITY_MIN).powf(self.alpha)
    }

    /// A run of consecutive transitions of one stream was stored, those from `first` on; `link` was the first one's.
    /// Whichever can be anchors now get the highest priority seen.
    pub(crate) fn stored(&mut self, ring: &Ring, episodes: &Episodes, first: u64, link: Link) {
        self.forget(ring);
        let waiting = match link {
            Link::Within { after } | Link::LevelStart { after } => self.open.remove(&after),
            Link::EpisodeStart | Link::Lost => None,
        };
        let mut waiting = waiting.unwrap_or_default();
        let mass = self.mass(self.highest);
        for index in first.max(ring.oldest())..ring.inserted() {
            waiting.push_back(index);
            let followed = if ring.step(index).end.is_episode_end() {
                waiting.len()
            } else {
                waiting.len().saturating_sub(self.reach)
            };
            for anchor in waiting.drain(..followed) {
                if anchor >= ring.oldest() && episodes.is_whole(ring, anchor) {
                    self.masses.set(self.slot(anchor), mass);
                }
            }
        }
        if !waiting.is_empty() {
            self.open.insert(ring.inserted() - 1, waiting);
        }
    }

    /// Transitions were let go: those before the oldest that is held are drawn no more.
    pub(crate) fn forget(&mut self, ring: &Ring) {
        let oldest = ring.oldest();
        let from = self.oldest.max(oldest.saturating_sub(self.capacity));
        for index in from..oldest {
            self.masses.set(self.slot(index), 0.0);
        }
        self.oldest = oldest;
        // Streams that ended in the midst of an episode.
        while let Some(stream) = self.open.first_entry()
            && *stream.key() < oldest
        {
            stream.remove();
        }
    }

    /// Leaves the window of an anchor, drawn by its priority, in `window`; false if there is none.
    pub(crate) fn draw(
        &mut self,
        ring: &Ring,
        episodes: &Episodes,
        rng: &mut impl Rng,
        window: &mut Window,
    ) -> bool {
        while let Some(slot) = self.masses.draw(rng) {
            let newest = ring.inserted() - 1;
            let behind = (self.slot(newest) + self.capacity as usize - slot) as u64 % self.capacity;
            if episodes.walk(ring, newest - behind, window) {
                return true;
            }
            // The first frame of its stack was overwritten: it is no anchor any more, and never again.
            self.masses.set(slot, 0.0);
        }
        false
    }

    /// The chance with which each draw gives the anchor `index`.
    pub(crate) fn chance(&self, index: u64) -> f64 {
        self.masses.get(self.slot(index)) / self.masses.total()
    }

    /// Whether an update of this number comes from `learner` for the first time; if so, it is remembered as the last.
    pub(crate) fn is_new(&mut self, learner: u64, number: u64) -> bool {
        let is_new = self
            .last
            .is_none_or(|last| last.0 != learner || number > last.1);
        if is_new {
            self.last = Some((learner, number));
        }
        is_new
    }

    /// Sets the priorities of rows that were drawn from `ring`. Of one transition that was drawn twice the last counts.
    pub(crate) fn update(&mut self, ring: &Ring, part: &PriorityPart) {
        for (&index, &priority) in part.transitions.iter().zip(&part.priorities) {
            let slot = self.slot(index);
            let is_held = (ring.oldest()..ring.inserted()).contains(&index);
            // What is no anchor has none.
            if !is_held || self.masses.get(slot) == 0.0 {
                self.counts.gone += 1;
                continue;
            }
            let priority = f64::from(priority);
            self.highest = self.highest.max(priority);
            self.masses.set(slot, self.mass(priority));
            self.counts.set += 1;
        }
    }

    /// Counts rows of an update that has come before.
    pub(crate) fn note_repeated(&mut self, rows: usize) {
        self.counts.repeated += rows as u64;
    }

    /// Counts rows that an earlier life drew.
    pub(crate) fn note_gone(&mut self, rows: usize) {
        self.counts.gone += rows as u64;
    }

    pub(crate) const fn counts(&self) -> PriorityCounts {
        self.counts
    }

    /// What a run that is to go on exactly keeps.
    pub(crate) fn saved(&self, ring: &Ring) -> SavedPriorities {
        let held = ring.oldest()..ring.inserted();
        SavedPriorities {
            highest: self.highest,
            masses: held.map(|i| self.masses.get(self.slot(i))).collect(),
            last: self.last,
            counts: self.counts,
        }
    }

    /// Takes back what was kept of a ring that holds what `ring` does.
    ///
    /// # Errors
    /// It held something else, or these are no masses; the reason, for a person.
    pub(crate) fn restore(&mut self, ring: &Ring, saved: &SavedPriorities) -> Result<(), String> {
        let held = ring.oldest()..ring.inserted();
        let (kept, count) = (saved.masses.len() as u64, held.end - held.start);
        if kept != count {
            return Err(format!(
                "priorities of {kept} transitions, where {count} are held"
            ));
        }
        let is_mass = |mass: &f64| mass.is_finite() && *mass >= 0.0;
        if !saved.masses.iter().chain([&saved.highest]).all(is_mass) {
            return Err("a priority that is no number from 0 on".into());
        }
        for (index, &mass) in held.zip(&saved.masses) {
            self.masses.set(self.slot(index), mass);
        }
        (self.highest, self.last, self.counts) = (saved.highest, saved.last, saved.counts);
        Ok(())
    }

    /// Checks that exactly the anchors have a mass, but for those whose stack was cut; panics at the first that is wrong. Slow: for
    /// tests.
    pub(crate) fn check_valid(&self, ring: &Ring, episodes: &Episodes) {
        self.masses.check_valid();
        let mut window = Window::default();
        let mut anchors = 0;
        for index in ring.oldest()..ring.inserted() {
            let mass = self.masses.get(self.slot(index));
            let is_anchor = episodes.walk(ring, index, &mut window);
            assert!(!is_anchor || mass > 0.0, "{index} is an anchor");
            assert!(
                is_anchor || mass == 0.0 || !episodes.is_whole(ring, index),
                "{index} lacks steps"
            );
            anchors += usize::from(mass > 0.0);
        }
        let with_mass = (0..self.capacity as usize).filter(|&slot| self.masses.get(slot) > 0.0);
        assert_eq!(with_mass.count(), anchors, "what is not held has no mass");
    }
}
