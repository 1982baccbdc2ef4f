//! Chunks and requests that wait for the rate limiter: one chunk per actor and one request per client, each with its query.
//! It does not store, draw or answer. `Q` is the query to answer.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use driml_protocol::{BatchRequest, ChunkHeader, ChunkPoll};

use crate::storage::pack::PackedChunk;

/// Maximum bytes of parked chunks. Beyond it an actor must send its chunk again later.
const CHUNK_BYTES_MAX: usize = 1 << 28;
/// Maximum parked requests. One more replaces the oldest, whose client retries.
const REQUESTS_MAX: usize = 1024;

/// How long a request is parked before the reply `Wait`: far below every learner's time-out.
const HOLD_MAX: Duration = Duration::from_secs(1);
/// The same for a part of a batch: shorter, as this shard learns the counts of the others only from the next request.
const SHARD_HOLD_MAX: Duration = Duration::from_millis(50);

pub(super) struct ParkedChunk<Q> {
    pub(super) chunk: PackedChunk<'static>,
    /// The query to answer; `None` between a `Wait` and the actor's next poll.
    pub(super) question: Option<Q>,
    pub(super) arrived: Instant,
    pub(super) asked: Instant,
}

impl<Q> ParkedChunk<Q> {
    pub(super) fn header(&self) -> &ChunkHeader {
        &self.chunk.chunk.header
    }
}

/// The parked chunks, at most one per actor: its newest copy. They are in the order in which their actors' first copies arrived.
pub(super) struct ParkedChunks<Q> {
    pub(super) line: VecDeque<ParkedChunk<Q>>,
}

impl<Q> ParkedChunks<Q> {
    pub(super) const fn new() -> Self {
        let line = VecDeque::new();
        Self { line }
    }

    pub(super) fn bytes(&self) -> usize {
        self.line.iter().map(|it| it.chunk.memory_bytes()).sum()
    }

    fn place(&self, actor: u32) -> Option<usize> {
        self.line.iter().position(|it| it.header().actor == actor)
    }

    /// Returns when the parked chunk of an actor arrived.
    pub(super) fn arrived(&self, actor: u32) -> Option<Instant> {
        self.place(actor).map(|at| self.line[at].arrived)
    }

    /// Parks a chunk in the place of an older one of its actor, or at the end of the line. Returns the question as an error if the
    /// chunk has no room.
    pub(super) fn park(
        &mut self,
        chunk: PackedChunk<'static>,
        question: Q,
        now: Instant,
    ) -> Result<(), Q> {
        let place = self.place(chunk.chunk.header.actor);
        let others = self.bytes() - place.map_or(0, |at| self.line[at].chunk.memory_bytes());
        // A single chunk of any size is kept, as an actor with large chunks would otherwise retry forever.
        if others > 0 && others + chunk.memory_bytes() > CHUNK_BYTES_MAX {
            return Err(question);
        }
        let parked = ParkedChunk {
            chunk,
            question: Some(question),
            arrived: place.map_or(now, |at| self.line[at].arrived),
            asked: now,
        };
        match place {
            Some(at) => self.line[at] = parked,
            None => self.line.push_back(parked),
        }
        Ok(())
    }

    pub(super) fn polled(&mut self, poll: &ChunkPoll) -> Option<&mut ParkedChunk<Q>> {
        let of = |it: &ChunkHeader| (it.actor, it.incarnation, it.sequence);
        let polled = (poll.actor, poll.incarnation, poll.sequence);
        self.line.iter_mut().find(|it| of(it.header()) == polled)
    }

    pub(super) fn take(&mut self, actor: u32) -> Option<ParkedChunk<Q>> {
        self.line.remove(self.place(actor)?)
    }

    /// Removes the older copy of a chunk that has been stored. A later chunk of its actor stays.
    pub(super) fn take_copy(&mut self, stored: &ChunkHeader) -> Option<ParkedChunk<Q>> {
        let parked = self.line[self.place(stored.actor)?].header();
        let is_copy =
            parked.incarnation == stored.incarnation && parked.sequence <= stored.sequence;
        is_copy.then(|| self.take(stored.actor)).flatten()
    }

    /// Removes the questions that have been held for `hold_max`. Their chunks stay.
    pub(super) fn overdue(&mut self, now: Instant, hold_max: Duration) -> Vec<Q> {
        let held = |it: &ParkedChunk<Q>| now.saturating_duration_since(it.asked);
        let late = self.line.iter_mut().filter(|it| held(it) >= hold_max);
        late.filter_map(|it| it.question.take()).collect()
    }

    /// Returns the time until the next question has been held for `hold_max`; `None` if no question is held.
    pub(super) fn due_in(&self, now: Instant, hold_max: Duration) -> Option<Duration> {
        let held = self.line.iter().filter(|it| it.question.is_some());
        let left = held.map(|it| hold_max.saturating_sub(now.saturating_duration_since(it.asked)));
        left.min()
    }
}

pub(super) struct ParkedRequest<Q> {
    pub(super) request: BatchRequest,
    pub(super) question: Q,
    pub(super) arrived: Instant,
}

