//! Exactly once: which life of each actor counts, which chunk it sends next, what it says it produced, where its streams stand.
//! It stores no transitions, answers nothing itself and does not know who is connected.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use driml_protocol::{ActorJoin, ChunkHeader, ChunkPoll, Leave, Played};
use serde::{Deserialize, Serialize};

use crate::storage::ring::Link;

/// Most actors a run may ever have; a further one is rejected, the known ones continue.
pub const ACTORS_MAX: usize = 4096;
/// Most streams of one actor; a chunk with more is refused.
pub const STREAMS_MAX: u32 = 4096;
/// Past lives remembered for each actor; what an older one still says is ignored.
const PAST_INCARNATIONS_MAX: usize = 64;

/// One environment of an actor's world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Stream {
    /// How its next transition hangs together with the last.
    pub(crate) link: Link,
    /// The episode so far; none if a part of it was lost.
    pub(crate) episode: Option<Played>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Count {
    incarnation: u64,
    /// Transitions that it has produced, by its last report.
    produced: u64,
    has_left: bool,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Actor {
    current: Count,
    /// Number of the chunk that comes next in the current life.
    expected: u64,
    streams: Vec<Stream>,
    past: VecDeque<Count>,
    /// Lives before the current one, forgotten ones too.
    earlier_incarnations: u32,
    /// A chunk of it that came although chunks before it are missing, after the server was started again.
    #[serde(skip)]
    insisted: Option<u64>,
}

impl Actor {
    fn is_past(&self, incarnation: u64) -> bool {
        self.past.iter().any(|it| it.incarnation == incarnation)
    }

    /// Whether a chunk continues its streams, or begins them.
    fn fits(&self, header: &ChunkHeader) -> bool {
        self.streams.is_empty() || self.streams.len() == header.streams as usize
    }
}

#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The next of its actor: store it.
    Next,
    /// A copy of one that is stored already.
    Retried,
    /// Chunks before this one are missing.
    OutOfOrder { expected: u64 },
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

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Actors {
    actors: BTreeMap<u32, Actor>,
    /// This is what was read from disk: what was stored last may have been lost with the machine's power.
    #[serde(skip)]
    pub(crate) restored: bool,
}

impl Actors {
    /// Makes `join.incarnation` the life that counts of its actor; the same one may be named again. Gives the number of its earlier lives.
    /// One actor more than a run may have, or a life that another one has replaced, is an error: the reason, for a person.
    pub(crate) fn join(&mut self, join: ActorJoin) -> Result<u32, String> {
        let ActorJoin { actor, incarnation } = join;
        let current = Count {
            incarnation,
            ..Count::default()
        };
        if !self.actors.contains_key(&actor) && self.actors.len() >= ACTORS_MAX {
            return Err(format!(
                "actor {actor} is one more than the {ACTORS_MAX} that a run may have: use the numbers of actors that have ended"
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
            return Err(replaced(actor));
        }
        if known.past.len() == PAST_INCARNATIONS_MAX {
            known.past.pop_front();
        }
        known.past.push_back(known.current);
        known.earlier_incarnations = known.earlier_incarnations.saturating_add(1);
        (known.current, known.expected, known.insisted) = (current, 0, None);
        known.streams.clear();
        Ok(known.earlier_incarnations)
    }

    /// The life of `actor` that counts; none before the first.
    pub(crate) fn current_incarnation(&self, actor: u32) -> Option<u64> {
        self.actors.get(&actor).map(|it| it.current.incarnation)
    }

    /// The actor, if this is the life of it that counts.
    fn living(&self, actor: u32, incarnation: u64) -> Result<&Actor, String> {
        match self.actors.get(&actor) {
            Some(known) if known.current.incarnation == incarnation => Ok(known),
            Some(known) if known.is_past(incarnation) => Err(replaced(actor)),
            _ => Err(format!(
                "this replay server does not know this life of actor {actor}: it was started anew since the actor joined, \
                 and what it held is gone; start the actor again"
            )),
        }
    }

    /// Judges a chunk without changing anything; an error says why it is never to be stored.
    pub(crate) fn judge(&self, header: &ChunkHeader) -> Result<Verdict, String> {
        let (number, streams) = (header.actor, header.streams);
        let actor = self.living(number, header.incarnation)?;
        if streams > STREAMS_MAX {
            return Err(format!(
                "{streams} streams in one chunk; an actor has at most {STREAMS_MAX}"
            ));
        }
        let expected = actor.expected;
        if header.sequence < expected {
            return Ok(Verdict::Retried);
        }
        if actor.current.has_left {
            return Err(format!("actor {number} left before it sent this chunk"));
        }
        if header.sequence > expected {
            return Ok(Verdict::OutOfOrder { expected });
        }
        if header.sequence > 0 && !actor.fits(header) {
            return Err(format!(
                "actor {number} sends {streams} streams after {}; their number must not change before it starts anew",
                actor.streams.len()
            ));
        }
        Ok(Verdict::Next)
    }

    /// Checks that a chunk can be counted: it is of a life that counts, and has its streams. If not, the error says why.
    pub(crate) fn check_known(&self, header: &ChunkHeader) -> Result<(), String> {
        let actor = self.living(header.actor, header.incarnation)?;
        if header.sequence == 0 || actor.fits(header) {
            return Ok(());
        }
        let (streams, before) = (header.streams, actor.streams.len());
        Err(format!("{streams} streams after {before}"))
    }

    /// Whether a chunk that was judged out of order is to be stored all the same: those before it were stored by an earlier life of
    /// this server, which lost them with the machine's power, so that they will never come again.
    ///
    /// An actor that sends the same one again, although it was told what is expected, has nothing older.
    pub(crate) fn insists(&mut self, header: &ChunkHeader) -> bool {
        let actor = self.actors.get_mut(&header.actor);
        actor.is_some_and(|actor| {
            self.restored
                && actor.fits(header)
                && actor.insisted.replace(header.sequence) == Some(header.sequence)
        })
    }

    /// Transitions from `first_lost` on are gone: streams that end among them hang together with nothing any more.
    pub(crate) fn cut_streams(&mut self, first_lost: u64) {
        for stream in self.actors.values_mut().flat_map(|it| &mut it.streams) {
            stream.link = stream.link.without(first_lost);
        }
    }

    pub(crate) fn check(&self, inserted: u64) -> Result<(), &'static str> {
        let too_many = |it: &Actor| {
            it.streams.len() > STREAMS_MAX as usize || it.past.len() > PAST_INCARNATIONS_MAX
        };
        if self.actors.len() > ACTORS_MAX || self.actors.values().any(too_many) {
            return Err("a state with more actors, lives or streams than a run may have");
        }
        // No transition has two that follow it.
        let mut followed = BTreeSet::new();
        let streams = self.actors.values().flat_map(|it| &it.streams);
        let mut after = streams.filter_map(|it| it.link.after());
        match after.all(|after| after < inserted && followed.insert(after)) {
            true => Ok(()),
            false => Err("a state with streams that follow on nothing"),
        }
    }

    /// Actors of which a chunk has come.
    pub(crate) fn delivered(&self) -> impl Iterator<Item = u32> {
        let all = self.actors.iter();
        let delivered = all.filter(|(_, it)| it.expected > 0 || it.earlier_incarnations > 0);
        delivered.map(|(&number, _)| number)
    }

    pub(crate) fn is_stored(&self, poll: &ChunkPoll) -> Result<bool, String> {
        let actor = self.living(poll.actor, poll.incarnation)?;
        Ok(poll.sequence < actor.expected)
    }

    /// Counts a chunk that was judged `Next`; gives its streams, and how its own count of what came before differs.
    ///
    /// A new life starts with fresh streams. Where the counts differ, the streams are cut: what follows does not continue
    /// what was stored.
    pub(crate) fn accept(&mut self, header: &ChunkHeader) -> (&mut [Stream], Difference) {
        let actor = self.actors.get_mut(&header.actor);
        let actor = actor.expect("a chunk of an actor that has not joined is never judged Next");
        let difference = Difference::between(header.first_transition, actor.current.produced);
        if header.sequence == 0 || actor.streams.is_empty() {
            let start = || Stream {
                link: Link::EpisodeStart,
                episode: Some(Played::default()),
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
        actor.insisted = None;
        actor.current.produced = header.first_transition + header.transitions() as u64;
        (&mut actor.streams, difference)
    }

    /// Takes the last word of a life that counts or has counted, and gives the difference that it reveals; none if it has come before.
    /// A life that never joined is an error: the reason, for a person.
    pub(crate) fn leave(&mut self, leave: &Leave) -> Result<Option<Difference>, String> {
        let (actor, produced) = (leave.actor, leave.produced);
        let known = self.actors.get_mut(&actor).into_iter();
        let mut lives = known.flat_map(|it| std::iter::once(&mut it.current).chain(&mut it.past));
        let life = lives.find(|life| life.incarnation == leave.incarnation);
        let life = life.ok_or_else(|| format!("no such life of actor {actor} has joined"))?;
        if std::mem::replace(&mut life.has_left, true) {
            return Ok(None);
        }
        let stored = std::mem::replace(&mut life.produced, produced);
        Ok(Some(Difference::between(produced, stored)))
    }

    pub(crate) fn absent(&self, is_connected: impl Fn(u32, u64) -> bool) -> Vec<u32> {
        if self.actors.len() < ACTORS_MAX {
            return Vec::new();
        }
        let absent = self.actors.iter().filter(|&(&number, actor)| {
            let has_sent = actor.expected > 0 || !actor.past.is_empty();
            !has_sent && !is_connected(number, actor.current.incarnation)
        });
        absent.map(|(&number, _)| number).collect()
    }

    pub(crate) fn forget(&mut self, actors: &[u32]) {
        for actor in actors {
            self.actors.remove(actor);
        }
    }
}

fn replaced(actor: u32) -> String {
    format!(
        "another process has joined as actor {actor} since this one did: give each actor another number (--id)"
    )
}
