//! A replay on disk, stopped at any record and at any byte of its last write: recovery restores all that was stored.
//! `persist_damage` tests the cost of damage.

use std::{
    fs,
    path::{Path, PathBuf},
};

use driml_protocol::{Batch, Buffer, Horizon, RequestId, RunSpec, Shutdown};
use driml_replay_server::{
    Compression, Config, PersistArgs, PersistError, RecoveryControl, RecoveryReport, Replay,
    ReplayFolder, kept_size,
};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    batches::check_batch,
    calls::{Actor, affinity, is_stored, join, learned, learner, prioritised},
    history::{History, spec},
};

pub(crate) const ROWS: u32 = 4;
/// Bytes of a record before its body, and the offset of the body's length.
const HEAD_BYTES: u64 = 32;
const LENGTH_AT: usize = 16;

/// A replay in a folder, all transitions stored in it, and its actors and clients.
pub(crate) struct StoredReplay {
    pub(crate) args: PersistArgs,
    pub(crate) config: Config,
    pub(crate) replay: Replay,
    pub(crate) history: History,
    pub(crate) rng: ChaCha8Rng,
    actors: [Actor; 2],
    requests: Vec<RequestId>,
    versions: u64,
}

pub(crate) fn test_spec() -> RunSpec {
    spec(3, 2, 2, Horizon::Nhg { k_max: 3 })
}

pub(crate) fn open(
    args: &PersistArgs,
    config: &Config,
) -> Result<(Replay, RecoveryReport), PersistError> {
    Replay::open(args, &test_spec(), config, ROWS)
}

/// Returns the arguments of a replay in `dir`, with segments of about `segment_bytes`.
pub(crate) fn args(dir: &Path, segment_bytes: u64) -> PersistArgs {
    PersistArgs {
        dir: dir.to_owned(),
        segment_bytes: Some(segment_bytes),
        ..PersistArgs::default()
    }
}

/// Returns the segments in a folder, ordered by number.
pub(crate) fn segments(dir: &Path) -> Vec<PathBuf> {
    let mut all: Vec<_> = fs::read_dir(dir)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|it| it == "log"))
        .collect();
    all.sort();
    all
}

fn bytes_in(dir: &Path) -> u64 {
    let lengths = segments(dir).into_iter();
    lengths.map(|it| fs::metadata(it).unwrap().len()).sum()
}

/// Copies all files of a folder into another.
pub(crate) fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, to.join(path.file_name().unwrap())).unwrap();
    }
}

/// Whether the ring holds as many of the newest transitions as its capacity.
fn is_held_by_number(config: &Config) -> bool {
    config.compressed_bytes_max.is_none() && config.disk_bytes_max.is_none()
}

/// Returns the state that a log restores after the server died.
pub(crate) fn stored(replay: &Replay) -> Vec<u8> {
    replay.stored_bytes().unwrap()
}

impl StoredReplay {
    /// Drops the replay, and returns the arguments and settings for its successor.
    pub(crate) fn end(self) -> (PersistArgs, Config) {
        drop(self.replay);
        (self.args, self.config)
    }

    pub(crate) fn begin(dir: &Path, config: Config, segment_bytes: u64, seed: u64) -> Self {
        let args = args(dir, segment_bytes);
        let (mut replay, recovery) = open(&args, &config).unwrap();
        assert!(!recovery.found);
        for actor in 0..2 {
            join(&mut replay, actor, 1);
        }
        replay.join_learner(learner(77, 0, 0, 0)).unwrap();
        let history = History::new(&test_spec(), config.capacity_transitions);
        Self {
            args,
            config,
            replay,
            history,
            rng: ChaCha8Rng::seed_from_u64(seed),
            actors: [0, 1].map(|actor| Actor::new(actor, 1)),
            requests: (0..3).map(RequestId::first).collect(),
            versions: 0,
        }
    }

    /// Stores the next chunk of an actor.
    pub(crate) fn store(&mut self, actor: usize) {
        let actor = &mut self.actors[actor];
        actor.next.weights_version = self.rng.random_range(0..9);
        let header = actor.send(2, self.rng.random_range(1..6));
        let chunk = self.history.next_chunk(header, 0, &mut self.rng);
        let reply = self.replay.insert(&chunk);
        assert!(is_stored(&reply), "{reply:?}");
    }

