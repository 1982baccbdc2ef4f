//! The ring of transitions, with links along each episode. Every frame is stored once.
//! It knows no actors, sampling or frame stacks; `frame_store` stores the frames.

use driml_protocol::End;
use serde::{Deserialize, Serialize};

use super::{frame_store::FrameStore, pack::StreamFrames, reserve};

/// How a transition continues its stream. `after` is the index of the transition just before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Link {
    /// First of an episode: nothing before it belongs to its states or returns.
    EpisodeStart,
    /// First of a level: its frame stack does not reach back, but returns of earlier transitions continue across it from `after`.
    LevelStart { after: u64 },
    /// Within a level.
    Within { after: u64 },
    /// The transition before was lost: neither frame stacks nor returns may cross the gap.
    Lost,
}

impl Link {
    /// Returns `Lost` if the transition before is `first_lost` or later, and is therefore gone; otherwise returns the link unchanged.
    pub(crate) const fn cut_at(self, first_lost: u64) -> Self {
        match self {
            Self::LevelStart { after } | Self::Within { after } if after >= first_lost => {
                Self::Lost
            }
            other => other,
        }
    }

    /// Returns the index of the transition just before, if there is one.
    pub(crate) const fn previous(self) -> Option<u64> {
        match self {
            Self::LevelStart { after } | Self::Within { after } => Some(after),
            Self::EpisodeStart | Self::Lost => None,
        }
    }

    /// Returns the link of the transition that follows `index`, which ended with `end`.
    pub(crate) const fn following(index: u64, end: End) -> Self {
        match end {
            End::Running => Self::Within { after: index },
            End::LevelChange => Self::LevelStart { after: index },
            End::TimedOut | End::Terminal => Self::EpisodeStart,
        }
    }
}

/// No successor: it has not come yet, never will, or belongs to the next episode.
const NO_NEXT: u64 = u64::MAX;
/// No predecessor: this is the first of an episode or level.
const NO_PREVIOUS: u64 = u64::MAX;
/// The predecessor was lost.
const PREVIOUS_LOST: u64 = u64::MAX - 1;

/// A transition without its frame: 32 bytes, so that a walk along an episode touches little memory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Step {
    next: u64,
    previous: u64,
    pub(crate) weights_version: u64,
    pub(crate) reward: f32,
    pub(crate) action: u8,
    pub(crate) end: End,
}

impl Step {
    pub(crate) const fn new(action: u8, reward: f32, end: End, weights_version: u64) -> Self {
        Self {
            next: NO_NEXT,
            previous: NO_PREVIOUS,
            weights_version,
            reward,
            action,
            end,
        }
    }

    /// Returns the index of the successor in the same episode. A successor is newer, so it is held whenever this step is.
    pub(crate) fn next(&self) -> Option<u64> {
        (self.next != NO_NEXT).then_some(self.next)
    }
}

/// The predecessor of a transition in its level, which its frame stack needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Previous {
    /// Nothing: it is the first of its episode or level.
    Start,
    /// A transition that is held.
    Held(u64),
    /// A transition that was overwritten or lost.
    Gone,
}

/// The newest `capacity` transitions, or fewer if their frames would exceed the memory limit. The transition with index `i`, counted from
/// the start of the run, is in slot `(i - first) % capacity`.
pub(crate) struct Ring {
    capacity: u64,
    /// Index of the first transition stored in this ring; an earlier process stored those before it.
    first: u64,
    oldest: u64,
    inserted: u64,
    steps: Vec<Step>,
    frames: FrameStore,
}

impl Ring {
    /// Creates an empty ring of `capacity` transitions with their `frames`. An error holds the bytes that the system does not grant.
    pub(crate) fn new(capacity: u64, frames: FrameStore) -> Result<Self, u64> {
        Ok(Self {
            capacity,
            first: 0,
            oldest: 0,
            inserted: 0,
            steps: reserve(capacity)?,
            frames,
        })
    }

    /// Drops all transitions. The next one gets the index `first`.
    pub(crate) fn restart_at(&mut self, first: u64) {
        self.steps.clear();
        (self.first, self.oldest, self.inserted) = (first, first, first);
        self.frames.clear();
    }

