//! What has to wait until the rate limiter opens: one chunk an actor and one request a client, each with its question.
//! It neither stores, draws nor answers; `Q` is the question to be answered.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use driml_protocol::{BatchRequest, ChunkHeader, Claim};

use crate::storage::frame_store::PackedChunk;

/// Bytes of the chunks kept; an actor that sends one more is told to send it again later.
const CHUNK_BYTES_MAX: usize = 1 << 28;
/// Requests kept; the one that has waited longest gives way to one more, and its client asks again.
const REQUESTS_MAX: usize = 1024;

/// A chunk that is stored as soon as the limiter lets it pass.
pub(super) struct ParkedChunk<Q> {
    pub(super) chunk: PackedChunk<'static>,
    /// Where the answer goes; none between a `Wait` and the actor's claim.
    pub(super) question: Option<Q>,
    pub(super) arrived: Instant,
    /// When the question came.
    asked: Instant,
}

/// The chunks that wait, at most one an actor: the newest copy. They stand in the order in which their actors' first copies came.
pub(super) struct ParkedChunks<Q> {
    line: VecDeque<ParkedChunk<Q>>,
    bytes: usize,
}

impl<Q> Default for ParkedChunks<Q> {
    fn default() -> Self {
        Self {
            line: VecDeque::new(),
            bytes: 0,
        }
    }
}

impl<Q> ParkedChunks<Q> {
    pub(super) fn len(&self) -> usize {
        self.line.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.line.is_empty()
    }

    pub(super) const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Whose chunks wait.
    pub(super) fn actors(&self) -> impl Iterator<Item = u32> {
        self.line.iter().map(|it| it.header().actor)
    }

    fn place(&self, actor: u32) -> Option<usize> {
        self.actors().position(|it| it == actor)
    }

    /// When the chunk of an actor came that waits.
    pub(super) fn arrived(&self, actor: u32) -> Option<Instant> {
        self.place(actor).map(|at| self.line[at].arrived)
    }

    /// Keeps a chunk in the place of an older one of its actor, or at the end of the line; gives the question back if there is
    /// no room for it.
    pub(super) fn park(
        &mut self,
        chunk: PackedChunk<'static>,
        question: Q,
        now: Instant,
    ) -> Result<(), Q> {
        let place = self.place(chunk.chunk.header.actor);
        let others = self.bytes - place.map_or(0, |at| self.line[at].chunk.bytes());
        // One chunk of any size is kept, or an actor with large ones would send for ever.
        if others > 0 && others + chunk.bytes() > CHUNK_BYTES_MAX {
            return Err(question);
        }
        self.bytes = others + chunk.bytes();
        let mut parked = ParkedChunk {
            chunk,
            question: Some(question),
            arrived: now,
            asked: now,
        };
        match place {
            Some(at) => {
                parked.arrived = self.line[at].arrived;
                self.line[at] = parked;
            }
            None => self.line.push_back(parked),
        }
        Ok(())
    }

    /// The parked chunk that `claim` is about.
    pub(super) fn claimed(&mut self, claim: &Claim) -> Option<&mut ParkedChunk<Q>> {
        self.line.iter_mut().find(|parked| {
            let header = parked.header();
            (header.actor, header.incarnation, header.sequence)
                == (claim.actor, claim.incarnation, claim.sequence)
        })
    }

    /// Takes the older copy of a chunk that has been stored out of the line; a later chunk of its actor stays.
    pub(super) fn take_copy(&mut self, stored: &ChunkHeader) -> Option<ParkedChunk<Q>> {
        let parked = self.line[self.place(stored.actor)?].header();
        let is_copy =
            parked.incarnation == stored.incarnation && parked.sequence <= stored.sequence;
        is_copy.then(|| self.take(stored.actor)).flatten()
    }

    /// The chunk that has waited longest.
    pub(super) fn first(&self) -> Option<&ParkedChunk<Q>> {
        self.line.front()
    }

    /// Takes an actor's chunk out of the line.
    pub(super) fn take(&mut self, actor: u32) -> Option<ParkedChunk<Q>> {
        let parked = self.line.remove(self.place(actor)?)?;
        self.bytes -= parked.chunk.bytes();
        Some(parked)
    }

    /// Takes the chunk that has waited longest out of the line.
    pub(super) fn take_first(&mut self) -> Option<ParkedChunk<Q>> {
        let actor = self.actors().next()?;
        self.take(actor)
    }