    /// Draws a batch for the request of a client; `None` if none is available.
    pub(crate) fn draw(&mut self, client: usize) -> Option<Batch> {
        let id = self.requests[client];
        let drawn = self.replay.draw_for(id, ROWS, Buffer::zeroed);
        drawn.ok().map(|it| it.unpack())
    }

    pub(crate) fn act(&mut self) {
        match self.rng.random_range(0..20) {
            0..9 => {
                let actor = self.rng.random_range(0..2);
                self.store(actor);
            }
            9..16 => {
                let client = self.rng.random_range(0..3);
                let id = &mut self.requests[client];
                // A batch that did not arrive is requested again.
                *id = if self.rng.random_bool(0.3) {
                    id.retry()
                } else {
                    id.next()
                };
                if let Some(batch) = self.draw(client)
                    && is_held_by_number(&self.config)
                {
                    check_batch(&batch, &self.history);
                }
            }
            16 => {
                self.versions += 1;
                let matrix = (0..25)
                    .map(|at| if at % 5 == 0 { 0.6 } else { 0.1 })
                    .collect();
                let update = affinity(self.versions, matrix);
                self.replay.set_affinity(&update).unwrap();
            }
            17 => {
                let actor = self.rng.random_range(0..2);
                let left = &mut self.actors[actor as usize];
                self.replay.leave(&left.leave());
                let incarnation = left.next.incarnation + 1;
                *left = Actor::new(actor, incarnation);
                join(&mut self.replay, actor, incarnation);
            }
            18 => {
                let served = self.replay.counts().rows_sampled;
                let join = learner(self.rng.random(), 1, served - served.min(3), 0);
                self.replay.join_learner(join).unwrap();
            }
            _ => {
                // A request that cannot be answered yet, or never.
                let id = RequestId::first(9);
                let _ = self.replay.draw_for(id, 1, Buffer::zeroed);
            }
        }
    }
}

/// Returns the end of the record that begins at byte `at` of a segment.
fn record_end(bytes: &[u8], at: u64) -> u64 {
    let length = &bytes[at as usize + LENGTH_AT..][..8];
    at + HEAD_BYTES + u64::from_le_bytes(length.try_into().unwrap())
}

/// Uses a replay restored after a crash: the learner's report replaces the count of rows, and rows are right.
fn check_continues(setup: &StoredReplay, mut replay: Replay) {
    let rows = setup.replay.counts().rows_sampled;
    replay.set_progress(learned(0, 0, rows)).unwrap();
    assert_eq!(replay.counts(), setup.replay.counts());
    for client in 0..6 {
        let id = RequestId::first(1000 + client);
        if let Ok(batch) = replay.draw_for(id, ROWS, Buffer::zeroed)
            && is_held_by_number(&setup.config)
        {
            check_batch(&batch.unpack(), &setup.history);
        }
    }
    replay.check_valid();
}

