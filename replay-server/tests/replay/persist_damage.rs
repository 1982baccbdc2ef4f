//! A log with flipped bits, missing or foreign files: a warning reports each, the rest is used, and rows of batches are still right.

use std::{
    fs,
    path::{Path, PathBuf},
};

use driml_protocol::{
    Buffer, Chunk, ChunkHeader, InsertReply, PROTOCOL_VERSION, RequestId, RunSpec,
};
use driml_replay_server::{
    Config, PersistArgs, PersistError, RecoveryReport, Replay, ReplayFolder,
};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    batches::{check_batch, check_rows},
    calls::{header, is_stored, learned, prioritised},
    history::History,
    persist::{ROWS, StoredReplay, args, open, segments, stored, test_spec},
};

/// A log of about a dozen segments with some transitions each, and a reference of its content.
struct SavedLog {
    _root: tempfile::TempDir,
    args: PersistArgs,
    config: Config,
    history: History,
    stored: Vec<u8>,
}

impl SavedLog {
    fn new(capacity: u64) -> Self {
        let root = tempfile::tempdir().unwrap();
        let (dir, config) = (root.path().join("log"), Config::unlimited(capacity));
        let mut setup = StoredReplay::begin(&dir, config, 4_000, 3);
        // Until the newest segment has some transitions, too.
        let (mut newest, mut in_newest) = (None, 0);
        while setup.history.inserted < 800 || in_newest < 5 {
            setup.store(0);
            setup.draw(0);
            let last = segments(&setup.args.dir).pop();
            in_newest = if last == newest { in_newest + 1 } else { 0 };
            newest = last;
        }
        Self {
            _root: root,
            stored: stored(&setup.replay),
            args: setup.args,
            config: setup.config,
            history: setup.history,
        }
    }

    fn segments(&self) -> Vec<PathBuf> {
        segments(&self.args.dir)
    }

    fn open(&self) -> (Replay, RecoveryReport) {
        open(&self.args, &self.config).unwrap()
    }

    /// Opens the log, and checks that each of `words` is in a warning. Without words, no warning may come.
    fn open_with_warnings(&self, words: &[&str]) -> Replay {
        let (replay, recovery) = self.open();
        let is_warned = |words: &&str| recovery.warnings.iter().any(|it| it.contains(words));
        assert!(words.iter().all(is_warned), "{words:?}: {recovery:?}");
        assert!(
            !words.is_empty() || recovery.warnings.is_empty(),
            "{recovery:?}"
        );
        replay
    }

    /// Checks the restored replay and batches from it: they contain no lost transition.
    fn check(&self, replay: &mut Replay) {
        replay.check_valid();
        for client in 0..200 {
            let drawn = replay.draw_for(RequestId::first(1_000 + client), ROWS, Buffer::zeroed);
            let mut batch = drawn.unwrap().unpack();
            assert!(batch.header.held <= self.history.inserted);
            batch.header.held = self.history.inserted - self.history.oldest();
            check_batch(&batch, &self.history);
        }
    }
}

fn flip(path: &Path, at: impl FnOnce(usize) -> usize) {
    let mut bytes = fs::read(path).unwrap();
    let at = at(bytes.len());
    bytes[at] ^= 4;
    fs::write(path, bytes).unwrap();
}

/// Drops the replay and opens its folder again: all that was stored must be restored.
fn check_comes_back(setup: StoredReplay) {
    let before = stored(&setup.replay);
    let (args, config) = setup.end();
    let (replay, recovery) = open(&args, &config).unwrap();
    assert_eq!(recovery.warnings, [""; 0]);
    assert!(stored(&replay) == before);
}

