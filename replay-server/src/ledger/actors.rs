//! Exactly-once storage: each actor's current incarnation, next chunk, reported number of transitions, and the state of its streams.
//! It stores no transitions, sends no replies and does not know which actors are connected.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use driml_protocol::{ActorJoin, ChunkHeader, ChunkPoll, Leave, ProcessName, Totals};
use serde::{Deserialize, Serialize};

use crate::storage::ring::Link;

/// Maximum actors of a run. A further one is rejected; the known ones continue.
pub const ACTORS_MAX: usize = 4096;
/// Maximum streams of one actor. A chunk with more is rejected.
pub const STREAMS_MAX: u32 = 4096;
/// Maximum chunks of a leaving incarnation that pass the rate limiter: twice as many as an actor may have in flight. Later ones wait like
/// those of an actor that stays, until the actor joins again.
const LEAVING_CHUNKS_MAX: u64 = 128;
/// Maximum past incarnations remembered per actor. Chunks of older ones are rejected as unknown.
const PAST_INCARNATIONS_MAX: usize = 64;

/// One environment of an actor's world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Stream {
    /// How the next transition is linked to the last one.
    pub(crate) link: Link,
    /// Return and length of the episode so far; `None` if a part of the episode was lost.
    pub(crate) episode: Option<Totals>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct IncarnationState {
    incarnation: u64,
    /// Transitions that this incarnation has produced, by its last report.
    produced: u64,
    has_left: bool,
    /// Whether it left although transitions were not stored. A restarted server does not need this, as it lists connected processes only.
    #[serde(skip)]
    has_failed: bool,
    /// Sequence number of the first chunk that passed the rate limiter because the actor was leaving.
    #[serde(skip)]
    leaving_from: Option<u64>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Actor {
    current: IncarnationState,
    /// Sequence number of the next chunk of the current incarnation.
    expected: u64,
    streams: Vec<Stream>,
    past: VecDeque<IncarnationState>,
    /// Number of incarnations before the current one, including those no longer in `past`.
    earlier_incarnations: u32,
    /// Sequence number of a chunk that came after a restart of the server although chunks before it are missing.
    #[serde(skip)]
    gap_sequence: Option<u64>,
}

impl Actor {
    fn is_past(&self, incarnation: u64) -> bool {
        self.past.iter().any(|it| it.incarnation == incarnation)
    }

    /// Whether a chunk has the actor's number of streams, or is the first.
    fn fits_streams(&self, header: &ChunkHeader) -> bool {
        self.streams.is_empty() || self.streams.len() == header.streams as usize
    }
}

#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ChunkOrder {
    /// The next chunk of its actor: store it.
    Next,
    /// A copy of a chunk that is already stored.
    Retried,
    /// Chunks before this one are missing.
    OutOfOrder { expected: u64 },
}

/// How two counts of the same transitions differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Difference {
    /// Transitions produced but never stored.
    pub(crate) lost: u64,
    /// Transitions stored but never produced.
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

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Actors {
    actors: BTreeMap<u32, Actor>,
    /// Set if this state was read from disk: a power cut may have lost the transitions stored last.
    #[serde(skip)]
    pub(crate) restored: bool,
}

impl Actors {
    /// Makes `join.incarnation` the current incarnation of its actor; a join may be repeated. Returns the number of earlier incarnations.
    /// Too many actors, or an incarnation that another one has replaced, is an error: the reason, for a person.
    pub(crate) fn join(&mut self, join: ActorJoin) -> Result<u32, String> {
        let ActorJoin { actor, incarnation } = join;
        let current = IncarnationState {
            incarnation,
            ..IncarnationState::default()
        };
        if !self.actors.contains_key(&actor) && self.actors.len() >= ACTORS_MAX {
            return Err(format!(
                "actor {actor} is one too many, as a run has at most {ACTORS_MAX}: use the number (--id) of an actor that has exited"
            ));
        }
        let known = self.actors.entry(actor).or_insert_with(|| Actor {
            current,
            ..Actor::default()
        });
        if known.current.incarnation == incarnation {
            return Ok(known.earlier_incarnations);
        }
        if known.is_past(incarnation) {
            return Err(replaced_error(actor));
        }
        if known.past.len() == PAST_INCARNATIONS_MAX {
            known.past.pop_front();
        }
        known.past.push_back(known.current);
        known.earlier_incarnations = known.earlier_incarnations.saturating_add(1);
        (known.current, known.expected, known.gap_sequence) = (current, 0, None);
        known.streams.clear();
        Ok(known.earlier_incarnations)
    }