fn configs() -> impl Strategy<Value = Config> {
    let compression = prop_oneof![Just(Compression::None), Just(Compression::Lz4)];
    let replay_ratio = prop_oneof![Just(2.0), Just(1e6)];
    (20u64..200, compression, replay_ratio, 0u64..3).prop_map(
        |(capacity, compression, replay_ratio, bounded)| Config {
            compression,
            replay_ratio,
            disk_bytes_max: (bounded == 0).then_some(4 << 20),
            fsync_ms: (bounded == 1).then_some(0),
            ..Config::unlimited(capacity)
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn what_comes_back_is_what_was_there_at_the_last_whole_record(
        seed in any::<u64>(), config in configs(), segment_bytes in 500u64..20_000, actions in 1u32..120, cut in any::<u64>()
    ) {
        let root = tempfile::tempdir().unwrap();
        let mut setup = StoredReplay::begin(&root.path().join("living"), config, segment_bytes, seed);
        for _ in 0..actions {
            setup.act();
        }
        let (before, known) = (stored(&setup.replay), segments(&setup.args.dir));
        let newest = known.last().unwrap().clone();
        let length = fs::metadata(&newest).unwrap().len();
        setup.act();
        let after = stored(&setup.replay);
        setup.replay.check_valid();

        // The process dies now; everything is on disk.
        let dead = root.path().join("dead");
        copy(&setup.args.dir, &dead);
        let (replay, recovery) = open(&args(&dead, segment_bytes), &setup.config).unwrap();
        prop_assert!(recovery.found && recovery.warnings.is_empty(), "{:?}", recovery.warnings);
        prop_assert_eq!(stored(&replay), after.clone());
        replay.check_valid();
        drop(replay);

        // The process died while it wrote the last record, at any byte of it.
        let torn = root.path().join("torn");
        copy(&setup.args.dir, &torn);
        let path = torn.join(newest.file_name().unwrap());
        if path.exists() && fs::metadata(&path).unwrap().len() > length {
            let bytes = fs::read(&path).unwrap();
            let end = record_end(&bytes, length);
            let cut = length + cut % (end - length);
            fs::write(&path, &bytes[..cut as usize]).unwrap();
            for later in segments(&torn) {
                if later > path {
                    fs::remove_file(later).unwrap();
                }
            }
            if seed % 2 == 0 {
                // The power failed, and the next segment was begun.
                let number: u64 = path.file_stem().unwrap().to_str().unwrap()[8..].parse().unwrap();
                fs::write(torn.join(format!("segment-{:012}.log", number + 1)), "").unwrap();
            }
            // Skips cases in which this write removed segments, which would still exist if it had not completed.
            for older in &known {
                let kept = torn.join(older.file_name().unwrap());
                prop_assume!(kept.exists());
            }
            let (replay, recovery) = open(&args(&torn, segment_bytes), &setup.config).unwrap();
            prop_assert!(recovery.warnings.is_empty(), "{:?}", recovery.warnings);
            prop_assert_eq!(stored(&replay), before);
            replay.check_valid();
        }

        // The replay can be opened again after a recovery.
        let (replay, _) = open(&args(&dead, segment_bytes), &setup.config).unwrap();
        prop_assert_eq!(stored(&replay), after);
        check_continues(&setup, replay);
    }
}

#[test]
fn a_log_tells_its_size() {
    let root = tempfile::tempdir().unwrap();
    let dir = root.path().join("ring");
    assert_eq!(kept_size(&dir, 0, 1), None);
    let config = Config {
        compression: Compression::Lz4,
        compressed_bytes_max: Some(2_000),
        ..Config::unlimited(100)
    };
    drop(StoredReplay::begin(&dir, config, 2_000, 5));
    let size = kept_size(&dir, 0, 1).unwrap();
    assert!(size.capacity_transitions == 100 && size.compressed_bytes_max == Some(2_000));
}

#[test]
fn segments_go_with_their_transitions_and_the_budget_is_kept() {
    // Transitions of 36 + 6 bytes each are held. With priorities, a snapshot has 8 bytes for each, so that it is larger than a segment.
    let rings = [
        (Config::unlimited(100), 2_000, 600, 20_000),
        (prioritised(2_000, 0.5), 4_000, 1_500, 400_000),
    ];
    for (config, segment_bytes, chunks, most) in rings {
        let root = tempfile::tempdir().unwrap();
        let mut setup = StoredReplay::begin(root.path(), config, segment_bytes, 5);
        for _ in 0..chunks {
            setup.store(0);
        }
        let bytes = bytes_in(root.path());
        assert!(bytes < most, "{bytes}");
    }

    // The ring is larger than the budget: the oldest transitions leave the ring too.
    let root = tempfile::tempdir().unwrap();
    let config = Config {
        disk_bytes_max: Some(4 << 20),
        ..Config::unlimited(1_000_000)
    };
    let mut setup = StoredReplay::begin(root.path(), config, 200_000, 5);
    while setup.history.inserted < 150_000 {
        setup.store(1);
        // A checkpoint every 2,000 transitions: no segment is ever full.
        let saved = setup.history.inserted / 2000;
        setup.replay.set_progress(learned(saved, saved, 0)).unwrap();
        let bytes = bytes_in(&setup.args.dir);
        assert!(bytes <= 4 << 20, "{bytes}");
    }
    let held = setup.replay.status().transitions_held;
    assert!((40_000..100_000).contains(&held), "{held}");
    setup.replay.check_valid();
    assert!(setup.draw(0).is_some());
    // Each restart begins a segment, which has its share of the budget.
    for _ in 0..12 {
        // Unlocks the folder.
        setup.replay = Replay::new(&test_spec(), &setup.config, ROWS).unwrap();
        let (replay, recovery) = open(&setup.args, &setup.config).unwrap();
        // What the budget removed before this start is not missing.
        assert_eq!(recovery.warnings, [""; 0]);
        setup.replay = replay;
        (0..300).for_each(|_| setup.store(1));
        let bytes = bytes_in(&setup.args.dir);
        assert!(bytes <= 4 << 20, "{bytes}");
    }
    let restored = setup.replay.status().transitions_held;
    assert!((held - 10_000..held + 10_000).contains(&restored));
    setup.replay.check_valid();
}

#[test]
fn a_resumed_run_continues_with_what_was_kept() {
    let root = tempfile::tempdir().unwrap();
    let config = Config {
        replay_ratio: 4.0,
        warmup_transitions: 10,
        ..Config::unlimited(1000)
    };
    let mut setup = StoredReplay::begin(root.path(), config, 4000, 5);
    while setup.history.inserted < 100 {
        setup.store(0);
    }
    let mut batches = 0;
    while setup.draw(0).is_some() {
        setup.requests[0] = setup.requests[0].next();
        batches += 1;
    }
    assert!(batches > 80);
    let before = setup.replay.status();
    let (mut args, config) = setup.end();

    // The learner saved after 50 updates: rows beyond them are served again. Or the learner has done more updates than the log knows, as a
    // power cut lost the log's end.
    for (number, updates) in [(78, 50), (79, 70)] {
        let (mut replay, _) = open(&args, &config).unwrap();
        let rows = updates * u64::from(ROWS);
        replay
            .join_learner(learner(number, updates, rows, 60))
            .unwrap();
        let status = replay.status();
        assert_eq!(status.transitions_inserted, before.transitions_inserted);
        assert_eq!(status.rows_sampled, rows);
        assert_eq!(status.transitions_refilled, 0);
        let updates = replay.resumed_after_updates();
        assert_eq!(updates, 0, "the replay is of the whole run");
        replay.check_valid();
    }

    // A run is resumed in a folder without a replay: it continues the counts of the checkpoint, also after a restart.
    args.dir = root.path().join("fresh");
    let (mut replay, _) = open(&args, &config).unwrap();
    replay.join_learner(learner(80, 70, 280, 90)).unwrap();
    drop(replay);
    let (replay, _) = open(&args, &config).unwrap();
    assert_eq!(replay.resumed_after_updates(), 70);
    let counts = replay.counts();
    assert_eq!((counts.inserted, counts.rows_sampled), (90, 280));
}

/// Reading reports its progress and can be stopped, which leaves the log unchanged.
#[test]
fn reading_says_how_far_it_is_and_can_be_broken_off() {
    let root = tempfile::tempdir().unwrap();
    let mut setup = StoredReplay::begin(root.path(), Config::unlimited(200), 2_000, 5);
    for _ in 0..60 {
        setup.act();
    }
    let before = stored(&setup.replay);
    let (args, config) = setup.end();
    let bytes = || bytes_in(root.path());
    let find = || ReplayFolder::open(&args, &test_spec(), &config).unwrap();
    let empty = || Replay::new(&test_spec(), &config, ROWS).unwrap();

    let (kept, all, stop) = (find(), bytes(), Shutdown::default());
    stop.set();
    let control = RecoveryControl::new(stop);
    let broken_off = kept.recover(empty(), &control).map(drop);
    assert!(
        matches!(broken_off, Err(PersistError::Stopped)),
        "{broken_off:?}"
    );
    let progress = control.progress();
    assert_eq!((progress.bytes_read, progress.bytes), (0, all));
    assert_eq!(bytes(), all);

    let kept = find();
    assert!(
        matches!(open(&args, &config), Err(PersistError::InUse(_))),
        "the folder is taken before it is read"
    );
    let control = RecoveryControl::new(Shutdown::default());
    let (replay, recovery) = kept.recover(empty(), &control).unwrap();
    assert!(recovery.found && recovery.warnings.is_empty());
    let progress = control.progress();
    assert_eq!((progress.bytes_read, progress.bytes), (all, all));
    assert_eq!(stored(&replay), before);
}
