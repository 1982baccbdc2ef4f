//! Requests for batches as they arrive: parked until the limiter allows them, then served, several at a time.
//! Which rows a batch has is the core's choice.

use std::time::{Duration, Instant};

use driml_protocol::{Alive, BatchReply, BatchRequest, Buffer, Incoming, Responder, fault};

use super::{
    parked::ParkedRequest,
    server::{Service, State},
};
use crate::{
    replay::{Replay, Unready},
    sampling::packed_batch::PackedBatch,
};

/// How long a request waits before it is told to come back: far below every learner's time-out.
const HOLD_MAX: Duration = Duration::from_secs(1);
/// The same for a part of a batch: what another shard counts meanwhile is not heard of here.
const SHARD_HOLD_MAX: Duration = Duration::from_millis(50);
/// How long a thread sleeps when nothing is parked; it is woken when something is.
const IDLE: Duration = Duration::from_secs(60);

/// A request that waits, and who for.
type Parked = ParkedRequest<Responder<BatchReply>>;

impl Service {
    pub(super) fn request(&self, incoming: Incoming<BatchRequest>) {
        let request = self.read(&incoming);
        let responder = incoming.into_responder();
        let Some(request) = request else {
            let why = "the request could not be read; the replay server's log says why".into();
            return responder.reply(&BatchReply::Refused { why });
        };
        let mut state = self.state();
        let is_allowed = state.check_learner(request.learner);
        let is_allowed = is_allowed.and_then(|()| self.check_rows(request.rows));
        let heard = is_allowed.and_then(|()| self.hear_learner(&mut state.replay, &request));
        if let Err(why) = heard {
            let line = format!("a request for a batch was refused: {why}");
            state.refuse("batch", &line);
            drop(state);
            return responder.reply(&BatchReply::Refused { why });
        }
        let hold_max = match request.other_shards {
            Some(_) => SHARD_HOLD_MAX,
            None => HOLD_MAX,
        };
        let learner = Alive::learner(request.learner);
        state.accounts.heard(learner, None, Instant::now());
        state.requests.park(ParkedRequest {
            request,
            question: responder,
            arrived: Instant::now(),
            hold_max,
        });
        drop(state);
        self.changed.notify_all();
    }

    /// A batch is as long as the run's are, or a part of one.
    fn check_rows(&self, rows: u32) -> Result<(), String> {
        match self.limits.batch_rows {
            most if (1..=most).contains(&rows) => Ok(()),
            most => Err(format!(
                "a batch of {rows} rows; those of this run have {most} (learner.batch_size)"
            )),
        }
    }

    /// Takes what the learner says of itself and of the other shards.
    fn hear_learner(&self, replay: &mut Replay, request: &BatchRequest) -> Result<(), String> {
        replay.note_learned(request.learned)?;
        let (_, shards) = self.shard;
        match request.other_shards {
            None if shards > 1 => Err(format!(
                "a whole batch of one of {shards} shards: the learner must be connected to all of them"
            )),
            Some(_) if shards == 1 => {
                Err("a part of a batch; this replay has one shard alone".into())
            }
            Some(other_shards) => replay.set_other_shards(other_shards),
            None => Ok(()),
        }
    }

    /// Serves parked requests as the limiter allows them. The thread's whole work until the end of the process.
    pub(super) fn serve_parked(&self) {
        while !self.shutdown.is_set() {
            fault::point("sample");
            let mut state = self.state();
            let now = Instant::now();
            let Some((parked, drawn)) = state.next_answer(now, |bytes, shared| match shared {
                true => self.pool.take(bytes),
                false => self.pool.take_own(bytes),
            }) else {
                let due_in = state.requests.due_in(now).unwrap_or(IDLE);
                drop(self.wait(state, due_in));
                continue;
            };
            let waited = now.saturating_duration_since(parked.arrived);
            state.replay.counted().learner_waited_s += waited.as_secs_f64();
            drop(state);
            self.changed.notify_all();
            give_batch(parked.question, drawn);
        }
    }
}

fn give_batch(responder: Responder<BatchReply>, drawn: Result<PackedBatch, Unready>) {
    match drawn {
        Ok(draft) => {
            let (header, payload) = draft.unpack().into_payload();
            tracing::debug!(
                "a batch goes out: {} rows, {} sampled so far of {} transitions stored",
                header.rows,
                header.tally.rows_sampled,
                header.tally.inserted
            );
            responder.reply_with(&BatchReply::of(header), payload.freeze());
        }
        Err(unready) => responder.reply(&unready.into()),
    }
}

impl State {
    /// The first parked request that can be answered now, with its answer; `memory` gives so many bytes, which may be shared.
    fn next_answer(
        &mut self,
        now: Instant,
        memory: impl Fn(usize, bool) -> Buffer,
    ) -> Option<(Parked, Result<PackedBatch, Unready>)> {
        for at in 0..self.requests.line.len() {
            let parked = &self.requests.line[at];
            let BatchRequest {
                id,
                rows,
                shared_memory,
                ..
            } = parked.request;
            let memory = |bytes| memory(bytes, shared_memory);
            let drawn = self.replay.draw_for(id, rows, memory);
            if !matches!(drawn, Err(Unready::Wait(_))) || parked.left(now).is_zero() {
                let parked = self.requests.line.remove(at);
                return parked.map(|parked| (parked, drawn));
            }
        }
        None
    }
}