    /// Returns the current incarnation of `actor`; `None` before the first.
    pub(crate) fn current_incarnation(&self, actor: u32) -> Option<u64> {
        self.actors.get(&actor).map(|it| it.current.incarnation)
    }

    /// Whether this is an actor whose current incarnation has sent its `Leave`, with all its transitions stored.
    pub(crate) fn has_left_in_order(&self, who: ProcessName) -> bool {
        let ProcessName::Actor(actor) = who else {
            return false;
        };
        let current = self.actors.get(&actor).map(|it| it.current);
        current.is_some_and(|it| it.has_left && !it.has_failed)
    }

    /// Returns the actor, if `incarnation` is its current one.
    fn current_actor(&self, actor: u32, incarnation: u64) -> Result<&Actor, String> {
        match self.actors.get(&actor) {
            Some(known) if known.current.incarnation == incarnation => Ok(known),
            Some(known) if known.is_past(incarnation) => Err(replaced_error(actor)),
            _ => Err(format!(
                "this replay server does not know this incarnation of actor {actor}: the server has restarted since \
                 the actor joined, and has lost its transitions; start the actor again"
            )),
        }
    }

    /// Judges a chunk without changing any state. An error says why the chunk must never be stored.
    pub(crate) fn chunk_order(&self, header: &ChunkHeader) -> Result<ChunkOrder, String> {
        let (number, streams) = (header.actor, header.streams);
        let actor = self.current_actor(number, header.incarnation)?;
        if streams > STREAMS_MAX {
            return Err(format!(
                "{streams} streams in one chunk; an actor has at most {STREAMS_MAX}"
            ));
        }
        let expected = actor.expected;
        if header.sequence < expected {
            return Ok(ChunkOrder::Retried);
        }
        if actor.current.has_left {
            return Err(format!("actor {number} left before it sent this chunk"));
        }
        if header.sequence > expected {
            return Ok(ChunkOrder::OutOfOrder { expected });
        }
        if header.sequence > 0 && !actor.fits_streams(header) {
            return Err(format!(
                "actor {number} sends {streams} streams after {}; their number changes only when the actor restarts",
                actor.streams.len()
            ));
        }
        Ok(ChunkOrder::Next)
    }

    /// Checks that a chunk can be counted: its incarnation is current, and its number of streams fits. The error says why not.
    pub(crate) fn check_sender(&self, header: &ChunkHeader) -> Result<(), String> {
        let actor = self.current_actor(header.actor, header.incarnation)?;
        if header.sequence == 0 || actor.fits_streams(header) {
            return Ok(());
        }
        let (streams, before) = (header.streams, actor.streams.len());
        Err(format!("{streams} streams after {before}"))
    }

    /// Whether to store an out-of-order chunk anyway: an earlier process of this server acknowledged the chunks before it and then lost
    /// them in a power cut, so that they will never come again.
    ///
    /// An actor that repeats the same chunk, although the reply named the expected one, has no older chunk left.
    pub(crate) fn accepts_gap(&mut self, header: &ChunkHeader) -> bool {
        let actor = self.actors.get_mut(&header.actor);
        actor.is_some_and(|actor| {
            self.restored
                && actor.fits_streams(header)
                && actor.gap_sequence.replace(header.sequence) == Some(header.sequence)
        })
    }

    /// Whether a chunk that [`Actors::chunk_order`] accepts passes the rate limiter because its actor is leaving. A retry gets the same reply.
    pub(crate) fn passes_limiter(&mut self, header: &ChunkHeader) -> bool {
        let actor = self.actors.get_mut(&header.actor);
        header.leaving
            && actor.is_some_and(|it| {
                let from = *it.current.leaving_from.get_or_insert(header.sequence);
                (from..from.saturating_add(LEAVING_CHUNKS_MAX)).contains(&header.sequence)
            })
    }

    /// Unlinks each stream whose last transition is `first_lost` or later, as these transitions are gone.
    pub(crate) fn unlink_streams(&mut self, first_lost: u64) {
        for stream in self.actors.values_mut().flat_map(|it| &mut it.streams) {
            stream.link = stream.link.cut_at(first_lost);
        }
    }

