//! Logs whose disk rejects writes for a while, and forgotten actors: recovery restores all that was stored.

use std::{
    fs::{self, File},
    path::Path,
    sync::Arc,
};

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, End, EpisodesRequest, InsertReply, LearnerJoin, LearnerProgress,
    Leave, RunSpec, Sampling,
};
use tempfile::TempDir;

use super::{PersistArgs, PersistError};
use crate::{Config, Replay, ledger::actors::ACTORS_MAX};

fn open(dir: &Path, sampling: Sampling) -> Result<(Replay, Vec<String>), PersistError> {
    let config = Config {
        sampling,
        ..Config::unlimited(2_000)
    };
    let args = PersistArgs {
        dir: dir.to_owned(),
        segment_bytes: Some(4_000),
        ..PersistArgs::default()
    };
    let (replay, recovery) = Replay::open(&args, &RunSpec::smallest(), &config, 4)?;
    Ok((replay, recovery.warnings))
}

/// Creates a replay in a new folder, with an actor that has joined.
fn begin(sampling: Sampling) -> (TempDir, Replay) {
    let folder = tempfile::tempdir().unwrap();
    let (mut replay, _) = open(folder.path(), sampling).unwrap();
    replay.join_actor(ActorJoin::new(0, 1)).unwrap();
    (folder, replay)
}

/// Makes writes to the newest segment fail, as on a full disk. Returns the file to put back.
fn refuse(replay: &mut Replay) -> Arc<File> {
    let journal = replay.journal.as_mut().unwrap();
    let full = Arc::new(File::open("/dev/null").unwrap());
    std::mem::replace(&mut journal.file, full)
}

fn store(replay: &mut Replay, sequence: u64) {
    let steps = 20;
    let mut chunk = Chunk::zeroed(ChunkHeader {
        incarnation: 1,
        sequence,
        first_transition: sequence * steps,
        streams: 1,
        steps: steps as u32,
        frame_bytes: 1,
        ..ChunkHeader::default()
    });
    chunk.set(0, 0, 0.0, End::Terminal);
    let reply = replay.insert(&chunk);
    assert!(matches!(reply, InsertReply::Stored { .. }), "{reply:?}");
}

fn save_checkpoint(replay: &mut Replay) {
    let learned = LearnerProgress {
        updates: 1,
        saved_updates: 1,
        ..LearnerProgress::default()
    };
    replay.set_progress(learned).unwrap();
}

/// Drops the replay and opens its folder again: all that was stored must be restored.
fn check_comes_back(replay: Replay, dir: &Path) {
    let stored = replay.stored_bytes().unwrap();
    drop(replay);
    let (replay, warnings) = open(dir, Sampling::default()).unwrap();
    assert_eq!(warnings, [""; 0]);
    assert!(replay.stored_bytes().unwrap() == stored);
}

#[test]
fn a_segment_that_begins_after_the_disk_refused_loses_nothing() {
    let (folder, mut replay) = begin(Sampling::default());
    let learner = LearnerJoin {
        learner: 7,
        ..LearnerJoin::default()
    };
    replay.join_learner(learner).unwrap();
    let file = refuse(&mut replay);
    let leave = Leave::new(0, 1, 0);
    replay.leave(&leave);
    assert!(replay.is_disk_failing());
    replay.journal.as_mut().unwrap().file = file;
    // The learner's checkpoint begins the first segment after the disk accepts writes again.
    save_checkpoint(&mut replay);
    replay.join_actor(ActorJoin::new(1, 1)).unwrap();
    let bytes = |replay: &Replay| replay.journal.as_ref().unwrap().bytes();
    let before = bytes(&replay);
    replay.leave(&leave);
    assert_eq!(bytes(&replay), before, "a repeated `Leave` is not written");
    check_comes_back(replay, folder.path());
}

#[test]
fn an_actor_that_took_the_place_of_a_forgotten_one_comes_back() {
    let (folder, mut replay) = begin(Sampling::default());
    for actor in 0..ACTORS_MAX as u32 {
        replay.join_actor(ActorJoin::new(actor, 1)).unwrap();
    }
    replay.forget_absent(|actor, _| actor > 0);
    replay.join_actor(ActorJoin::new(9_999, 1)).unwrap();
    check_comes_back(replay, folder.path());
}

#[test]
fn what_cannot_be_read_is_rejected_until_it_is_removed() {
    let (folder, mut replay) = begin(Sampling::default());
    store(&mut replay, 0);
    drop(replay);
    let segment = folder.path().join("segment-000000000000.log");
    let mut bytes = fs::read(&segment).unwrap();
    bytes[40] ^= 1;
    fs::write(&segment, &bytes).unwrap();
    let open = || open(folder.path(), Sampling::default());
    for _ in 0..2 {
        let Err(PersistError::Unusable(unusable, why)) = open() else {
            panic!("a damaged segment")
        };
        assert_eq!(unusable, folder.path());
        assert!(why.contains("remove its segments"), "{why}");
        assert_eq!(fs::read(&segment).unwrap(), bytes);
    }
    fs::remove_file(&segment).unwrap();
    let (mut replay, warnings) = open().unwrap();
    assert_eq!((replay.inserted_total(), warnings), (0, vec![]));
    replay.join_actor(ActorJoin::new(0, 1)).unwrap();
    store(&mut replay, 0);
    check_comes_back(replay, folder.path());
}

#[test]
fn a_segment_that_cannot_be_begun_stops_nothing() {
    let (folder, mut replay) = begin(Sampling::default());
    let next = folder.path().join("segment-000000000001.log");
    fs::create_dir(&next).unwrap();
    for sequence in 0..80 {
        store(&mut replay, sequence);
        assert!(!replay.is_disk_failing(), "what is stored is written");
    }
    fs::remove_dir(&next).unwrap();
    save_checkpoint(&mut replay);
    assert!(next.is_file());
    store(&mut replay, 80);
    check_comes_back(replay, folder.path());
}

/// With priorities, a snapshot has 8 bytes for each transition held.
#[test]
fn a_state_larger_than_a_segment_does_not_fill_the_disk() {
    let sampling = Sampling::Prioritised {
        alpha: 0.5,
        beta_start: 0.5,
        beta_end: 0.5,
        beta_updates: 1,
    };
    let (_folder, mut replay) = begin(sampling);
    let mut most = 0;
    for sequence in 0..800 {
        store(&mut replay, sequence);
        most = most.max(replay.journal.as_ref().unwrap().bytes());
    }
    // The 2,000 transitions held take 34 kB in chunks, and a snapshot takes 16 kB.
    assert!(most < 200_000, "{most}");
    // A capacity whose snapshot could not be written is rejected at the start.
    let fits = |capacity| {
        let unlimited = Config::unlimited(capacity);
        Config {
            sampling,
            ..unlimited
        }
        .check_on_disk()
        .is_ok()
    };
    assert!(fits(31_000_000) && !fits(32_000_000));
}

#[test]
fn where_a_launcher_records_it_alone_says_which_episodes_need_not_be_kept() {
    let (_folder, mut replay) = begin(Sampling::default());
    store(&mut replay, 0);
    for (since, is_launcher, kept) in [(1, false, 0), (0, true, 1), (1, false, 1), (1, true, 0)] {
        replay.answer_episodes(EpisodesRequest { since, is_launcher });
        let kept_now = replay.snapshot().state.statistics.episodes_since(0);
        assert_eq!(kept_now.episodes.len(), kept, "{since} {is_launcher}");
    }
}
