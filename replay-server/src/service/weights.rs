//! The newest weights: taken from the learner once a version, announced, and given to actors in pieces.
//! It does not read them.

use std::{
    collections::VecDeque,
    sync::{Arc, MutexGuard, PoisonError},
    time::Instant,
};

use driml_protocol::{
    Kind, WeightsHeader, WeightsReply, WeightsRequest, WeightsUpload, WeightsVersion, codec,
    session, weights::PIECE_BYTES,
};
use zenoh::{Wait, bytes::ZBytes, query::Query};

use super::Service;

/// Versions that are kept while actors pull them, the newest included; an actor whose version is gone begins with the newest.
const KEPT_MAX: usize = 8;
/// Most versions that one upload may be ahead of the one before: more is no count of a learner's.
const VERSION_STEP_MAX: u64 = 1 << 20;

/// Weights as they came.
struct Weights {
    header: WeightsHeader,
    safetensors: Vec<u8>,
}

/// The newest weights, and older ones that are being pulled.
#[derive(Default)]
pub(super) struct WeightsStore {
    newest: Option<Arc<Weights>>,
    /// Those that were asked for, the one asked for last at the end.
    pulled: VecDeque<Arc<Weights>>,
}

impl WeightsStore {
    /// Version of the newest; 0 before the first.
    pub(super) fn version(&self) -> u64 {
        self.newest.as_ref().map_or(0, |it| it.header.version)
    }

    /// Takes newer weights; the same ones may come again. Returns whether they are new.
    ///
    /// # Errors
    /// A version that cannot follow the newest one; the reason, for a person.
    fn put(&mut self, header: WeightsHeader, safetensors: &[u8]) -> Result<bool, String> {
        let newest = self.version();
        if self.newest.as_ref().is_some_and(|it| it.header == header) {
            return Ok(false);
        }
        if header.version <= newest || header.version - newest > VERSION_STEP_MAX {
            return Err(format!("version {} after version {newest}", header.version));
        }
        self.newest = Some(Arc::new(Weights {
            header,
            safetensors: safetensors.to_vec(),
        }));
        Ok(true)
    }

    /// The weights that `request` asks for, and where the piece starts.
    fn find(&mut self, request: WeightsRequest) -> Result<(Arc<Weights>, usize), WeightsReply> {
        let (weights, offset) = match request {
            WeightsRequest::NewerThan(version) => {
                let newest = self.newest.clone();
                let newer = newest.filter(|it| it.header.version > version);
                (newer.ok_or(WeightsReply::NoneNewer)?, 0)
            }
            WeightsRequest::Piece { version, offset } => {
                let mut kept = self.pulled.iter().chain(&self.newest);
                let weights = kept.find(|it| it.header.version == version).cloned();
                let weights = weights.ok_or(WeightsReply::Gone)?;
                let offset = usize::try_from(offset).unwrap_or(usize::MAX);
                let in_it =
                    offset < weights.safetensors.len() && offset.is_multiple_of(PIECE_BYTES);
                (weights, in_it.then_some(offset).ok_or(WeightsReply::Gone)?)
            }
        };
        self.pulled.retain(|it| !Arc::ptr_eq(it, &weights));
        self.pulled.push_back(weights.clone());
        if self.pulled.len() > KEPT_MAX {
            self.pulled.pop_front();
        }
        Ok((weights, offset))
    }
}

impl Service {
    pub(super) fn weights(&self) -> MutexGuard<'_, WeightsStore> {
        self.weights.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn take_weights(&self, query: Query) {
        let payload = query.payload().map(|payload| payload.to_bytes());
        let payload = payload.unwrap_or_default();
        let (upload, safetensors) = match WeightsUpload::decode(&payload, self.spec_hash) {
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
                self.reply(&query, Kind::Done, &());
            }
            Err(why) => {
                tracing::warn!("weights were refused: {why}");
                self.state().replay.note_refused_message();
            }
        }
    }

    fn announce(&self, version: u64) {
        let announced = codec::encode(
            Kind::WeightsVersion,
            self.spec_hash,
            &WeightsVersion { version },
            &[],
        );
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
        let Some(request) = self.read::<WeightsRequest>(&query, Kind::WeightsRequest) else {
            return;
        };
        let found = self.weights().find(request);
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
        match codec::seal(Kind::Weights, self.spec_hash, &reply, piece) {
            Ok(head) => {
                let piece = ZBytes::from(piece.to_vec());
                session::answer(&query, session::join_planes(head, piece));
            }
            Err(e) => tracing::error!("weights were not sent: {e}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(version: u64) -> WeightsHeader {
        WeightsHeader::new(version, 0, &[])
    }

    fn piece(version: u64, offset: usize) -> WeightsRequest {
        let offset = offset as u64;
        WeightsRequest::Piece { version, offset }
    }

    #[test]
    fn versions_rise_by_sane_steps() {
        let mut store = WeightsStore::default();
        assert_eq!(store.put(header(1), b"a"), Ok(true));
        assert_eq!(store.put(header(1), b"a"), Ok(false), "sent again");
        assert_eq!(store.put(header(3), b"b"), Ok(true));
        for version in [0, 2, 3, 4 + VERSION_STEP_MAX, u64::MAX] {
            let other = WeightsHeader::new(version, 9, &[]);
            assert!(store.put(other, b"c").is_err(), "{version}");
        }
        assert_eq!(store.version(), 3);
    }

    #[test]
    fn a_slow_actor_gets_what_it_began_with_while_others_go_on() {
        let mut store = WeightsStore::default();
        let newest = WeightsRequest::NewerThan(0);
        assert_eq!(store.find(newest).err(), Some(WeightsReply::NoneNewer));
        let file = vec![7; 3 * PIECE_BYTES];
        store.put(header(1), &file).unwrap();
        assert_eq!(store.find(newest).unwrap().0.header.version, 1);
        for version in 2..20 {
            store.put(header(version), &file).unwrap();
            let found = store.find(WeightsRequest::NewerThan(version - 1)).unwrap();
            assert_eq!((found.0.header.version, found.1), (version, 0));
            let found = store.find(piece(1, PIECE_BYTES)).unwrap();
            assert_eq!((found.0.header.version, found.1), (1, PIECE_BYTES));
            assert!(store.pulled.len() <= KEPT_MAX);
        }
        let current = WeightsRequest::NewerThan(19);
        assert_eq!(store.find(current).err(), Some(WeightsReply::NoneNewer));
        for gone in [
            piece(2, 0),
            piece(99, 0),
            piece(19, 1),
            piece(19, 3 * PIECE_BYTES),
        ] {
            assert_eq!(store.find(gone).err(), Some(WeightsReply::Gone), "{gone:?}");
        }
    }
}
