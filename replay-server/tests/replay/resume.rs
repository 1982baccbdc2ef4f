//! A run that goes on after updates of an earlier life: what it counts, and what it waits for.
//! That all parts go on together is an end-to-end test.

use driml_replay_server::{Config, Replay, Unready};

use crate::{
    calls::{header, insert, small_spec, stored},
    history::unlimited,
};

#[test]
fn a_resumed_run_counts_on_and_fills_its_replay_first() {
    let mut config = unlimited(1000);
    (config.replay_ratio, config.warmup_transitions) = (4.0, 60);
    (config.slack_transitions, config.transitions_max) = (12, Some(180));
    let spec = small_spec();
    // Updates of 8 rows, 2 transitions each: 60 + 2 * 30 = 120 of 180 transitions were in.
    let mut replay = Replay::new(&spec, &config, 8).unwrap().resumed_at(30, 0);
    let status = replay.status();
    assert_eq!(
        (status.transitions_inserted, status.rows_sampled),
        (60, 240)
    );
    let (mut batches, mut sequence) = (0, 0);
    loop {
        let inserted = replay.inserted_total();
        match replay.sample(8) {
            Ok(_) => {
                assert!(inserted > 120, "only what is new lets the learner go on");
                batches += 1;
                continue;
            }
            Err(Unready::Finished) => break,
            Err(e) => assert!(matches!(e, Unready::Wait(_)), "{e:?}"),
        }
        let reply = insert(&mut replay, header(0, 1, sequence, 6 * sequence));
        assert_eq!(reply, stored(inserted + 6));
        sequence += 1;
    }
    assert_eq!(
        sequence, 20,
        "60 transitions to fill the replay, 60 to go on"
    );
    assert_eq!(batches, 30, "with those before, all of (180 - 60) * 4 / 8");
    let status = replay.status();
    assert_eq!(
        (status.transitions_inserted, status.rows_sampled),
        (180, 480)
    );
    assert_eq!((status.transitions_lost, status.transitions_held), (0, 120));
}

#[test]
fn shards_share_what_a_resumed_run_has_behind_it() {
    let config = Config {
        shards: 3,
        replay_ratio: 4.0,
        ..unlimited(1000)
    };
    let spec = small_spec();
    let behind = |shard| {
        let replay = Replay::shard(&spec, &config, 8, shard).unwrap();
        let replay = replay.resumed_at(100, shard);
        assert_eq!(replay.inserted_total(), 200, "each knows of the others");
        let status = replay.status();
        (status.transitions_inserted, status.rows_sampled)
    };
    assert_eq!([0, 1, 2].map(behind), [(67, 267), (67, 267), (66, 266)]);
}
