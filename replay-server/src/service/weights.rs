//! Weights on their way: taken from the learner once a version, announced, and given to actors in pieces.
//! It does not read them.

use std::{
    sync::{MutexGuard, PoisonError},
    time::Instant,
};

use driml_protocol::{
    Done, PIECE_BYTES, WeightsReply, WeightsRequest, WeightsUpload, WeightsVersion, codec, session,
};
use zenoh::{Wait, bytes::ZBytes, query::Query};

use super::{server::Service, weights_store::WeightsStore};

impl Service {
    pub(super) fn weights(&self) -> MutexGuard<'_, WeightsStore> {
        self.weights.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn take_weights(&self, query: Query) {
        let payload = query.payload().map(|payload| payload.to_bytes());
        let payload = payload.unwrap_or_default();
        let (upload, safetensors) = match codec::decode(&payload, Some(self.spec_hash)) {
            Ok(read) => read,
            Err(e) => return self.refuse("an upload of weights", &e),
        };
        let WeightsUpload { learner, weights } = upload;
        let allowed = self.state().members.check_learner(learner);
        match allowed.and_then(|()| self.weights().put(weights, safetensors)) {
            Ok(is_new) => {
                if is_new {
                    let now = Instant::now();
                    self.state().timings.weights_came(&weights, now);
                    self.announce(weights.version);
                }
                self.reply(&query, &Done);
            }
            Err(why) => {
                tracing::warn!("weights were refused: {why}");
                self.state().replay.note_refused_message();
            }
        }
    }

    fn announce(&self, version: u64) {
        let announced = codec::encode(self.spec_hash, &WeightsVersion { version }, &[]);
        let put = announced.map_err(|e| e.to_string()).and_then(|bytes| {
            self.announcements
                .put(bytes)
                .wait()
                .map_err(|e| e.to_string())
        });
        if let Err(why) = put {
            tracing::warn!("weights {version} were not announced: {why}");
        }
    }

    pub(super) fn give_weights(&self, query: Query) {
        let Some(request) = self.read::<WeightsRequest>(&query) else {
            return;
        };
        let found = self.weights().find(request, Instant::now());
        let (reply, piece) = match &found {
            Ok((weights, offset)) => {
                let rest = &weights.safetensors[*offset..];
                let reply = WeightsReply::Piece {
                    weights: weights.header,
                    bytes: weights.safetensors.len() as u64,
                    offset: *offset as u64,
                };
                (reply, &rest[..rest.len().min(PIECE_BYTES)])
            }
            Err(reply) => (*reply, &[][..]),
        };
        match codec::seal(self.spec_hash, &reply, piece) {
            Ok(head) => {
                let piece = ZBytes::from(piece.to_vec());
                session::answer(&query, session::join_planes(head, piece));
            }
            Err(e) => tracing::error!("weights were not sent: {e}"),
        }
    }
}
