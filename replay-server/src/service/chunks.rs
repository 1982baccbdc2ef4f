//! Chunks on arrival: stored at once, or parked until the limiter allows them, and answered either way.
//! The core decides what is stored. Parked chunks are stored in the order of arrival.

use std::{borrow::Cow, time::Instant};

use driml_protocol::{
    Alive, Chunk, ChunkHeader, ChunkPoll, CodecError, Incoming, InsertReply, fail_point,
};

use super::{
    parked::ParkedChunk,
    server::{Question, Service, State},
};
use crate::{replay::VERSION_AHEAD_MAX, storage::pack::PackedChunk};

/// Replies to send once the lock is released.
type Answers = Vec<(Question, InsertReply)>;

impl Service {
    pub(super) fn insert(&self, incoming: Incoming<ChunkHeader>) {
        let arrived = Instant::now();
        let chunk = incoming.receive(&self.pool).and_then(|(header, payload)| {
            let (acted, newest) = (header.weights_version, self.weights().version());
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
                self.refuse("a chunk", &e);
                return responder.reply(&InsertReply::Refused { why: e.to_string() });
            }
        };
        let packed = self.packer.pack(Cow::Owned(chunk));
        let question = Question { responder, arrived };
        let mut state = self.state();
        let answers = state.take_chunk(packed, question);
        let is_awaited = state.is_awaited(Instant::now());
        drop(state);
        if is_awaited {
            self.changed.notify_all();
        }
        self.answer_all(answers);
    }

    pub(super) fn poll(&self, incoming: Incoming<ChunkPoll>) {
        let arrived = Instant::now();
        let Some(poll) = self.read(&incoming) else {
            return;
        };
        let responder = incoming.into_responder();
        let question = Question { responder, arrived };
        let answers = self.state().take_poll(&poll, question);
        self.changed.notify_all();
        self.answer_all(answers);
    }

    /// Stores parked chunks as the limiter allows, and replies `Wait` to queries that have been held for long, until the shutdown. Its
    /// thread does nothing else.
    pub(super) fn admit_parked(&self) {
        while !self.shutdown.is_set() {
            fail_point::reach("admit");
            let mut state = self.state();
            let now = Instant::now();
            let mut answers = state.admit(now);
            for question in state.chunks.overdue(now, self.hold_max) {
                answers.push((question, state.replay.wait_reply(true)));
            }
            if answers.is_empty() {
                let due_in = state.chunks.due_in(now, self.hold_max);
                self.wait(state, due_in);
                continue;
            }
            drop(state);
            self.changed.notify_all();
            self.answer_all(answers);
        }
    }

    fn answer_all(&self, answers: Answers) {
        for (Question { responder, arrived }, reply) in answers {
            responder.reply(&reply);
            self.state().timings.answered(arrived.elapsed());
        }
    }
}

impl State {
    fn take_chunk(&mut self, packed: PackedChunk<'static>, question: Question) -> Answers {
        let header = packed.chunk.header;
        let (version, arrived) = (header.weights_version, question.arrived);
        let actor = Alive::actor(header.actor, header.incarnation);
        self.participants.seen(actor, Some(version), arrived);
        let reply = match self.replay.early_reply(&packed) {
            Some(reply) => reply,
            // Parked chunks, which came before, go first.
            None if !self.chunks.line.is_empty() && !header.leaving => {
                self.replay.wait_reply(false)
            }
            None => {
                let reply = self.replay.store_if_allowed(&packed);
                if matches!(reply, InsertReply::Stored { .. }) {
                    self.timings.stored(version, arrived, Instant::now());
                }
                reply
            }
        };
        let mut answers = Answers::new();
        match &reply {
            InsertReply::Wait { .. } => {
                let no_room = self.chunks.park(packed, question, arrived).err();
                answers.extend(no_room.map(|question| (question, reply)));
                return answers;
            }
            InsertReply::Stored { .. } => {
                let older = self.chunks.take_copy(&header).and_then(|it| it.question);
                answers.extend(older.map(|question| (question, reply.clone())));
            }
            InsertReply::Refused { why } => {
                let line = format!("a chunk of actor {} was refused: {why}", header.actor);
                self.say("chunk", &line);
            }
            InsertReply::OutOfOrder { .. } | InsertReply::Finished { .. } => {}
        }
        answers.push((question, reply));
        answers
    }

    /// Replies what became of a chunk, or keeps the query with the parked chunk. If the actor is leaving, stores its parked chunk.
    fn take_poll(&mut self, poll: &ChunkPoll, question: Question) -> Answers {
        if let Some(reply) = self.replay.answer_poll(poll) {
            if let InsertReply::Refused { why } = &reply {
                self.say("poll", &format!("a poll was refused: {why}"));
            }
            return vec![(question, reply)];
        }
        let Some(parked) = self.chunks.polled(poll) else {
            return vec![(question, self.replay.wait_reply(false))];
        };
        // The actor has given up an older query about this chunk.
        (parked.asked, parked.question) = (question.arrived, Some(question));
        if !poll.leaving {
            return Answers::new();
        }
        parked.chunk.chunk.to_mut().header.leaving = true;
        let parked = self.chunks.take(poll.actor);
        let answer = parked.and_then(|parked| {
            let reply = self.replay.insert_packed(&parked.chunk);
            self.leave_line(parked, reply)
        });
        answer.into_iter().collect()
    }

    /// Stores or rejects the parked chunks in order, up to the first that still has to wait.
    fn admit(&mut self, now: Instant) -> Answers {
        let mut answers = Answers::new();
        while let Some(parked) = self.chunks.line.front() {
            // The actor may have restarted meanwhile, or the run may have ended.
            let reply = self.replay.insert_packed(&parked.chunk);
            if matches!(reply, InsertReply::Wait { .. }) {
                break;
            }
            if let Some(parked) = self.chunks.line.pop_front() {
                let waited = now.saturating_duration_since(parked.arrived);
                self.replay.counters_mut().actors_waited_s += waited.as_secs_f64();
                answers.extend(self.leave_line(parked, reply));
            }
        }
        answers
    }

    /// Returns the reply about a chunk that has left the line, and records its times if it was stored.
    fn leave_line(
        &mut self,
        parked: ParkedChunk<Question>,
        mut reply: InsertReply,
    ) -> Option<(Question, InsertReply)> {
        if let InsertReply::Stored { waited, .. } = &mut reply {
            *waited = true;
            let version = parked.header().weights_version;
            let arrived = parked.arrived;
            self.timings.stored(version, arrived, Instant::now());
        }
        parked.question.map(|question| (question, reply))
    }
}