/// Damages a log in any way at any place: a bit, a range, a cut, a missing file, a file in the place of another.
fn damage(dir: &Path, rng: &mut ChaCha8Rng) {
    let all = segments(dir);
    let path = &all[rng.random_range(0..all.len())];
    let mut bytes = fs::read(path).unwrap();
    let at = rng.random_range(0..bytes.len().max(1));
    match rng.random_range(0..6) {
        0 => return fs::remove_file(path).unwrap(),
        1 => bytes.truncate(at),
        2 => bytes[at..].fill(0),
        3 => {
            let end = bytes.len().min(at + rng.random_range(1..600));
            rng.fill(&mut bytes[at..end]);
        }
        4 => bytes = fs::read(&all[rng.random_range(0..all.len())]).unwrap(),
        // Earlier damage may have left nothing.
        _ if bytes.is_empty() => {}
        _ => bytes[at] ^= 1 << rng.random_range(0..8),
    }
    fs::write(path, bytes).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Whatever happens to the files, the server starts or gives a reason. The rows that it serves are right, and it can be opened again.
    #[test]
    fn whatever_is_damaged_what_is_served_is_right(seed in any::<u64>(), damages in 1usize..5, capacity in 300u64..2_000) {
        let mut kept = SavedLog::new(capacity);
        // If the end was cut off, older transitions are still held.
        kept.history.capacity = u64::MAX;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for _ in 0..damages {
            if !kept.segments().is_empty() {
                damage(&kept.args.dir, &mut rng);
            }
        }
        let Ok((mut replay, _)) = open(&kept.args, &kept.config) else {
            return Ok(());
        };
        replay.check_valid();
        let status = replay.status();
        prop_assert!(status.transitions_inserted <= kept.history.inserted);
        for client in 0..20 {
            let drawn = replay.draw_for(RequestId::first(1_000 + client), ROWS, Buffer::zeroed);
            // There may be no transition left.
            let Ok(batch) = drawn else { break };
            check_rows(&batch.unpack(), &kept.history);
        }
        let before = stored(&replay);
        drop(replay);
        let (replay, _) = kept.open();
        prop_assert_eq!(stored(&replay), before);
    }
}

/// Copies the first `bytes` bytes of a segment to the file of segment `number`.
fn copy_to(segment: &Path, number: u64, bytes: usize) {
    let other = segment.with_file_name(format!("segment-{number:012}.log"));
    let copied = fs::read(segment).unwrap();
    fs::write(other, &copied[..bytes.min(copied.len())]).unwrap();
}

/// Damages the third byte of the second record's length, so that the record looks like an incomplete write. An incomplete write was never
/// acknowledged, but this record was.
fn lengthen_a_record(segment: &Path) {
    let bytes = fs::read(segment).unwrap();
    let heads = bytes.windows(4).enumerate();
    let heads: Vec<_> = heads.filter(|(_, it)| it == b"DRL1").collect();
    assert!(heads.len() > 4, "{}", heads.len());
    flip(segment, |_| heads[1].0 + 16 + 3);
}

fn remove(path: &Path) {
    fs::remove_file(path).unwrap();
}

fn append_zeros(segment: &Path) {
    let mut bytes = fs::read(segment).unwrap();
    bytes.extend_from_slice(&[0; 5_000]);
    fs::write(segment, &bytes).unwrap();
}

/// What remains: all transitions, all counts and the transitions of other segments, or the state of an earlier moment.
#[derive(Clone, Copy, PartialEq)]
enum Left {
    All,
    Counts,
    Beginning,
}
use Left::{All, Beginning, Counts};

/// Damages the last segment, or an earlier one.
#[test]
fn damage_costs_what_it_hits_and_is_said() {
    type Spoil = fn(&Path);
    let last = usize::MAX;
    let gone = "are lost";
    let next = "can be read: the replay is what it was";
    let misplaced = "not the segment that belongs here";
    let flip_late: Spoil = |it| flip(it, |length| length * 2 / 3);
    let flip_early: Spoil = |it| flip(it, |_| 40);
    let begin_one: Spoil = |it| copy_to(it, 999, 20);
    let misplace: Spoil = |it| copy_to(it, 600, 1 << 20);
    let forget_id: Spoil = |it| remove(&it.with_file_name("log.toml"));
    let empty: Spoil = |it| fs::write(it, []).unwrap();
    let back_up: Spoil = |it| {
        fs::copy(it, it.with_file_name("segment-3.log")).unwrap();
    };
    let early = &["its beginning is damaged", "is now", gone];
    let cases: &[(usize, Spoil, &[&str], Left)] = &[
        (5, flip_late, &["damaged at byte", gone], Counts),
        (4, flip_early, early, Counts),
        (7, remove, &[gone, "missing"], Counts),
        (0, remove, &["the oldest segments are missing"], Counts),
        (last, remove, &[next], Beginning),
        (last, empty, &[next], Beginning),
        (last, lengthen_a_record, &["are cut off"], Beginning),
        (last, append_zeros, &[], All),
        // A segment that was just begun, one under another's name, a copy, and a missing identity, which the segments have too.
        (3, begin_one, &[], All),
        (3, misplace, &[misplaced], All),
        (3, back_up, &[], All),
        (0, forget_id, &[], All),
    ];
    for (number, (segment, spoil, words, left)) in cases.iter().enumerate() {
        let kept = SavedLog::new(10_000);
        let segments = kept.segments();
        spoil(&segments[*segment.min(&(segments.len() - 1))]);
        let mut replay = kept.open_with_warnings(words);
        let status = replay.status();
        assert_eq!(status.transitions_lost, 0, "case {number}");
        let inserted = kept.history.inserted;
        let is_whole = status.transitions_inserted == inserted;
        assert_eq!(is_whole, *left != Beginning, "case {number}");
        assert!(
            *left != All || stored(&replay) == kept.stored,
            "case {number}"
        );
        replay.check_valid();
        if is_whole {
            kept.check(&mut replay);
        }
        // The warning is repeated as long as the lost transitions would be held, unless no older segment is left.
        let after = stored(&replay);
        drop(replay);
        let (replay, recovery) = kept.open();
        assert!(stored(&replay) == after, "case {number}");
        let says_gone = recovery.warnings.iter().any(|it| it.contains(gone));
        let is_within = *left == Counts && *segment > 0;
        assert_eq!(says_gone, is_within, "case {number}: {recovery:?}");
    }
    // No warning comes if the oldest segments were removed with their transitions.
    let kept = SavedLog::new(100);
    let mut replay = kept.open_with_warnings(&[]);
    assert_eq!(stored(&replay), kept.stored);
    kept.check(&mut replay);
}

