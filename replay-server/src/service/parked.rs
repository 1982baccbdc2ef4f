//! Chunks and requests that wait for the rate limiter: one chunk per actor and one request per client, each with its query.
//! It does not store, draw or answer. `Q` is the query to answer.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use driml_protocol::{BatchRequest, ChunkHeader, ChunkPoll};

use crate::storage::pack::PackedChunk;

/// Maximum bytes of parked chunks. Beyond it an actor must send its chunk again later.
const PARKED_BYTES_MAX: usize = 1 << 28;
/// Maximum parked requests. One more replaces the oldest, whose client retries.
const PARKED_REQUESTS_MAX: usize = 1024;

/// How long a request is parked before the reply `Wait`: far below every learner's time-out.
const HOLD_MAX: Duration = Duration::from_secs(1);
/// The same for a part of a batch: shorter, as this shard learns the counts of the others only from the next request.
const PART_HOLD_MAX: Duration = Duration::from_millis(50);

pub(super) struct ParkedChunk<Q> {
    pub(super) packed: PackedChunk<'static>,
    /// The query to answer; `None` between a `Wait` and the actor's next poll.
    pub(super) query: Option<Q>,
    pub(super) arrived: Instant,
    pub(super) queried_at: Instant,
}

impl<Q> ParkedChunk<Q> {
    pub(super) fn header(&self) -> &ChunkHeader {
        &self.packed.chunk.header
    }
}

/// The parked chunks, at most one per actor: its newest copy. They are in the order in which their actors' first copies arrived.
pub(super) struct ParkedChunks<Q> {
    pub(super) queue: VecDeque<ParkedChunk<Q>>,
}

impl<Q> ParkedChunks<Q> {
    pub(super) const fn new() -> Self {
        let queue = VecDeque::new();
        Self { queue }
    }

    pub(super) fn bytes(&self) -> usize {
        self.queue.iter().map(|it| it.packed.memory_bytes()).sum()
    }

    fn position_of(&self, actor: u32) -> Option<usize> {
        self.queue.iter().position(|it| it.header().actor == actor)
    }

    /// Returns when the parked chunk of an actor arrived.
    pub(super) fn arrival(&self, actor: u32) -> Option<Instant> {
        self.position_of(actor).map(|at| self.queue[at].arrived)
    }

    /// Parks a chunk in the place of an older one of its actor, or at the end of the queue. Without room for it, returns the query.
    pub(super) fn park(
        &mut self,
        packed: PackedChunk<'static>,
        query: Q,
        now: Instant,
    ) -> Result<(), Q> {
        let position = self.position_of(packed.chunk.header.actor);
        let others = self.bytes() - position.map_or(0, |at| self.queue[at].packed.memory_bytes());
        // A single chunk of any size is kept, as an actor with large chunks would otherwise retry forever.
        if others > 0 && others + packed.memory_bytes() > PARKED_BYTES_MAX {
            return Err(query);
        }
        let parked = ParkedChunk {
            packed,
            query: Some(query),
            arrived: position.map_or(now, |at| self.queue[at].arrived),
            queried_at: now,
        };
        match position {
            Some(at) => self.queue[at] = parked,
            None => self.queue.push_back(parked),
        }
        Ok(())
    }

    pub(super) fn find_polled(&mut self, poll: &ChunkPoll) -> Option<&mut ParkedChunk<Q>> {
        let key = |it: &ChunkHeader| (it.actor, it.incarnation, it.sequence);
        let polled = (poll.actor, poll.incarnation, poll.sequence);
        self.queue.iter_mut().find(|it| key(it.header()) == polled)
    }

    pub(super) fn remove(&mut self, actor: u32) -> Option<ParkedChunk<Q>> {
        self.queue.remove(self.position_of(actor)?)
    }

    /// Removes the older copy of a chunk that has been stored. A later chunk of its actor stays.
    pub(super) fn take_older_copy(&mut self, stored: &ChunkHeader) -> Option<ParkedChunk<Q>> {
        let parked = self.queue[self.position_of(stored.actor)?].header();
        let is_copy =
            parked.incarnation == stored.incarnation && parked.sequence <= stored.sequence;
        is_copy.then(|| self.remove(stored.actor)).flatten()
    }

    /// Removes the queries that have been held for `hold_max`. Their chunks stay.
    pub(super) fn take_overdue(&mut self, now: Instant, hold_max: Duration) -> Vec<Q> {
        let held = |it: &ParkedChunk<Q>| now.saturating_duration_since(it.queried_at);
        let late = self.queue.iter_mut().filter(|it| held(it) >= hold_max);
        late.filter_map(|it| it.query.take()).collect()
    }

    /// Returns the time until the next query has been held for `hold_max`; `None` if no query is held.
    pub(super) fn due_in(&self, now: Instant, hold_max: Duration) -> Option<Duration> {
        let held = self.queue.iter().filter(|it| it.query.is_some());
        let left =
            held.map(|it| hold_max.saturating_sub(now.saturating_duration_since(it.queried_at)));
        left.min()
    }
}