    pub(crate) const fn first_index(&self) -> u64 {
        self.first
    }

    pub(crate) fn forget_before(&mut self, oldest: u64) {
        self.oldest = self.oldest.max(oldest.min(self.inserted));
        self.frames.forget_before(self.oldest);
    }

    /// Stores consecutive transitions of one stream. Once the ring is full, they overwrite the oldest ones.
    ///
    /// `link` is the link of the first one. Returns the link of the transition that will follow the last one.
    pub(crate) fn push_steps(
        &mut self,
        frames: StreamFrames<'_>,
        steps: impl ExactSizeIterator<Item = Step>,
        mut link: Link,
    ) -> Link {
        let inserted = self.inserted + steps.len() as u64;
        let oldest = inserted.saturating_sub(self.capacity).max(self.oldest);
        let slot = self.slot(self.inserted);
        self.oldest = self.frames.push(frames, slot, oldest);
        for step in steps {
            link = Link::following(self.push(step, link), step.end);
        }
        link
    }

    /// Stores one transition, whose frame is already stored, and returns its index.
    fn push(&mut self, step: Step, link: Link) -> u64 {
        let index = self.inserted;
        let previous = match link {
            Link::EpisodeStart | Link::LevelStart { .. } => NO_PREVIOUS,
            Link::Within { after } => after,
            Link::Lost => PREVIOUS_LOST,
        };
        let step = Step {
            next: NO_NEXT,
            previous,
            ..step
        };
        let slot = self.slot(index);
        if slot == self.steps.len() {
            self.steps.push(step);
        } else {
            self.steps[slot] = step;
        }
        self.inserted += 1;
        if let Link::Within { after } | Link::LevelStart { after } = link
            && after >= self.oldest
        {
            let slot = self.slot(after);
            self.steps[slot].next = index;
        }
        index
    }

    pub(crate) fn slot(&self, index: u64) -> usize {
        ((index - self.first) % self.capacity) as usize
    }

    pub(crate) const fn capacity(&self) -> u64 {
        self.capacity
    }

    /// Transitions stored since the start: the index of the next one.
    pub(crate) const fn inserted(&self) -> u64 {
        self.inserted
    }

    /// Index of the oldest transition held (of the next one, if none is).
    pub(crate) const fn oldest(&self) -> u64 {
        self.oldest
    }

    /// The step at `index`, which must be held.
    pub(crate) fn step(&self, index: u64) -> &Step {
        debug_assert!(
            (self.oldest()..self.inserted).contains(&index),
            "{index} is not held"
        );
        &self.steps[self.slot(index)]
    }

    pub(crate) const fn frames(&self) -> &FrameStore {
        &self.frames
    }

    pub(crate) fn previous(&self, index: u64) -> Previous {
        match self.step(index).previous {
            NO_PREVIOUS => Previous::Start,
            PREVIOUS_LOST => Previous::Gone,
            previous if previous < self.oldest() => Previous::Gone,
            previous => Previous::Held(previous),
        }
    }

    /// Checks sizes and every link; panics at the first that is wrong. Slow: for tests.
    pub(crate) fn check_valid(&self) {
        let (first, oldest, inserted) = (self.first, self.oldest, self.inserted);
        // One step per transition, until steps are overwritten.
        let steps = (inserted - first).min(self.capacity);
        assert_eq!(self.steps.len() as u64, steps);
        assert!(inserted - oldest <= self.capacity, "more are held than fit");
        self.frames.check_valid(first, oldest, inserted);
        for index in oldest..inserted {
            let step = self.step(index);
            if let Some(next) = step.next() {
                assert!((index + 1..inserted).contains(&next), "{index}, {next}");
                let ended = step.end.is_episode_end();
                assert!(!ended, "{index} ended its episode, yet {next} follows");
                let back = match step.end {
                    End::Running => index,
                    _ => NO_PREVIOUS,
                };
                assert_eq!(self.step(next).previous, back, "{next} follows {index}");
            }
            if let Previous::Held(previous) = self.previous(index) {
                let before = self.step(previous);
                let follows = (before.next, before.end) == (index, End::Running);
                assert!(follows, "{previous} precedes {index}");
            }
        }
    }
}