impl<Q> ParkedRequest<Q> {
    /// Returns how much longer the request may stay parked.
    pub(super) fn left(&self, now: Instant) -> Duration {
        let is_part = self.request.other_shards.is_some();
        let hold_max = if is_part { SHARD_HOLD_MAX } else { HOLD_MAX };
        hold_max.saturating_sub(now.saturating_duration_since(self.arrived))
    }
}

/// Appends a request, and removes an older one of its client, which the client has given up. The oldest request is first.
pub(super) fn park_request<Q>(line: &mut VecDeque<ParkedRequest<Q>>, parked: ParkedRequest<Q>) {
    let client_id = parked.request.id.client_id;
    line.retain(|it| it.request.id.client_id != client_id);
    if line.len() == REQUESTS_MAX {
        line.pop_front();
    }
    line.push_back(parked);
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use driml_protocol::{Chunk, RequestId};

    use super::*;
    use crate::{config::Compression, storage::pack::Packer};

    const SECOND: Duration = Duration::from_secs(1);

    fn chunk(actor: u32, sequence: u64, frame_bytes: u32) -> PackedChunk<'static> {
        let chunk = Chunk::zeroed(ChunkHeader {
            actor,
            incarnation: 9,
            sequence,
            streams: 1,
            steps: 1,
            frame_bytes,
            ..ChunkHeader::default()
        });
        let packer = Packer {
            compression: Compression::None,
            spec_hash: None,
        };
        packer.pack(Cow::Owned(chunk))
    }

    fn poll(actor: u32, sequence: u64) -> ChunkPoll {
        ChunkPoll {
            actor,
            incarnation: 9,
            sequence,
            leaving: false,
        }
    }

    #[test]
    fn one_chunk_an_actor_waits_in_the_order_of_arrival() {
        let (mut parked, now) = (ParkedChunks::new(), Instant::now());
        let arrivals = [(1, 0, "a"), (2, 0, "b"), (1, 0, "a again"), (4, 7, "d")];
        for (actor, sequence, question) in arrivals {
            let chunk = chunk(actor, sequence, 1);
            parked.park(chunk, question, now).unwrap();
        }
        let first = parked.line[0].question;
        assert_eq!(first, Some("a again"), "its place is kept");
        for other in [poll(1, 1), poll(3, 0)] {
            assert!(parked.polled(&other).is_none(), "{other:?}");
        }
        assert!(parked.polled(&poll(1, 0)).is_some());
        // A chunk of another actor, an earlier chunk, and the parked chunk itself.
        for (actor, sequence, copy) in [(3, 0, None), (4, 6, None), (4, 7, Some("d"))] {
            let taken = parked.take_copy(&chunk(actor, sequence, 1).chunk.header);
            assert_eq!(taken.and_then(|it| it.question), copy);
        }
        for (actor, question) in [(2, Some("b")), (2, None), (1, Some("a again"))] {
            let taken = parked.take(actor);
            assert_eq!(taken.and_then(|it| it.question), question);
        }
        assert_eq!((parked.line.len(), parked.bytes()), (0, 0));
    }

    #[test]
    fn a_question_is_held_for_a_while_and_its_chunk_for_longer() {
        let (mut parked, start, hold) = (ParkedChunks::new(), Instant::now(), 2 * SECOND);
        assert_eq!(parked.due_in(start, hold), None);
        parked.park(chunk(1, 0, 1), "a", start).unwrap();
        parked.park(chunk(2, 0, 1), "b", start + SECOND).unwrap();
        assert_eq!(parked.due_in(start + SECOND, hold), Some(SECOND));
        let later = start + hold;
        assert_eq!(parked.overdue(later, hold), ["a"]);
        assert_eq!(parked.overdue(later, hold), [""; 0]);
        assert_eq!(parked.due_in(later, hold), Some(SECOND));
        assert_eq!(parked.overdue(later + SECOND, hold), ["b"]);
        assert_eq!(parked.line.len(), 2);
    }

    #[test]
    fn the_bytes_kept_are_bounded_and_one_chunk_always_fits() {
        let (mut parked, now) = (ParkedChunks::new(), Instant::now());
        let most = CHUNK_BYTES_MAX as u32;
        let mut park = |actor, bytes, question| {
            let parked = parked.park(chunk(actor, 0, bytes), question, now);
            parked.map_or_else(|question| question, |()| "kept")
        };
        assert_eq!(park(1, most + 1, "a"), "kept");
        assert_eq!(park(2, 1, "b"), "b");
        // A smaller copy makes room.
        assert_eq!(park(1, most / 2, "a"), "kept");
        assert_eq!(park(2, 1, "b"), "kept");
        assert_eq!(park(3, most / 2, "c"), "c");
    }

    #[test]
    fn one_request_an_asker_waits() {
        let now = Instant::now();
        let mut line = VecDeque::new();
        for (client_id, question) in [(1, "a"), (2, "b"), (1, "a again"), (3, "c")] {
            let request = BatchRequest {
                id: RequestId::first(client_id),
                ..BatchRequest::default()
            };
            let parked = ParkedRequest {
                request,
                question,
                arrived: now,
            };
            assert_eq!(parked.left(now), HOLD_MAX);
            park_request(&mut line, parked);
        }
        let order: Vec<_> = line.iter().map(|it| it.question).collect();
        assert_eq!(order, ["b", "a again", "c"]);
    }
}
