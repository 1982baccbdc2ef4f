//! Stores the newest weights, and older versions that actors still pull.

use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use driml_protocol::{
    PIECE_BYTES, Weights, WeightsHeader, WeightsReply, WeightsRequest, WeightsUpload, codec,
};

use crate::persist::journal::try_remove;

const FILE_NAME: &str = "weights.message";

/// Maximum versions kept while actors pull them. At the limit, an actor that begins to pull gets the newest of these versions. So even many
/// slow actors are served to the end, with slightly older weights.
const PULLED_VERSIONS_MAX: usize = 8;
/// How long a version is kept after the last request for a piece of it.
const PULL_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum increase of the version from one upload to the next. No learner reaches it.
const VERSION_STEP_MAX: u64 = 1 << 20;
/// Maximum version of the first upload. If a run is resumed without its replay, this may be any version that a run reaches.
const FIRST_VERSION_MAX: u64 = 1 << 53;

/// The newest weights, and older ones that are being pulled.
#[derive(Default)]
pub(super) struct WeightsStore {
    /// The file for the newest weights, if the replay is kept on disk, and the hash of the run spec.
    file: Option<(PathBuf, u64)>,
    newest: Option<Arc<Weights>>,
    /// The versions that are being pulled, oldest first, and when each was last requested.
    pulled: Vec<(Arc<Weights>, Instant)>,
}

impl WeightsStore {
    /// Returns a store that keeps the newest weights on disk beside the replay in `dir`. If the replay `was_kept`, reads the weights from
    /// there: actors that start after a restart need some before the learner publishes again. Otherwise removes old weights, as with them
    /// actors would store chunks before the learner joins.
    pub(super) fn open(dir: &Path, spec_hash: u64, was_kept: bool) -> Self {
        let path = dir.join(FILE_NAME);
        if !was_kept {
            try_remove(&path);
        }
        let read = |bytes: &[u8]| {
            let (upload, safetensors) = codec::decode::<WeightsUpload>(bytes, Some(spec_hash))?;
            anyhow::Ok(Weights {
                header: upload.weights,
                safetensors: safetensors.to_vec(),
            })
        };
        let newest = match fs::read(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => None,
            found => found
                .map_err(anyhow::Error::from)
                .and_then(|bytes| read(&bytes))
                .inspect_err(|e| tracing::warn!("{} is not used: {e}", path.display()))
                .ok(),
        };
        Self {
            file: Some((path, spec_hash)),
            newest: newest.map(Arc::new),
            pulled: Vec::new(),
        }
    }

    /// Returns a function that writes the newest weights to disk, if they are kept. It is slow: call it without a lock on this store.
    pub(super) fn disk_writer(&self) -> Option<impl FnOnce() + use<>> {
        let ((path, spec_hash), weights) = (self.file.clone()?, self.newest.clone()?);
        Some(move || {
            if let Err(e) = write_to_disk(&path, spec_hash, &weights) {
                tracing::warn!(
                    "weights {} were not kept in {}: {e:#}",
                    weights.header.version,
                    path.display()
                );
            }
        })
    }

    /// Returns the version of the newest weights; 0 before the first.
    pub(super) fn newest_version(&self) -> u64 {
        self.newest.as_ref().map_or(0, |it| it.header.version)
    }

    /// Takes newer weights; an upload may be repeated. Returns whether they are new, or why they cannot follow the newest.
    pub(super) fn update(
        &mut self,
        header: WeightsHeader,
        safetensors: &[u8],
    ) -> Result<bool, String> {
        let (newest, step_max) = match &self.newest {
            Some(newest) if newest.header == header => return Ok(false),
            Some(newest) => (newest.header.version, VERSION_STEP_MAX),
            None => (0, FIRST_VERSION_MAX),
        };
        if header.version <= newest || header.version - newest > step_max {
            return Err(format!("version {} after version {newest}", header.version));
        }
        self.newest = Some(Arc::new(Weights {
            header,
            safetensors: safetensors.to_vec(),
        }));
        Ok(true)
    }

    /// Returns the weights that `request` asks for, and the offset of the piece.
    pub(super) fn find_piece(
        &mut self,
        request: WeightsRequest,
        now: Instant,
    ) -> Result<(Arc<Weights>, usize), WeightsReply> {
        let (version, offset) = match request {
            WeightsRequest::NewerThan(version) => (self.version_to_pull(version, now)?, 0),
            WeightsRequest::Piece { version, offset } => {
                (version, usize::try_from(offset).unwrap_or(usize::MAX))
            }
        };
        let mut kept = self.pulled.iter_mut();
        let (weights, requested_at) = kept
            .find(|(weights, _)| weights.header.version == version)
            .ok_or(WeightsReply::Gone)?;
        *requested_at = now;
        if offset < weights.safetensors.len() && offset.is_multiple_of(PIECE_BYTES) {
            Ok((weights.clone(), offset))
        } else {
            Err(WeightsReply::Gone)
        }
    }

    /// Returns the version that a client with `version` should pull.
    fn version_to_pull(&mut self, version: u64, now: Instant) -> Result<u64, WeightsReply> {
        let newest = self.newest.as_ref();
        let newest = newest.filter(|it| it.header.version > version);
        let newest = newest.ok_or(WeightsReply::NoneNewer)?;
        let last = self.pulled.last();
        let last = last.map_or(0, |(it, _)| it.header.version);
        if last == newest.header.version {
            return Ok(last);
        }
        self.pulled
            .retain(|(_, at)| now.saturating_duration_since(*at) < PULL_TIMEOUT);
        if self.pulled.len() == PULLED_VERSIONS_MAX {
            if last > version {
                return Ok(last);
            }
            let idle = (0..PULLED_VERSIONS_MAX).min_by_key(|&at| self.pulled[at].1);
            idle.map(|at| self.pulled.remove(at));
        }
        self.pulled.push((newest.clone(), now));
        Ok(newest.header.version)
    }
}

