//! Going back to a mark in the log of a replay: all is as it was there, whatever came after it.
//! What comes back without a mark is tested in `persist`.

use driml_replay_server::{Config, Mark, PersistArgs, PersistError, Replay};

use crate::{
    history::unlimited,
    persist::{Life, ROWS, copy, open, segments, test_spec},
    priorities::prioritised,
};

fn state(replay: &Replay) -> Vec<u8> {
    replay.state_bytes().unwrap()
}

/// What is drawn next, of which the log learns nothing.
fn next_draws(replay: &mut Replay) -> Vec<driml_protocol::Batch> {
    (0..5).map(|_| replay.sample(ROWS).unwrap()).collect()
}

fn at(args: &PersistArgs, config: &Config, mark: Mark) -> Result<Replay, PersistError> {
    let args = PersistArgs {
        mark: Some(mark),
        ..args.clone()
    };
    let (replay, recovery) = open(&args, config)?;
    assert!(recovery.found);
    assert_eq!(recovery.warnings, Vec::<String>::new());
    Ok(replay)
}

/// A ring that is smaller than what is stored, segments that are full after a few chunks, draws that no record holds.
#[test]
fn a_log_goes_back_to_its_last_two_marks() {
    for seed in 0..8 {
        let folder = tempfile::tempdir().unwrap();
        let config = unlimited(60);
        let mut life = Life::begin(folder.path(), config.clone(), 600, seed);
        for _ in 0..30 {
            life.act();
        }
        life.replay.mark().unwrap().unwrap();
        let mut marks = Vec::new();
        for _ in 0..2 {
            for _ in 0..12 {
                life.store(0);
                life.store(1);
            }
            next_draws(&mut life.replay);
            let mark = life.replay.mark().unwrap().unwrap();
            let before = state(&life.replay);
            marks.push((mark, before, next_draws(&mut life.replay)));
        }
        for _ in 0..12 {
            life.store(1);
            next_draws(&mut life.replay);
        }
        let (args, config) = life.end();
        for (mark, before, draws) in &marks {
            let copied = tempfile::tempdir().unwrap();
            copy(folder.path(), copied.path());
            let args = PersistArgs {
                dir: copied.path().to_owned(),
                ..args.clone()
            };
            for _ in 0..2 {
                let mut replay = at(&args, &config, *mark).unwrap();
                assert!(state(&replay) == *before, "seed {seed}");
                assert!(next_draws(&mut replay) == *draws, "seed {seed}");
            }
        }
        // Who goes back to the older one gives the newer one up.
        at(&args, &config, marks[0].0).unwrap();
        let gone = at(&args, &config, marks[1].0).map(drop).unwrap_err();
        assert!(matches!(gone, PersistError::NoMark(_)), "{gone}");
    }
}

/// Checkpoints that cannot be saved, one after the other, leave the newest that could its mark.
#[test]
fn marks_that_are_given_up_leave_the_one_before_them() {
    let folder = tempfile::tempdir().unwrap();
    let config = unlimited(60);
    let mut life = Life::begin(folder.path(), config, 600, 1);
    for _ in 0..30 {
        life.act();
    }
    let kept = life.replay.mark().unwrap().unwrap();
    let before = state(&life.replay);
    for _ in 0..4 {
        for _ in 0..12 {
            life.store(0);
            life.store(1);
        }
        let mark = life.replay.mark().unwrap().unwrap();
        life.replay.give_up_mark(mark);
    }
    let (args, config) = life.end();
    let replay = at(&args, &config, kept).unwrap();
    assert!(state(&replay) == before);
}

#[test]
fn a_log_with_marks_holds_no_more_than_these_need() {
    let folder = tempfile::tempdir().unwrap();
    let config = unlimited(60);
    let mut life = Life::begin(folder.path(), config, 600, 1);
    let mut most = 0;
    for round in 0..40 {
        for _ in 0..10 {
            life.store(0);
        }
        life.replay.mark().unwrap();
        if round == 9 {
            most = segments(folder.path()).len();
        }
    }
    let now = segments(folder.path()).len();
    assert!(now <= 2 * most, "{now} segments after {most}");
}

#[test]
fn a_replay_in_memory_has_no_marks() {
    let mut replay = Replay::new(&test_spec(), &unlimited(60), ROWS).unwrap();
    assert_eq!(replay.mark().unwrap(), None);
}

/// What is drawn next by priority, and learned from.
fn next_learned(replay: &mut Replay) -> Vec<driml_protocol::Batch> {
    let learned = |_| {
        let batch = replay.sample(ROWS).unwrap();
        let found: Vec<f32> = batch.states_t().iter().map(|&byte| byte.into()).collect();
        let update =
            batch.priority_update(77, replay.tally().rows_sampled, &found[..ROWS as usize]);
        replay.set_priorities(&update.unwrap()).unwrap();
        batch
    };
    (0..5).map(learned).collect()
}

#[test]
fn priorities_come_back_with_a_mark() {
    for seed in 0..8 {
        let folder = tempfile::tempdir().unwrap();
        let config = prioritised(60, 0.5);
        let mut life = Life::begin(folder.path(), config, 600, seed);
        for _ in 0..30 {
            life.act();
        }
        for _ in 0..12 {
            life.store(0);
            next_learned(&mut life.replay);
            life.store(1);
        }
        let mark = life.replay.mark().unwrap().unwrap();
        let draws = next_learned(&mut life.replay);
        let (args, config) = life.end();
        let mut replay = at(&args, &config, mark).unwrap();
        replay.check_valid();
        assert!(next_learned(&mut replay) == draws, "seed {seed}");
    }
}
