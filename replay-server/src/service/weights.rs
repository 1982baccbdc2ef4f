//! Distributes weights: receives each version from the learner, announces it, and sends it to actors in pieces.

use std::{sync::MutexGuard, time::Instant};

use driml_protocol::{
    Ack, BufferPool, Incoming, Message, PIECE_BYTES, WeightsReply, WeightsRequest, WeightsUpload,
    WeightsVersion, lock,
};

use super::{server::Service, weights_store::WeightsStore};

impl Service {
    pub(super) fn weights(&self) -> MutexGuard<'_, WeightsStore> {
        lock(&self.weights)
    }

    pub(super) fn store_weights(&self, incoming: Incoming<WeightsUpload>) {
        // Weights are kept for long, so they do not use the memory of the pool.
        let (upload, safetensors) = match incoming.receive(&BufferPool::new(0)) {
            Ok(read) => read,
            Err(e) => return self.reject_unreadable::<WeightsUpload>(&e),
        };
        let WeightsUpload { learner, weights } = upload;
        let allowed = self.state().check_learner(learner);
        match allowed.and_then(|()| self.weights().update(weights, &safetensors)) {
            Ok(true) => {
                let disk_writer = self.weights().disk_writer();
                if let Some(write_to_disk) = disk_writer {
                    write_to_disk();
                }
                let now = Instant::now();
                self.state().timings.record_weights(&weights, now);
                let version = weights.version;
                if let Err(why) = self.client.publish(&WeightsVersion { version }) {
                    tracing::warn!("weights {version} were not announced: {why}");
                }
            }
            // A repeated upload.
            Ok(false) => {}
            Err(why) => return self.state().reject(WeightsUpload::NAME, &why),
        }
        incoming.into_responder().reply(&Ack);
    }

    pub(super) fn send_weights(&self, incoming: Incoming<WeightsRequest>) {
        let Some(request) = self.read(&incoming) else {
            return;
        };
        let found = self.weights().find_piece(request, Instant::now());
        let (reply, piece) = match found {
            Ok((weights, offset)) => {
                let rest = &weights.safetensors[offset..];
                let reply = WeightsReply::Piece {
                    weights: weights.header,
                    bytes: weights.safetensors.len() as u64,
                    offset: offset as u64,
                };
                (reply, rest[..rest.len().min(PIECE_BYTES)].to_vec())
            }
            Err(reply) => (reply, Vec::new()),
        };
        incoming.into_responder().reply_with(&reply, piece.into());
    }
}