/// Replaces the weights on disk, without a flush: a checksum detects a file that a power cut has damaged, and the learner uploads newer
/// weights.
fn write_to_disk(path: &Path, spec_hash: u64, weights: &Weights) -> anyhow::Result<()> {
    let upload = WeightsUpload {
        learner: 0,
        weights: weights.header,
    };
    let new_path = path.with_extension("new");
    let bytes = codec::encode(spec_hash, &upload, &weights.safetensors)?;
    let written = fs::write(&new_path, bytes).and_then(|()| fs::rename(&new_path, path));
    if written.is_err() {
        // On a full disk it would take the room that the log needs.
        try_remove(&new_path);
    }
    Ok(written?)
}

#[cfg(test)]
mod tests {
    use WeightsRequest::NewerThan;

    use super::*;

    fn header(version: u64) -> WeightsHeader {
        WeightsHeader::new(version, 0, &[])
    }

    fn piece(version: u64, offset: usize) -> WeightsRequest {
        let offset = offset as u64;
        WeightsRequest::Piece { version, offset }
    }

    impl WeightsStore {
        /// Returns the version and the offset that a request finds.
        fn found(
            &mut self,
            request: WeightsRequest,
            now: Instant,
        ) -> Result<(u64, usize), WeightsReply> {
            let found = self.find_piece(request, now);
            found.map(|(weights, offset)| (weights.header.version, offset))
        }
    }

    #[test]
    fn versions_rise_by_sane_steps() {
        let mut store = WeightsStore::default();
        assert_eq!(store.update(header(1), b"a"), Ok(true));
        assert_eq!(store.update(header(1), b"a"), Ok(false), "sent again");
        assert_eq!(store.update(header(3), b"b"), Ok(true));
        for version in [0, 2, 3, 4 + VERSION_STEP_MAX, u64::MAX] {
            let other = WeightsHeader::new(version, 9, &[]);
            assert!(store.update(other, b"c").is_err(), "{version}");
        }
        assert_eq!(store.newest_version(), 3);
        // A run that is resumed without its replay may begin with any version.
        let first = |version| WeightsStore::default().update(header(version), b"a");
        assert_eq!(first(2 << 20), Ok(true));
        assert!(first(FIRST_VERSION_MAX + 1).is_err());
    }

    #[test]
    fn a_slow_actor_gets_what_it_began_with_while_others_get_the_newest() {
        let (mut store, start) = (WeightsStore::default(), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        let file = vec![7; 3 * PIECE_BYTES];
        let none = Err(WeightsReply::NoneNewer);
        assert_eq!(store.found(NewerThan(0), start), none);
        for version in 1..20 {
            let now = at(version);
            store.update(header(version), &file).unwrap();
            assert_eq!(store.found(NewerThan(version - 1), now), Ok((version, 0)));
            let slow = store.found(piece(1, PIECE_BYTES), now);
            assert_eq!(slow, Ok((1, PIECE_BYTES)));
            assert!(store.pulled.len() <= PULLED_VERSIONS_MAX);
        }
        assert_eq!(store.found(NewerThan(19), at(20)), none);
        // A version that was dropped, one that never existed, and offsets at which no piece begins.
        for (version, offset) in [(2, 0), (99, 0), (19, 1), (19, 3 * PIECE_BYTES)] {
            let gone = store.found(piece(version, offset), at(20));
            assert_eq!(gone, Err(WeightsReply::Gone), "{version}, {offset}");
        }
    }

    #[test]
    fn when_too_many_versions_are_pulled_those_who_begin_join_one() {
        let (mut store, now) = (WeightsStore::default(), Instant::now());
        let last = PULLED_VERSIONS_MAX as u64;
        for version in 1..=last + 5 {
            store.update(header(version), &[7]).unwrap();
            let begun = store.found(NewerThan(0), now);
            let newest_pulled = version.min(last);
            assert_eq!(begun, Ok((newest_pulled, 0)));
        }
        // A client that already has that version gets the newest, which replaces the version that was requested longest ago.
        let later = now + Duration::from_secs(1);
        for version in 2..=last {
            let pulled = store.found(piece(version, 0), later);
            assert_eq!(pulled, Ok((version, 0)));
        }
        assert_eq!(store.found(NewerThan(last), later), Ok((last + 5, 0)));
        let gone = store.found(piece(1, 0), later);
        assert_eq!(gone, Err(WeightsReply::Gone));
    }

    #[test]
    fn weights_are_used_again_with_the_replay_that_they_were_kept_with() {
        let folder = tempfile::tempdir().unwrap();
        let open = |was_kept| WeightsStore::open(folder.path(), 5, was_kept);
        let mut store = open(true);
        store.update(WeightsHeader::new(7, 0, b"a"), b"a").unwrap();
        store.disk_writer().unwrap()();
        for (was_kept, version) in [(true, 7), (false, 0), (true, 0)] {
            assert_eq!(open(was_kept).newest_version(), version, "{was_kept}");
        }
        // A folder in their place: the temporary file cannot replace it.
        fs::create_dir(folder.path().join(FILE_NAME)).unwrap();
        store.disk_writer().unwrap()();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
