//! Logs whose disk rejects writes for a while, and forgotten actors: recovery restores all that was stored.

use std::{fs::File, path::Path, sync::Arc};

use driml_protocol::{ActorJoin, LearnerJoin, LearnerProgress, Leave, RunSpec};
use tempfile::TempDir;

use super::PersistArgs;
use crate::{Config, Replay, ledger::actors::ACTORS_MAX};

fn open(dir: &Path) -> Replay {
    let args = PersistArgs {
        dir: dir.to_owned(),
        segment_bytes: Some(4_000),
        ..PersistArgs::default()
    };
    let config = Config::unlimited(2_000);
    let (replay, recovery) = Replay::open(&args, &RunSpec::smallest(), &config, 4).unwrap();
    assert_eq!(recovery.warnings, [""; 0]);
    replay
}

/// Creates a replay in a new folder, with an actor that has joined.
fn begin() -> (TempDir, Replay) {
    let folder = tempfile::tempdir().unwrap();
    let mut replay = open(folder.path());
    replay.join_actor(ActorJoin::new(0, 1)).unwrap();
    (folder, replay)
}

/// Makes writes to the newest segment fail, as on a full disk. Returns the file to put back.
fn refuse(replay: &mut Replay) -> Arc<File> {
    let journal = replay.journal.as_mut().unwrap();
    let full = Arc::new(File::open("/dev/null").unwrap());
    std::mem::replace(&mut journal.file, full)
}

/// Drops the replay and opens its folder again: all that was stored must be restored.
fn check_comes_back(replay: Replay, dir: &Path) {
    let stored = replay.stored_bytes().unwrap();
    drop(replay);
    assert!(open(dir).stored_bytes().unwrap() == stored);
}

#[test]
fn a_segment_that_begins_after_the_disk_refused_loses_nothing() {
    let (folder, mut replay) = begin();
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
    let learned = LearnerProgress {
        updates: 1,
        saved_updates: 1,
        ..LearnerProgress::default()
    };
    replay.set_progress(learned).unwrap();
    replay.join_actor(ActorJoin::new(1, 1)).unwrap();
    let bytes = |replay: &Replay| replay.journal.as_ref().unwrap().bytes();
    let before = bytes(&replay);
    replay.leave(&leave);
    assert_eq!(bytes(&replay), before, "a repeated `Leave` is not written");
    check_comes_back(replay, folder.path());
}

#[test]
fn rows_that_the_learner_counts_after_its_first_request_count_here_too() {
    let (folder, mut replay) = begin();
    replay.join_learner(LearnerJoin::default()).unwrap();
    drop(replay);
    let mut replay = open(folder.path());
    for (rows_received, rows_sampled) in [(8, 8), (12, 12), (8, 12)] {
        let learned = LearnerProgress {
            rows_received,
            ..LearnerProgress::default()
        };
        replay.set_progress(learned).unwrap();
        assert_eq!(replay.counts().rows_sampled, rows_sampled);
    }
}

#[test]
fn an_actor_that_took_the_place_of_a_forgotten_one_comes_back() {
    let (folder, mut replay) = begin();
    for actor in 0..ACTORS_MAX as u32 {
        replay.join_actor(ActorJoin::new(actor, 1)).unwrap();
    }
    let forgotten = [5, 9_999].map(|joins| replay.forget_absent(joins, |actor, _| actor > 0));
    assert_eq!(forgotten, [vec![], vec![0]], "a known actor needs no room");
    replay.join_actor(ActorJoin::new(9_999, 1)).unwrap();
    check_comes_back(replay, folder.path());
}
