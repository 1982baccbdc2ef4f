//! Chunks as they arrive: stored at once, or parked until the limiter opens, and answered either way.
//! What is stored is the core's decision; the order of those that wait is the order in which they came.

use std::{
    borrow::Cow,
    time::{Duration, Instant},
};

use driml_protocol::{Chunk, Claim, InsertReply, Kind, fault};
use zenoh::{bytes::ZBytes, query::Query};

use super::{Service, State};

/// How long the thread sleeps when nothing is parked; it is woken when something is.
const IDLE: Duration = Duration::from_secs(60);

/// Answers that are to be sent once the lock is free.
type Answers = Vec<(Query, InsertReply)>;

impl Service {
    pub(super) fn insert(&self, query: Query) {
        let none = ZBytes::new();
        let payload = query.payload().unwrap_or(&none);
        let (pieces, len) = (payload.slices(), payload.len());
        let chunk = match Chunk::receive(pieces, len, &self.pool, self.spec_hash, self.num_actions)
        {
            Ok(chunk) => chunk,
            Err(e) => {
                self.refuse("a chunk", &e);
                let refused = InsertReply::Refused { why: e.to_string() };
                return self.reply(&query, Kind::InsertReply, &refused);
            }
        };
        let packed = self.packer.pack(Cow::Owned(chunk));
        let header = packed.chunk.header;
        let mut state = self.state();
        let State { replay, chunks, .. } = &mut *state;
        let reply = match replay.settle(&packed) {
            Some(reply) => reply,
            // Those that came before go first.
            None if !chunks.is_empty() && !header.leaving => InsertReply::Wait {
                inserted_total: replay.inserted_total(),
                kept: false,
            },
            None => replay.admit(&packed),
        };
        let mut answers = Answers::new();
        match reply {
            InsertReply::Wait { .. } => {
                if let Err(query) = chunks.park(packed, query, Instant::now()) {
                    answers.push((query, reply));
                }
            }
            reply => {
                if matches!(reply, InsertReply::Stored { .. })
                    && let Some(older) = chunks.take_copy(&header)
                {
                    answers.extend(older.question.map(|query| (query, reply.clone())));
                }
                answers.push((query, reply));
            }
        }
        drop(state);
        self.changed.notify_all();
        self.answer_all(answers);
    }

    pub(super) fn claim(&self, query: Query) {
        let Some(claim) = self.read::<Claim>(&query, Kind::Claim) else {
            return;
        };
        let mut state = self.state();
        let State { replay, chunks, .. } = &mut *state;
        if let Some(reply) = replay.claim(&claim) {
            drop(state);
            return self.reply(&query, Kind::InsertReply, &reply);
        }
        let Some(parked) = chunks.claimed(&claim) else {
            let wait = InsertReply::Wait {
                inserted_total: replay.inserted_total(),
                kept: false,
            };
            drop(state);
            return self.reply(&query, Kind::InsertReply, &wait);
        };
        parked.ask(query, Instant::now());
        let mut answers = Answers::new();
        if claim.leaving {
            parked.chunk.chunk.to_mut().header.leaving = true;
            if let Some(parked) = chunks.take(claim.actor) {
                let reply = after_waiting(replay.insert_packed(&parked.chunk));
                answers.extend(parked.question.map(|query| (query, reply)));
            }
        }
        drop(state);
        self.changed.notify_all();
        self.answer_all(answers);
    }

    /// Stores parked chunks as the limiter lets them in, and tells those that wait for long that they still do. The thread's
    /// whole work until the end of the process.
    pub(super) fn admit_parked(&self) {
        while !self.shutdown.is_set() {
            fault::point("admit");
            let mut answers = Answers::new();
            let mut state = self.state();
            let now = Instant::now();
            state.admit(now, &mut answers);
            for query in state.chunks.overdue(now, self.hold_max) {
                let wait = InsertReply::Wait {
                    inserted_total: state.replay.inserted_total(),
                    kept: true,
                };
                answers.push((query, wait));
            }
            if answers.is_empty() {
                let due_in = state.chunks.due_in(now, self.hold_max).unwrap_or(IDLE);
                drop(self.wait(state, due_in));
                continue;
            }
            drop(state);
            self.changed.notify_all();
            self.answer_all(answers);
        }
    }

    fn answer_all(&self, answers: Answers) {
        for (query, reply) in answers {
            self.reply(&query, Kind::InsertReply, &reply);
        }
    }
}

impl State {
    /// Deals with the parked chunks from the first on, up to one that still has to wait.
    fn admit(&mut self, now: Instant, answers: &mut Answers) {
        while let Some(parked) = self.chunks.first() {
            // Its actor may have started anew meanwhile, or the run may have ended.
            let reply = self.replay.insert_packed(&parked.chunk);
            if matches!(reply, InsertReply::Wait { .. }) {
                return;
            }
            let waited = now.saturating_duration_since(parked.arrived);
            self.replay.note_actors_waited(waited.as_secs_f64());
            let parked = self.chunks.take_first();
            let question = parked.and_then(|parked| parked.question);
            answers.extend(question.map(|query| (query, after_waiting(reply))));
        }
    }
}

/// The answer about a chunk that was parked.
fn after_waiting(reply: InsertReply) -> InsertReply {
    match reply {
        InsertReply::Stored {
            inserted_total,
            actors,
            ..
        } => InsertReply::Stored {
            inserted_total,
            actors,
            waited: true,
        },
        other => other,
    }
}