    pub(crate) fn check(&self, inserted: u64) -> Result<(), &'static str> {
        let too_many = |it: &Actor| {
            it.streams.len() > STREAMS_MAX as usize || it.past.len() > PAST_INCARNATIONS_MAX
        };
        if self.actors.len() > ACTORS_MAX || self.actors.values().any(too_many) {
            return Err("the state has more actors, incarnations or streams than a run may have");
        }
        // A transition has at most one successor.
        let mut followed = BTreeSet::new();
        let streams = self.actors.values().flat_map(|it| &it.streams);
        let mut after = streams.filter_map(|it| it.link.previous());
        match after.all(|after| after < inserted && followed.insert(after)) {
            true => Ok(()),
            false => Err("the state has streams without the transition that they follow"),
        }
    }

    /// Returns the actors that have delivered a chunk, or had an earlier incarnation.
    pub(crate) fn acting(&self) -> impl Iterator<Item = u32> {
        let all = self.actors.iter();
        let acting = all.filter(|(_, it)| it.expected > 0 || it.earlier_incarnations > 0);
        acting.map(|(&number, _)| number)
    }

    pub(crate) fn is_stored(&self, poll: &ChunkPoll) -> Result<bool, String> {
        let actor = self.current_actor(poll.actor, poll.incarnation)?;
        Ok(poll.sequence < actor.expected)
    }

    /// Counts a chunk to be stored. Returns the actor's streams, and how the chunk's count of earlier transitions differs from ours.
    ///
    /// A new incarnation starts with fresh streams. If the counts differ, the streams are unlinked: the chunk continues no transition.
    pub(crate) fn accept(&mut self, header: &ChunkHeader) -> (&mut [Stream], Difference) {
        let actor = self.actors.get_mut(&header.actor);
        let actor = actor.expect("a chunk of an actor that has not joined is never judged Next");
        let difference = Difference::between(header.first_transition, actor.current.produced);
        if header.sequence == 0 || actor.streams.is_empty() {
            let start = || Stream {
                link: Link::EpisodeStart,
                episode: Some(Totals::default()),
            };
            actor.streams.resize_with(header.streams as usize, start);
        }
        if difference != Difference::default() {
            actor.streams.fill_with(|| Stream {
                link: Link::Lost,
                episode: None,
            });
        }
        actor.expected = header.sequence + 1;
        actor.gap_sequence = None;
        actor.current.produced = header.first_transition + header.transitions() as u64;
        (&mut actor.streams, difference)
    }

    /// Takes the `Leave` of a current or past incarnation. Returns how its count differs from ours; `None` if the message is repeated.
    /// An incarnation that never joined is an error: the reason, for a person.
    pub(crate) fn leave(&mut self, leave: &Leave) -> Result<Option<Difference>, String> {
        let (actor, produced) = (leave.actor, leave.produced);
        let known = self.actors.get_mut(&actor).into_iter();
        let mut states = known.flat_map(|it| std::iter::once(&mut it.current).chain(&mut it.past));
        let state = states.find(|it| it.incarnation == leave.incarnation);
        let state = state.ok_or_else(|| format!("no such process joined as actor {actor}"))?;
        if std::mem::replace(&mut state.has_left, true) {
            return Ok(None);
        }
        let stored = std::mem::replace(&mut state.produced, produced);
        let difference = Difference::between(produced, stored);
        state.has_failed = difference.lost > 0;
        Ok(Some(difference))
    }

    pub(crate) fn forgettable(
        &self,
        joining: u32,
        is_connected: impl Fn(u32, u64) -> bool,
    ) -> Vec<u32> {
        if self.actors.len() < ACTORS_MAX || self.actors.contains_key(&joining) {
            return Vec::new();
        }
        let forgettable = self.actors.iter().filter(|&(&number, actor)| {
            let has_sent = actor.expected > 0 || !actor.past.is_empty();
            !has_sent && !is_connected(number, actor.current.incarnation)
        });
        forgettable.map(|(&number, _)| number).collect()
    }

    pub(crate) fn forget(&mut self, actors: &[u32]) {
        self.actors.retain(|it, _| !actors.contains(it));
    }
}

fn replaced_error(actor: u32) -> String {
    format!(
        "another process has joined as actor {actor} since this one did: give each actor another number (--id)"
    )
}
