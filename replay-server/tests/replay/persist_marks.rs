//! Restores a replay to a mark in its log: the state is that of the mark, whatever the log recorded later.
//! `persist` tests recovery without a mark.

use std::path::Path;

use driml_protocol::Batch;
use driml_replay_server::{Config, Mark, PersistArgs, PersistError, Replay};

use crate::{
    calls::prioritised,
    persist::{ROWS, StoredReplay, copy, open, segments},
};

fn state(replay: &Replay) -> Vec<u8> {
    replay.state_bytes().unwrap()
}

/// Draws the next batches, which the log does not record. With priorities, also updates them.
fn next_draws(replay: &mut Replay) -> Vec<Batch> {
    let draw = |_| {
        let batch = replay.sample(ROWS).unwrap();
        let found: Vec<f32> = batch.states_t().iter().map(|&byte| byte.into()).collect();
        let found = &found[..ROWS as usize];
        let number = replay.counts().rows_sampled;
        if let Some(update) = batch.priority_update(77, number, found) {
            replay.set_priorities(&update).unwrap();
        }
        batch
    };
    (0..5).map(draw).collect()
}

/// Returns a replay that has stored more than its ring of 60 holds, with segments that are full after a few chunks.
fn begin(folder: &Path, config: Config, seed: u64) -> StoredReplay {
    let mut setup = StoredReplay::begin(folder, config, 600, seed);
    for _ in 0..30 {
        setup.act();
    }
    setup
}

fn store_some(setup: &mut StoredReplay) {
    for _ in 0..12 {
        setup.store(0);
        setup.store(1);
    }
}

fn open_at(args: &PersistArgs, config: &Config, mark: Mark) -> Result<Replay, PersistError> {
    let args = PersistArgs {
        mark: Some(mark),
        ..args.clone()
    };
    let (replay, recovery) = open(&args, config)?;
    assert!(recovery.found);
    assert_eq!(recovery.warnings, Vec::<String>::new());
    Ok(replay)
}

#[test]
fn a_log_goes_back_to_its_last_two_marks() {
    for (seed, is_prioritised) in (0..8).flat_map(|seed| [(seed, false), (seed, true)]) {
        let folder = tempfile::tempdir().unwrap();
        let config = match is_prioritised {
            true => prioritised(60, 0.5),
            false => Config::unlimited(60),
        };
        let mut setup = begin(folder.path(), config, seed);
        setup.replay.mark().unwrap().unwrap();
        let mut marks = Vec::new();
        for _ in 0..2 {
            store_some(&mut setup);
            next_draws(&mut setup.replay);
            setup.store(1);
            let mark = setup.replay.mark().unwrap().unwrap();
            let before = state(&setup.replay);
            marks.push((mark, before, next_draws(&mut setup.replay)));
        }
        for _ in 0..12 {
            setup.store(1);
            next_draws(&mut setup.replay);
        }
        let (args, config) = setup.end();
        for (mark, before, draws) in &marks {
            let copied = tempfile::tempdir().unwrap();
            copy(folder.path(), copied.path());
            let args = PersistArgs {
                dir: copied.path().to_owned(),
                ..args.clone()
            };
            for _ in 0..2 {
                let mut replay = open_at(&args, &config, *mark).unwrap();
                replay.check_valid();
                assert!(state(&replay) == *before, "seed {seed}");
                assert!(next_draws(&mut replay) == *draws, "seed {seed}");
            }
        }
        // Rolling back to the older mark removes the newer one.
        open_at(&args, &config, marks[0].0).unwrap();
        let gone = open_at(&args, &config, marks[1].0).map(drop).unwrap_err();
        assert!(matches!(gone, PersistError::NoMark(_)), "{gone}");
    }
}

/// Several checkpoints in a row cannot be saved: the newest saved checkpoint keeps its mark.
#[test]
fn marks_that_are_given_up_leave_the_one_before_them() {
    let folder = tempfile::tempdir().unwrap();
    let mut setup = begin(folder.path(), Config::unlimited(60), 1);
    let kept = setup.replay.mark().unwrap().unwrap();
    let before = state(&setup.replay);
    for _ in 0..4 {
        store_some(&mut setup);
        let mark = setup.replay.mark().unwrap().unwrap();
        setup.replay.discard_mark(mark);
    }
    let (args, config) = setup.end();
    let replay = open_at(&args, &config, kept).unwrap();
    assert!(state(&replay) == before);
}

#[test]
fn a_log_with_marks_holds_no_more_than_these_need() {
    let folder = tempfile::tempdir().unwrap();
    let mut setup = begin(folder.path(), Config::unlimited(60), 1);
    let mut most = 0;
    for round in 0..40 {
        store_some(&mut setup);
        setup.replay.mark().unwrap();
        if round == 9 {
            most = segments(folder.path()).len();
        }
    }
    let now = segments(folder.path()).len();
    assert!(now <= 2 * most, "{now} segments after {most}");
}