/// Lost chunks that were acknowledged are never sent again. The actor's next chunk is accepted, and the loss is counted.
#[test]
fn after_a_loss_an_actor_continues_and_the_loss_is_counted() {
    let kept = SavedLog::new(10_000);
    let newest = kept.segments().pop().unwrap();
    flip(&newest, |length| length * 3 / 4);
    let mut replay = kept.open_with_warnings(&["are cut off"]);
    let before = replay.status();
    let lost = kept.history.inserted - before.transitions_inserted;
    assert!(lost > 0);
    let header = |sequence| ChunkHeader {
        steps: 4,
        ..header(0, 1, sequence, kept.history.inserted)
    };
    // Far beyond the last restored chunk.
    let sequence = 10_000;
    let mut insert = |sequence| replay.insert(&Chunk::zeroed(header(sequence)));
    // A chunk that overtook the one before is rejected. An actor that then repeats the same chunk has no older one.
    for early in [sequence + 1, sequence] {
        let reply = insert(early);
        assert!(matches!(reply, InsertReply::OutOfOrder { .. }), "{reply:?}");
    }
    assert!(is_stored(&insert(sequence)));
    assert!(is_stored(&insert(sequence)), "a retry");
    let status = replay.status();
    assert_eq!(status.transitions_inserted, before.transitions_inserted + 8);
    assert_eq!(status.transitions_lost, lost);
    assert_eq!(status.transitions_duplicated, 0);
    replay.check_valid();
    let after = stored(&replay);
    drop(replay);
    let replay = kept.open_with_warnings(&[]);
    assert_eq!(stored(&replay), after);
}

#[test]
fn a_chunk_that_overtook_others_before_they_came_is_not_stored_ahead_of_the_next() {
    let kept = SavedLog::new(10_000);
    let mut replay = kept.open_with_warnings(&[]);
    let mut insert = |sequence| {
        let header = header(0, 1, sequence, kept.history.inserted);
        replay.insert(&Chunk::zeroed(header))
    };
    let InsertReply::OutOfOrder { expected } = insert(10_000) else {
        panic!("a chunk from far beyond")
    };
    for (sequence, may_be_stored) in [(3, false), (0, true), (1, true), (3, false), (2, true)] {
        let reply = insert(expected + sequence);
        assert_eq!(is_stored(&reply), may_be_stored, "{sequence}: {reply:?}");
    }
}

#[test]
fn a_segment_of_another_log_is_left_alone() {
    let (kept, other) = (SavedLog::new(10_000), SavedLog::new(10_000));
    let foreign = kept.args.dir.join("segment-000000000500.log");
    fs::copy(&other.segments()[3], &foreign).unwrap();
    let replay = kept.open_with_warnings(&["segment-000000000500.log is not of this log"]);
    assert_eq!(stored(&replay), kept.stored);
    assert!(foreign.exists());
}

