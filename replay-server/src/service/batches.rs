//! Requests for batches: parked on arrival until the limiter allows them, then served, several in parallel.
//! The core chooses the rows of a batch.

use std::time::Instant;

use driml_protocol::{
    BatchReply, BatchRequest, BufferPool, Incoming, Message, NotReady, Peer, Responder, fail_point,
};

use super::{
    parked::{ParkedRequest, park_request},
    server::{Service, State},
};
use crate::sampling::batch::PackedBatch;

/// A parked request with its responder.
type ParkedBatchRequest = ParkedRequest<Responder<BatchReply>>;

impl Service {
    pub(super) fn request(&self, incoming: Incoming<BatchRequest>) {
        let request = self.read(&incoming);
        let responder = incoming.into_responder();
        let Some(request) = request else {
            let why = "the request could not be read; the replay server's log says why".into();
            return responder.reply(&BatchReply::NotReady(NotReady::Refused { why }));
        };
        let mut state = self.state();
        if let Err(why) = self.update_from_request(&mut state, &request) {
            state.reject(BatchRequest::NAME, &why);
            drop(state);
            return responder.reply(&BatchReply::NotReady(NotReady::Refused { why }));
        }
        let learner = Peer::learner(request.learner);
        state.participants.mark_seen(learner, None, Instant::now());
        let parked = ParkedRequest {
            request,
            query: responder,
            arrived: Instant::now(),
        };
        park_request(&mut state.requests, parked);
        drop(state);
        self.changed.notify_all();
    }

    /// Takes the learner's progress and the counts of the other shards from a request. An error says why the request is rejected.
    fn update_from_request(&self, state: &mut State, request: &BatchRequest) -> Result<(), String> {
        state.check_learner(request.learner)?;
        let (rows, rows_max) = (request.rows, self.limits.batch_rows_max);
        if !(1..=rows_max).contains(&rows) {
            return Err(format!(
                "a batch of {rows} rows; those of this run have {rows_max} (learner.batch_size)"
            ));
        }
        state.replay.set_progress(request.learned)?;
        let (_, shards) = self.shard;
        match request.other_shards {
            None if shards > 1 => Err(format!(
                "a whole batch of one of {shards} shards: the learner must be connected to all of them"
            )),
            Some(_) if shards == 1 => {
                Err("a part of a batch; this replay has only one shard".into())
            }
            Some(other_shards) => state.replay.set_other_shards(other_shards),
            None => Ok(()),
        }
    }

    /// Serves parked requests as the limiter allows them, until the shutdown. Each thread of this kind does nothing else.
    pub(super) fn serve_parked_requests(&self) {
        while !self.shutdown.is_set() {
            fail_point::reach("sample");
            let mut state = self.state();
            let (now, was_starving) = (Instant::now(), state.replay.is_starving());
            let Some((parked, drawn)) = state.take_answerable(now, &self.pool) else {
                // Now the parked chunks may be stored.
                if state.replay.is_starving() && !was_starving {
                    self.changed.notify_all();
                }
                let due_in = state.requests.iter().map(|it| it.time_left(now)).min();
                self.wait_changed(state, due_in);
                continue;
            };
            let waited = now.saturating_duration_since(parked.arrived);
            state.replay.counters_mut().learner_waited_s += waited.as_secs_f64();
            drop(state);
            self.changed.notify_all();
            match drawn.map(PackedBatch::unpack) {
                Ok(batch) => {
                    let (header, payload) = batch.into_payload();
                    let reply = BatchReply::Batch(header);
                    parked.query.reply_with(&reply, payload.freeze());
                }
                Err(not_ready) => parked.query.reply(&BatchReply::NotReady(not_ready)),
            }
        }
    }
}

impl State {
    /// Removes the first parked request that can be answered now, and returns it with its answer, in memory of `pool`.
    fn take_answerable(
        &mut self,
        now: Instant,
        pool: &BufferPool,
    ) -> Option<(ParkedBatchRequest, Result<PackedBatch, NotReady>)> {
        for at in 0..self.requests.len() {
            let parked = &self.requests[at];
            let request = parked.request;
            let alloc = |bytes| match request.shared_memory {
                true => pool.take(bytes),
                false => pool.take_private(bytes),
            };
            let drawn = self.replay.draw_for(request.id, request.rows, alloc);
            if !matches!(drawn, Err(NotReady::Wait(_))) || parked.time_left(now).is_zero() {
                let parked = self.requests.remove(at);
                return parked.map(|parked| (parked, drawn));
            }
        }
        None
    }
}
