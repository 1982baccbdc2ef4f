//! Exactly once: which chunk each actor sends next, what it says it produced, and where its streams stand.
//! It stores no transitions and answers nothing itself.

use std::collections::{HashMap, VecDeque};

use driml_protocol::{ChunkHeader, Goodbye};

use crate::ring::Link;

/// Most actors a run may ever have; a further one is refused, the known ones go on.
pub const ACTORS_MAX: usize = 4096;
/// Most streams of one actor; a chunk with more is refused.
pub const STREAMS_MAX: u32 = 4096;
/// Past epochs remembered for each actor; of the oldest, a late first chunk would be taken for a new start.
const PAST_EPOCHS_MAX: usize = 64;

/// One copy of an actor's world.
pub(crate) struct Stream {
    /// How its next transition hangs together with the last.
    pub(crate) link: Link,
    /// Undiscounted return of the episode so far; none if a part of the episode was lost.
    pub(crate) episode_return: Option<f64>,
}

/// One life of an actor.
pub(crate) struct Epoch {
    epoch: u64,
    expected: u64,
    /// Transitions it has produced by its own account, as far as heard.
    produced: u64,
    said_goodbye: bool,
    pub(crate) streams: Vec<Stream>,
}

impl Epoch {
    fn new(epoch: u64) -> Self {
        Self {
            epoch,
            expected: 0,
            produced: 0,
            said_goodbye: false,
            streams: Vec::new(),
        }
    }
}

struct Actor {
    current: Epoch,
    past: VecDeque<u64>,
}

/// What is to be done with a chunk.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The next of its actor: store it.
    Next,
    /// Stored already.
    Retried,
    /// Chunks before this one are missing.
    OutOfOrder { expected: u64 },
    /// Not to be stored, ever.
    Refused(String),
}

/// How two counts of the same transitions differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Difference {
    /// Produced, never stored.
    pub(crate) lost: u64,
    /// Stored, never produced.
    pub(crate) duplicated: u64,
}

impl Difference {
    const fn between(produced: u64, stored: u64) -> Self {
        Self {
            lost: produced.saturating_sub(stored),
            duplicated: stored.saturating_sub(produced),
        }
    }
}

/// All actors that were ever heard of.
#[derive(Default)]
pub(crate) struct Actors {
    actors: HashMap<u32, Actor>,
}

impl Actors {
    /// Judges a chunk without changing anything.
    pub(crate) fn judge(&self, header: &ChunkHeader) -> Verdict {
        if header.streams > STREAMS_MAX {
            return Verdict::Refused(format!(
                "{} streams in one chunk; an actor has at most {STREAMS_MAX}",
                header.streams
            ));
        }
        let first = match header.sequence {
            0 => Verdict::Next,
            _ => Verdict::OutOfOrder { expected: 0 },
        };
        let Some(actor) = self.actors.get(&header.actor) else {
            if self.actors.len() >= ACTORS_MAX {
                return Verdict::Refused(format!(
                    "actor {} is one more than the {ACTORS_MAX} that a run may have",
                    header.actor
                ));
            }
            return first;
        };
        let current = &actor.current;
        if actor.past.contains(&header.epoch) {
            return Verdict::Refused(format!(
                "actor {} has started anew since epoch {:016x}: it now runs epoch {:016x}; two processes may share an actor number",
                header.actor, header.epoch, current.epoch
            ));
        }
        if header.epoch != current.epoch {
            return first;
        }
        if header.sequence < current.expected {
            return Verdict::Retried;
        }
        if current.said_goodbye {
            return Verdict::Refused(format!(
                "actor {} said goodbye before this chunk",
                header.actor
            ));
        }
        if header.sequence > current.expected {
            return Verdict::OutOfOrder {
                expected: current.expected,
            };
        }
        if header.sequence > 0 && header.streams as usize != current.streams.len() {
            return Verdict::Refused(format!(
                "actor {} sends {} streams after {}; their number must not change before it starts anew",
                header.actor,
                header.streams,
                current.streams.len()
            ));
        }
        Verdict::Next
    }

    /// Counts a chunk that was judged `Next`; gives its streams, and how its own count of what came before differs.
    ///
    /// A new epoch starts with fresh streams. Where the counts differ, the streams are cut: what follows does not continue
    /// what was stored.
    pub(crate) fn accept(&mut self, header: &ChunkHeader) -> (&mut [Stream], Difference) {
        let epoch = self.enter(header.actor, header.epoch);
        let difference = Difference::between(header.first_transition, epoch.produced);
        if header.sequence == 0 {
            let start = || Stream {
                link: Link::EpisodeStart,
                episode_return: Some(0.0),
            };
            epoch.streams.resize_with(header.streams as usize, start);
        }
        if difference != Difference::default() {
            epoch.streams.fill_with(|| Stream {
                link: Link::Lost,
                episode_return: None,
            });
        }
        epoch.expected = header.sequence + 1;
        epoch.produced = header.first_transition + header.transitions() as u64;
        (&mut epoch.streams, difference)
    }

    /// Takes an actor's last word and gives the difference that it reveals; a second goodbye reveals nothing.
    pub(crate) fn goodbye(&mut self, goodbye: &Goodbye) -> Difference {
        let known = self.actors.get(&goodbye.actor);
        let past = known.is_some_and(|actor| actor.past.contains(&goodbye.epoch));
        if past || (known.is_none() && self.actors.len() >= ACTORS_MAX) {
            return Difference::default();
        }
        let epoch = self.enter(goodbye.actor, goodbye.epoch);
        if std::mem::replace(&mut epoch.said_goodbye, true) {
            return Difference::default();
        }
        Difference::between(
            goodbye.produced,
            std::mem::replace(&mut epoch.produced, goodbye.produced),
        )
    }

    /// The epoch, which becomes the actor's current one if it is new.
    fn enter(&mut self, actor: u32, epoch: u64) -> &mut Epoch {
        let fresh = || Actor {
            current: Epoch::new(epoch),
            past: VecDeque::new(),
        };
        let actor = self.actors.entry(actor).or_insert_with(fresh);
        if actor.current.epoch != epoch {
            if actor.past.len() == PAST_EPOCHS_MAX {
                actor.past.pop_front();
            }
            actor.past.push_back(actor.current.epoch);
            actor.current = Epoch::new(epoch);
        }
        &mut actor.current
    }
}