#[test]
fn a_folder_is_one_servers_and_one_runs() {
    let kept = SavedLog::new(10_000);
    let check_refused = |args: &PersistArgs, spec: &RunSpec, config: &Config, words| {
        let opened = Replay::open(args, spec, config, ROWS).map(drop);
        let error = opened.unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    };
    let (own, spec, config) = (&kept.args, &test_spec(), &kept.config);
    let (replay, _) = kept.open();
    let words = "another replay server keeps its replay in";
    check_refused(own, spec, config, words);
    drop(replay);

    // A snapshot with more priorities could not be written.
    let fits = |capacity| ReplayFolder::open(own, spec, &prioritised(capacity, 0.5)).is_ok();
    assert!(fits(31_000_000) && !fits(32_000_000));

    let mut shard = kept.args.clone();
    shard.shard = 1;
    let mut shards = kept.config.clone();
    shards.shards = 2;
    let words = "holds the replay of another run (shard 0 of 1; this is shard 1 of 2)";
    check_refused(&shard, spec, &shards, words);

    let mut other = test_spec();
    other.seed += 1;
    check_refused(own, &other, config, "its run spec has the hash");

    let file = kept.args.dir.join("log.toml");
    let words = "needs a folder with room that this process may write";
    check_refused(&args(&file, 1000), spec, config, words);

    let text = fs::read_to_string(&file).unwrap();
    let ours = format!("format = 700{PROTOCOL_VERSION}");
    fs::write(&file, text.replace(&ours, "format = 4")).unwrap();
    let words = "holds a replay of format 4, this version reads 700";
    check_refused(own, spec, config, words);
}

#[test]
fn what_cannot_be_read_is_rejected_until_it_is_removed() {
    let folder = tempfile::tempdir().unwrap();
    let begin = || StoredReplay::begin(folder.path(), Config::unlimited(100), 4_000, 5);
    let (args, config) = begin().end();
    let segment = segments(folder.path()).remove(0);
    flip(&segment, |_| 40);
    let damaged = fs::read(&segment).unwrap();
    for _ in 0..2 {
        let Err(PersistError::Unusable(unusable, why)) = open(&args, &config) else {
            panic!("a damaged segment")
        };
        assert_eq!(unusable, folder.path());
        assert!(why.contains("remove its segments"), "{why}");
        assert_eq!(fs::read(&segment).unwrap(), damaged);
    }
    remove(&segment);
    let mut setup = begin();
    setup.store(0);
    check_comes_back(setup);
}

#[test]
fn a_segment_that_cannot_be_begun_stops_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut setup = StoredReplay::begin(folder.path(), Config::unlimited(2_000), 4_000, 5);
    let next = folder.path().join("segment-000000000001.log");
    fs::create_dir(&next).unwrap();
    for _ in 0..80 {
        setup.store(0);
        assert!(!setup.replay.is_disk_failing(), "what is stored is written");
    }
    fs::remove_dir(&next).unwrap();
    // The learner's checkpoint begins a segment.
    setup.replay.set_progress(learned(1, 1, 0)).unwrap();
    assert!(next.is_file());
    setup.store(0);
    check_comes_back(setup);
}

/// Opens the log with other settings of the same run, which determine what is held.
#[test]
fn a_run_may_go_on_with_another_capacity() {
    for capacity in [100, 50_000] {
        let kept = SavedLog::new(10_000);
        let config = Config::unlimited(capacity);
        let (mut replay, recovery) = open(&kept.args, &config).unwrap();
        assert_eq!(recovery.warnings, [""; 0]);
        let (status, held) = (replay.status(), replay.status().transitions_held);
        let holdable = capacity.min(status.transitions_inserted);
        assert!(held <= holdable && held * 10 > holdable * 8, "{held}");
        replay.check_valid();
        replay.sample(ROWS).unwrap();
    }
    // Also if more transitions are gone than the ring holds.
    let kept = SavedLog::new(10_000);
    let segments = kept.segments();
    segments[1..segments.len() - 2]
        .iter()
        .for_each(|it| remove(it));
    let (replay, recovery) = open(&kept.args, &Config::unlimited(60)).unwrap();
    assert!(recovery.warnings[0].contains("are lost"), "{recovery:?}");
    replay.check_valid();
    let status = replay.status();
    assert_eq!(status.transitions_inserted, kept.history.inserted);
    // A ring without room for a chunk of the log does not change the log.
    let kept = SavedLog::new(10_000);
    let too_small = open(&kept.args, &Config::unlimited(7)).map(drop);
    let error = too_small.unwrap_err().to_string();
    let why = "transitions in one chunk; the replay holds 7";
    assert!(error.contains(why), "{error}");
    assert_eq!(stored(&kept.open_with_warnings(&[])), kept.stored);
}