    /// Takes the questions that have been held for `hold_max`; the chunks stay.
    pub(super) fn overdue(&mut self, now: Instant, hold_max: Duration) -> Vec<Q> {
        let late =
            |parked: &&mut ParkedChunk<Q>| now.saturating_duration_since(parked.asked) >= hold_max;
        let parked = self.line.iter_mut().filter(late);
        parked.filter_map(|parked| parked.question.take()).collect()
    }

    /// How long until a question has been held for `hold_max`; none where none is.
    pub(super) fn due_in(&self, now: Instant, hold_max: Duration) -> Option<Duration> {
        let held = self.line.iter().filter(|it| it.question.is_some());
        let left = held.map(|it| hold_max.saturating_sub(now.saturating_duration_since(it.asked)));
        left.min()
    }
}

impl<Q> ParkedChunk<Q> {
    fn header(&self) -> &ChunkHeader {
        &self.chunk.chunk.header
    }

    /// Takes another question about the same chunk; the older one was given up.
    pub(super) fn ask(&mut self, question: Q, now: Instant) {
        (self.question, self.asked) = (Some(question), now);
    }
}

/// A request that is served as soon as the limiter allows it.
pub(super) struct ParkedRequest<Q> {
    pub(super) request: BatchRequest,
    pub(super) question: Q,
    pub(super) arrived: Instant,
    /// How long it may wait.
    pub(super) hold_max: Duration,
}

impl<Q> ParkedRequest<Q> {
    pub(super) fn left(&self, now: Instant) -> Duration {
        let held = now.saturating_duration_since(self.arrived);
        self.hold_max.saturating_sub(held)
    }
}

/// The requests that wait, at most one a client: the newest attempt. The oldest is first.
pub(super) struct ParkedRequests<Q>(VecDeque<ParkedRequest<Q>>);

impl<Q> Default for ParkedRequests<Q> {
    fn default() -> Self {
        Self(VecDeque::new())
    }
}

impl<Q> ParkedRequests<Q> {
    /// Keeps a request in the place of an older one of its client, which was given up.
    pub(super) fn park(&mut self, parked: ParkedRequest<Q>) {
        let id = parked.request.id;
        self.0.retain(|it| it.request.id.client_id != id.client_id);
        if self.0.len() == REQUESTS_MAX {
            self.0.pop_front();
        }
        self.0.push_back(parked);
    }

    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn oldest(&self) -> Option<Instant> {
        self.0.iter().map(|it| it.arrived).min()
    }

    /// Forgets all but the requests of one learner.
    pub(super) fn keep_only(&mut self, learner: u64) {
        self.0.retain(|it| it.request.learner == learner);
    }

    pub(super) fn pop(&mut self) -> Option<ParkedRequest<Q>> {
        self.0.pop_front()
    }

    /// Puts back what was popped and is not to be answered yet.
    pub(super) fn put_back(&mut self, parked: impl IntoIterator<Item = ParkedRequest<Q>>) {
        let newer = std::mem::take(&mut self.0);
        self.0.extend(parked);
        self.0.extend(newer);
    }

    /// How long until one has waited as long as it may.
    pub(super) fn due_in(&self, now: Instant) -> Option<Duration> {
        self.0.iter().map(|it| it.left(now)).min()
    }
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use driml_protocol::{Chunk, Learned, RequestId};

    use super::*;
    use crate::{config::Compression, storage::frame_store::Packer};