pub(super) struct ParkedRequest<Q> {
    pub(super) request: BatchRequest,
    pub(super) query: Q,
    pub(super) arrived: Instant,
}

impl<Q> ParkedRequest<Q> {
    pub(super) fn time_left(&self, now: Instant) -> Duration {
        let is_part = self.request.other_shards.is_some();
        let hold_max = if is_part { PART_HOLD_MAX } else { HOLD_MAX };
        hold_max.saturating_sub(now.saturating_duration_since(self.arrived))
    }
}

/// Appends a request, and removes an older one of its client, which the client has given up. The oldest request is first.
pub(super) fn park_request<Q>(queue: &mut VecDeque<ParkedRequest<Q>>, parked: ParkedRequest<Q>) {
    let client_id = parked.request.id.client_id;
    queue.retain(|it| it.request.id.client_id != client_id);
    if queue.len() == PARKED_REQUESTS_MAX {
        queue.pop_front();
    }
    queue.push_back(parked);
}

#[cfg(test)]
pub(super) mod tests {
    use std::borrow::Cow;

    use driml_protocol::{Chunk, RequestId};

    use super::*;
    use crate::{config::Compression, storage::pack::Packer};

    const SECOND: Duration = Duration::from_secs(1);

    pub(crate) fn chunk(actor: u32, sequence: u64, frame_bytes: u32) -> PackedChunk<'static> {
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

    const fn poll(actor: u32, sequence: u64) -> ChunkPoll {
        ChunkPoll::new(actor, 9, sequence)
    }

    #[test]
    fn one_chunk_an_actor_waits_in_the_order_of_arrival() {
        let (mut parked, now) = (ParkedChunks::new(), Instant::now());
        let arrivals = [(1, 0, "a"), (2, 0, "b"), (1, 0, "a again"), (4, 7, "d")];
        for (actor, sequence, query) in arrivals {
            let chunk = chunk(actor, sequence, 1);
            parked.park(chunk, query, now).unwrap();
        }
        let first = parked.queue[0].query;
        assert_eq!(first, Some("a again"), "its place is kept");
        for other in [poll(1, 1), poll(3, 0)] {
            assert!(parked.find_polled(&other).is_none(), "{other:?}");
        }
        assert!(parked.find_polled(&poll(1, 0)).is_some());
        // A chunk of another actor, an earlier chunk, and the parked chunk itself.
        for (actor, sequence, copy) in [(3, 0, None), (4, 6, None), (4, 7, Some("d"))] {
            let taken = parked.take_older_copy(&chunk(actor, sequence, 1).chunk.header);
            assert_eq!(taken.and_then(|it| it.query), copy);
        }
        for (actor, query) in [(2, Some("b")), (2, None), (1, Some("a again"))] {
            let taken = parked.remove(actor);
            assert_eq!(taken.and_then(|it| it.query), query);
        }
        assert_eq!((parked.queue.len(), parked.bytes()), (0, 0));
    }

    #[test]
    fn a_question_is_held_for_a_while_and_its_chunk_for_longer() {
        let (mut parked, start, hold) = (ParkedChunks::new(), Instant::now(), 2 * SECOND);
        assert_eq!(parked.due_in(start, hold), None);
        parked.park(chunk(1, 0, 1), "a", start).unwrap();
        parked.park(chunk(2, 0, 1), "b", start + SECOND).unwrap();
        assert_eq!(parked.due_in(start + SECOND, hold), Some(SECOND));
        let later = start + hold;
        assert_eq!(parked.take_overdue(later, hold), ["a"]);
        assert_eq!(parked.take_overdue(later, hold), [""; 0]);
        assert_eq!(parked.due_in(later, hold), Some(SECOND));
        assert_eq!(parked.take_overdue(later + SECOND, hold), ["b"]);
        assert_eq!(parked.queue.len(), 2);
    }

    #[test]
    fn the_bytes_kept_are_bounded_and_one_chunk_always_fits() {
        let (mut parked, now) = (ParkedChunks::new(), Instant::now());
        let most = PARKED_BYTES_MAX as u32;
        let mut park = |actor, bytes, query| {
            let parked = parked.park(chunk(actor, 0, bytes), query, now);
            parked.map_or_else(|query| query, |()| "kept")
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
        let mut queue = VecDeque::new();
        for (client_id, query) in [(1, "a"), (2, "b"), (1, "a again"), (3, "c")] {
            let request = BatchRequest {
                id: RequestId::first(client_id),
                ..BatchRequest::default()
            };
            let parked = ParkedRequest {
                request,
                query,
                arrived: now,
            };
            assert_eq!(parked.time_left(now), HOLD_MAX);
            park_request(&mut queue, parked);
        }
        let order: Vec<_> = queue.iter().map(|it| it.query).collect();
        assert_eq!(order, ["b", "a again", "c"]);
    }
}
