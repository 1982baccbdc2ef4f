//! Chunks on arrival: stored at once, or parked until the limiter allows them, and answered either way.
//! The core decides what is stored. Parked chunks are stored in the order of arrival.

use std::{borrow::Cow, time::Instant};

use driml_protocol::{
    Chunk, ChunkHeader, ChunkPoll, CodecError, Incoming, InsertReply, Peer, fail_point,
};

use super::{
    parked::ParkedChunk,
    server::{PendingQuery, Service, State},
};
use crate::{replay::VERSION_AHEAD_MAX, storage::pack::PackedChunk};

/// Replies to send once the lock is released.
type Replies = Vec<(PendingQuery, InsertReply)>;

impl Service {
    pub(super) fn insert(&self, incoming: Incoming<ChunkHeader>) {
        let arrived = Instant::now();
        let chunk = incoming.receive(&self.pool).and_then(|(header, payload)| {
            let (acted, newest) = (header.weights_version, self.weights().newest_version());
            if acted.saturating_sub(newest) > VERSION_AHEAD_MAX {
                let why = format!("weights {acted} acted, and the newest are {newest}");
                return Err(CodecError::Header(why));
            }
            Chunk::from_payload(header, payload)
        });
        let responder = incoming.into_responder();
        let chunk = match chunk {
            Ok(chunk) => chunk,
            Err(e) => {
                self.reject_unreadable::<ChunkHeader>(&e);
                return responder.reply(&InsertReply::Refused { why: e.to_string() });
            }
        };
        let packed = self.packer.pack(Cow::Owned(chunk));
        let query = PendingQuery { responder, arrived };
        let mut state = self.state();
        let replies = state.handle_chunk(packed, query);
        let has_parked = state.has_parked(Instant::now());
        drop(state);
        if has_parked {
            self.changed.notify_all();
        }
        self.send_replies(replies);
    }

    pub(super) fn poll(&self, incoming: Incoming<ChunkPoll>) {
        let arrived = Instant::now();
        let Some(poll) = self.read(&incoming) else {
            return;
        };
        let responder = incoming.into_responder();
        let query = PendingQuery { responder, arrived };
        let replies = self.state().handle_poll(&poll, query);
        self.changed.notify_all();
        self.send_replies(replies);
    }

    /// Stores parked chunks as the limiter allows, and replies `Wait` to queries that have been held for long, until the shutdown.
    pub(super) fn store_parked_chunks(&self) {
        while !self.shutdown.is_set() {
            fail_point::reach("admit");
            let mut state = self.state();
            let now = Instant::now();
            let parked = state.chunks.queue.len();
            let mut replies = state.store_parked(now);
            for query in state.chunks.take_overdue(now, self.hold_max) {
                replies.push((query, state.replay.wait_reply(true)));
            }
            // A chunk may be stored while its actor does not ask for it: a request may wait for that chunk.
            if replies.is_empty() && state.chunks.queue.len() == parked {
                let due_in = state.chunks.due_in(now, self.hold_max);
                self.wait_changed(state, due_in);
                continue;
            }
            drop(state);
            self.changed.notify_all();
            self.send_replies(replies);
        }
    }

    fn send_replies(&self, replies: Replies) {
        for (PendingQuery { responder, arrived }, reply) in replies {
            responder.reply(&reply);
            self.state().timings.record_reply(arrived.elapsed());
        }
    }
}

impl State {
    fn handle_chunk(&mut self, packed: PackedChunk<'static>, query: PendingQuery) -> Replies {
        let header = packed.chunk.header;
        let (version, arrived) = (header.weights_version, query.arrived);
        let actor = Peer::actor(header.actor, header.incarnation);
        self.participants.mark_seen(actor, Some(version), arrived);
        let is_first = self.chunks.queue.is_empty();
        let reply = match self.replay.early_reply(&packed) {
            Some(reply) => reply,
            // Parked chunks, which came before, go first.
            None if !(is_first || self.replay.state.actors.passes_limiter(&header)) => {
                self.replay.wait_reply(false)
            }
            None => {
                let reply = self.replay.store_if_allowed(&packed);
                if matches!(reply, InsertReply::Stored { .. }) {
                    self.timings.record_insert(version, arrived, Instant::now());
                }
                reply
            }
        };
        let mut replies = Replies::new();
        match &reply {
            InsertReply::Wait { .. } => {
                let no_room = self.chunks.park(packed, query, arrived).err();
                replies.extend(no_room.map(|query| (query, reply)));
                return replies;
            }
            InsertReply::Stored { .. } => {
                let older = self.chunks.take_older_copy(&header).and_then(|it| it.query);
                replies.extend(older.map(|query| (query, reply.clone())));
            }
            InsertReply::Refused { why } => {
                let line = format!("a chunk of actor {} was rejected: {why}", header.actor);
                self.warn_limited("chunk", &line);
            }
            InsertReply::OutOfOrder { .. } | InsertReply::Finished { .. } => {}
        }
        replies.push((query, reply));
        replies
    }

    /// Replies what became of a chunk, or keeps the query with the parked chunk. If the actor is leaving, stores its parked chunk if it may.
    fn handle_poll(&mut self, poll: &ChunkPoll, query: PendingQuery) -> Replies {
        if let Some(reply) = self.replay.answer_poll(poll) {
            if let InsertReply::Refused { why } = &reply {
                self.warn_limited("poll", &format!("a poll was rejected: {why}"));
            }
            return vec![(query, reply)];
        }
        let Some(parked) = self.chunks.find_polled(poll) else {
            return vec![(query, self.replay.wait_reply(false))];
        };
        // The actor has given up an older query about this chunk.
        (parked.queried_at, parked.query) = (query.arrived, Some(query));
        if !poll.leaving {
            return Replies::new();
        }
        parked.packed.chunk.to_mut().header.leaving = true;
        let parked = self.chunks.remove(poll.actor);
        let answer = parked.and_then(|parked| {
            let reply = self.replay.insert_packed(&parked.packed);
            self.unparked_reply(parked, reply)
        });
        answer.into_iter().collect()
    }

    /// Stores or rejects the parked chunks in order, up to the first that still has to wait.
    pub(super) fn store_parked(&mut self, now: Instant) -> Replies {
        let mut replies = Replies::new();
        while let Some(parked) = self.chunks.queue.front() {
            // The actor may have restarted meanwhile, or the run may have ended.
            let reply = self.replay.insert_packed(&parked.packed);
            if matches!(reply, InsertReply::Wait { .. }) {
                break;
            }
            if let Some(parked) = self.chunks.queue.pop_front() {
                let waited = now.saturating_duration_since(parked.arrived);
                self.replay.counters_mut().actors_waited_s += waited.as_secs_f64();
                replies.extend(self.unparked_reply(parked, reply));
            }
        }
        replies
    }

    /// Returns the reply about a chunk that has left the queue, and records its times if it was stored.
    fn unparked_reply(
        &mut self,
        parked: ParkedChunk<PendingQuery>,
        mut reply: InsertReply,
    ) -> Option<(PendingQuery, InsertReply)> {
        if let InsertReply::Stored { waited, .. } = &mut reply {
            *waited = true;
            let version = parked.header().weights_version;
            let arrived = parked.arrived;
            self.timings.record_insert(version, arrived, Instant::now());
        }
        parked.query.map(|query| (query, reply))
    }
}
