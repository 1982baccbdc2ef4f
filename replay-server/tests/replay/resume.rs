//! A run that is resumed from its learner's checkpoint with an empty replay: its counts, and when it waits.
//! Resuming all processes together is an end-to-end test.

use driml_protocol::{LearnerJoin, ShardCounts};
use driml_replay_server::{Config, NotReady, RatioStart, Replay};

use crate::calls::{header, insert, is_stored, learner, limited, small_spec};

fn config() -> Config {
    Config {
        warmup_transitions: 60,
        transitions_max: Some(180),
        ..limited(12)
    }
}

/// Plays to the end of the run. Returns the number of chunks (of 6 transitions) stored, and of batches of `rows` rows served.
fn play(replay: &mut Replay, rows: u32) -> (u64, u64) {
    let (mut batches, mut sequence) = (0, 0);
    loop {
        match replay.sample(rows) {
            Ok(_) => batches += 1,
            Err(NotReady::Finished) => return (sequence, batches),
            Err(NotReady::Wait(_)) => {
                let reply = insert(replay, header(0, 1, sequence, 6 * sequence));
                assert!(is_stored(&reply), "{reply:?}");
                sequence += 1;
            }
            Err(e) => panic!("{e:?}"),
        }
    }
}

/// 60 transitions warm up; 120 allow 480 rows, which are 60 updates of 8. Cases: the checkpoint, and the chunks and batches that remain.
#[test]
fn a_resumed_run_counts_on_and_fills_its_replay_first() {
    let since = Some(RatioStart {
        transitions: 120,
        rows: 232,
        updates: 29,
    });
    let unchanged = config();
    let shorter = Config {
        transitions_max: Some(100),
        ..config()
    };
    let larger = Config { since, ..config() };
    let other_ratio = Config {
        replay_ratio: 2.0,
        ..larger.clone()
    };
    let refills = |refill_transitions, capacity_transitions| Config {
        refill_transitions,
        capacity_transitions,
        ..config()
    };
    let (fuller, full) = (refills(1 << 40, 1000), refills(1 << 40, 96));
    let of_updates = |updates: u64| Config {
        transitions_max: Some(2 * updates + 180),
        ..config()
    };
    let [long, longest] = [1 << 32, 1 << 48].map(of_updates);
    let at = |updates, inserted| learner(1, updates, 8 * updates, inserted);
    // Two transitions allow an update.
    let after = |updates| at(updates, 2 * updates + 60);
    let cases = [
        ("from the start", &unchanged, at(0, 0), 8, (30, 60), 0),
        ("same settings", &unchanged, at(29, 120), 8, (20, 31), 60),
        ("all it had", &fuller, at(29, 120), 8, (30, 31), 120),
        ("all that fits", &full, at(29, 120), 8, (26, 31), 96),
        ("all frames", &unchanged, at(55, 180), 8, (10, 5), 60),
        ("nothing left", &unchanged, at(60, 180), 8, (0, 0), 0),
        ("fewer frames", &shorter, at(30, 120), 8, (0, 0), 0),
        ("2^32 updates", &long, after(1 << 32), 8, (30, 60), 60),
        ("2^48 updates", &longest, after(1 << 48), 8, (30, 60), 60),
        // 60 transitions allow 120 rows.
        ("another ratio", &other_ratio, at(29, 120), 8, (20, 15), 60),
        // 240 rows.
        ("larger ones", &larger, at(29, 120), 16, (20, 15), 60),
    ];
    for (what, config, join, rows, expected, refilled) in cases {
        let mut replay = Replay::new(&small_spec(), config, rows).unwrap();
        assert_eq!(replay.join_learner(join), Ok(0), "{what}");
        assert_eq!(play(&mut replay, rows), expected, "{what}");
        let status = replay.status();
        let stored = 6 * expected.0;
        assert_eq!(status.transitions_refilled, refilled, "{what}");
        let inserted = join.counts.inserted + stored - refilled;
        assert_eq!(status.transitions_inserted, inserted, "{what}");
        let served = join.counts.rows_sampled + expected.1 * u64::from(rows);
        assert_eq!(status.rows_sampled, served, "{what}");
        let held = stored.min(config.capacity_transitions);
        assert_eq!(status.transitions_held, held, "{what}");
        assert_eq!(replay.resumed_after_updates(), join.updates, "{what}");
    }
}

/// Each shard refills its share, and continues the counts that the learner reports for it.
#[test]
fn shards_of_a_resumed_run_count_on_each_for_itself() {
    let config = Config {
        shards: 3,
        ..config()
    };
    for (shard, refill_transitions, refill) in [(0, 0, 20), (2, 0, 20), (2, 1 << 40, 40_u64)] {
        let config = Config {
            refill_transitions,
            ..config.clone()
        };
        let mut replay = Replay::shard(&small_spec(), &config, 8, shard).unwrap();
        let counted = 30 + u64::from(shard);
        let join = LearnerJoin {
            counts: ShardCounts::new(counted, 80),
            other_shards: ShardCounts::new(120 - counted, 152),
            ..learner(1, 29, 0, 0)
        };
        replay.join_learner(join).unwrap();
        assert_eq!(replay.inserted_total(), 120);
        let chunks = refill.div_ceil(6);
        for sequence in 0..chunks {
            let held = replay.status().transitions_held;
            assert_eq!(held, 0, "no row is drawn from a shard that fills again");
            insert(&mut replay, header(0, 1, sequence, 6 * sequence));
        }
        let status = replay.status();
        assert_eq!(status.transitions_refilled, refill);
        assert_eq!(status.transitions_held, 6 * chunks);
        assert_eq!(status.transitions_inserted, counted + 6 * chunks - refill);
    }
}

/// A learner that resumes sends each shard's count at its checkpoint, which replaces a higher count from before.
#[test]
fn what_another_shard_had_given_to_a_learner_that_died_is_forgotten() {
    let config = Config {
        shards: 2,
        slack_transitions: 1000,
        ..config()
    };
    let mut replay = Replay::shard(&small_spec(), &config, 8, 0).unwrap();
    replay.join_learner(learner(1, 0, 0, 0)).unwrap();
    for sequence in 0..15 {
        insert(&mut replay, header(0, 1, sequence, 6 * sequence));
    }
    // The other shard has served all rows of 90 + 90 transitions; the learner's checkpoint has 200 of them.
    replay.set_other_shards(ShardCounts::new(90, 480)).unwrap();
    assert_eq!(replay.sample(8), Err(NotReady::Finished));
    let join = LearnerJoin {
        other_shards: ShardCounts::new(80, 200),
        ..learner(2, 25, 0, 90)
    };
    replay.join_learner(join).unwrap();
    replay.set_other_shards(ShardCounts::new(90, 200)).unwrap();
    let mut batches = 0;
    while replay.sample(8).is_ok() {
        batches += 1;
    }
    assert_eq!((batches, replay.sample(8)), (35, Err(NotReady::Finished)));
}