    fn chunk(actor: u32, sequence: u64, steps: u32, frame_bytes: u32) -> PackedChunk<'static> {
        let chunk = Chunk::zeroed(ChunkHeader {
            actor,
            incarnation: 9,
            sequence,
            first_transition: 0,
            weights_version: 0,
            leaving: false,
            streams: 1,
            steps,
            frame_bytes,
        });
        let packer = Packer {
            compression: Compression::None,
            seal_for: None,
        };
        packer.pack(Cow::Owned(chunk))
    }

    fn claim(actor: u32, sequence: u64) -> Claim {
        Claim {
            actor,
            incarnation: 9,
            sequence,
            leaving: false,
        }
    }

    #[test]
    fn one_chunk_an_actor_waits_in_the_order_of_arrival() {
        let (mut parked, now) = (ParkedChunks::default(), Instant::now());
        for (actor, question) in [(1, "a"), (2, "b"), (1, "a again")] {
            parked.park(chunk(actor, 0, 1, 1), question, now).unwrap();
        }
        assert_eq!(parked.len(), 2);
        let first = parked.first().unwrap().question;
        assert_eq!(first, Some("a again"), "its place is kept");
        assert!(parked.claimed(&claim(1, 1)).is_none(), "another chunk");
        assert!(parked.claimed(&claim(3, 0)).is_none(), "another actor");
        parked.park(chunk(4, 7, 1, 1), "d", now).unwrap();
        let mut take_copy = |actor, sequence| {
            let copy = parked.take_copy(&chunk(actor, sequence, 1, 1).chunk.header);
            copy.and_then(|it| it.question)
        };
        assert_eq!(take_copy(3, 0), None);
        assert_eq!(take_copy(4, 6), None, "a later one");
        assert_eq!(take_copy(4, 7), Some("d"));
        parked.claimed(&claim(1, 0)).unwrap().ask("claimed", now);
        assert_eq!(parked.take_first().unwrap().question, Some("claimed"));
        assert_eq!(parked.take(2).unwrap().question, Some("b"));
        assert!(parked.take(2).is_none() && parked.take_first().is_none() && parked.is_empty());
        assert_eq!(parked.bytes, 0);
    }

    #[test]
    fn a_question_is_held_for_a_while_and_its_chunk_for_longer() {
        let (mut parked, start) = (ParkedChunks::default(), Instant::now());
        let (hold, second) = (Duration::from_secs(2), Duration::from_secs(1));
        assert_eq!(parked.due_in(start, hold), None);
        parked.park(chunk(1, 0, 1, 1), "a", start).unwrap();
        parked.park(chunk(2, 0, 1, 1), "b", start + second).unwrap();
        assert_eq!(parked.due_in(start + second, hold), Some(second));
        let later = start + hold;
        assert_eq!(parked.overdue(later, hold), ["a"]);
        assert_eq!(parked.overdue(later, hold), [""; 0]);
        assert_eq!(parked.due_in(later, hold), Some(second));
        let claimed = parked.claimed(&claim(1, 0)).unwrap();
        claimed.ask("a again", later);
        assert_eq!(parked.overdue(start + 5 * second, hold).len(), 2);
        assert_eq!(parked.len(), 2);
    }

    #[test]
    fn the_bytes_kept_are_bounded_and_one_chunk_always_fits() {
        let (mut parked, now) = (ParkedChunks::default(), Instant::now());
        let third = CHUNK_BYTES_MAX as u32 / 3;
        parked.park(chunk(1, 0, 4, third), "a", now).unwrap();
        assert_eq!(parked.park(chunk(2, 0, 1, 1), "b", now), Err("b"));
        // A smaller copy makes room.
        parked.park(chunk(1, 0, 2, third), "a", now).unwrap();
        parked.park(chunk(2, 0, 1, 1), "b", now).unwrap();
        assert_eq!(parked.park(chunk(3, 0, 1, third), "c", now), Err("c"));
        parked.take(1);
        parked.park(chunk(3, 0, 1, third), "c", now).unwrap();
    }

    #[test]
    fn one_request_an_asker_waits() {
        let (mut parked, now) = (ParkedRequests::default(), Instant::now());
        let request = |learner, client_id, question| ParkedRequest {
            request: BatchRequest {
                learner,
                id: RequestId::first(client_id),
                rows: 1,
                shared_memory: false,
                learned: Learned::default(),
                other_shards: None,
            },
            question,
            arrived: now,
            hold_max: Duration::from_secs(client_id),
        };
        for (learner, client_id, question) in
            [(1, 1, "a"), (1, 2, "b"), (1, 1, "a again"), (2, 3, "c")]
        {
            parked.park(request(learner, client_id, question));
        }
        assert_eq!(parked.due_in(now), Some(Duration::from_secs(1)));
        parked.keep_only(1);
        let first = parked.pop().unwrap();
        assert_eq!(first.question, "b");
        parked.put_back([first]);
        let order: Vec<_> = std::iter::from_fn(|| parked.pop())
            .map(|it| it.question)
            .collect();
        assert_eq!(order, ["b", "a again"]);
        assert_eq!(parked.due_in(now), None);
    }
}
