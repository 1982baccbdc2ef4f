//! What a replay refuses or lets wait, and where a run ends.
//! It does not look at rows, and no message is lost or repeated.

use driml_protocol::{Chunk, ChunkHeader, End, InsertReply, RunSpec, Tally, Waiting};
use driml_replay_server::{ACTORS_MAX, Replay, STREAMS_MAX, Unready};

use crate::{
    calls::{
        affinity, header, insert, is_refused, is_stored, join, last_word, life, small_spec, stored,
        wait,
    },
    history::unlimited,
};

#[test]
fn rewards_whose_sum_is_no_float_are_refused() {
    let spec = RunSpec {
        n_step: 7,
        ..small_spec()
    };
    let mut replay = Replay::new(&spec, &unlimited(1000), 8).unwrap();
    join(&mut replay, 0, 1);
    let with = |reward| {
        let mut chunk = Chunk::zeroed(header(0, 1, 0, 0));
        chunk.set(4, 0, reward, End::Running);
        chunk
    };
    for reward in [3e38, -3e38, f32::MAX] {
        match replay.insert(&with(reward)) {
            InsertReply::Refused { why } => {
                assert!(why.contains("scale the world's rewards"), "{why}")
            }
            reply => panic!("{reply:?} for {reward}"),
        }
    }
    assert_eq!(replay.insert(&with(f32::MAX / 7.0)), stored(6));
}

#[test]
fn unfit_chunks_are_refused_with_a_reason() {
    let mut replay = Replay::new(&small_spec(), &unlimited(100), 8).unwrap();
    insert(&mut replay, header(0, 1, 0, 0));
    let good = header(0, 1, 1, 6);
    let unfit = [
        (
            "frames of 7 bytes",
            ChunkHeader {
                frame_bytes: 7,
                ..good
            },
        ),
        ("3 streams after 2", ChunkHeader { streams: 3, ..good }),
        ("102 transitions", ChunkHeader { steps: 51, ..good }),
        ("0 transitions", ChunkHeader { steps: 0, ..good }),
        (
            "counts that no run reaches",
            ChunkHeader {
                first_transition: u64::MAX,
                ..good
            },
        ),
        (
            "counts that no run reaches",
            ChunkHeader {
                sequence: u64::MAX,
                ..good
            },
        ),
    ];
    for (reason, header) in unfit {
        match insert(&mut replay, header) {
            InsertReply::Refused { why } => assert!(why.contains(reason), "{why}"),
            reply => panic!("{reply:?} for {header:?}"),
        }
    }
    let mut chunk = Chunk::zeroed(good);
    chunk.set(2, 5, 0.0, End::Running);
    assert!(is_refused(&replay.insert(&chunk)), "action 5 of 0..5");
    assert_eq!(replay.status().messages_refused, unfit.len() as u64 + 1);
    assert_eq!(insert(&mut replay, good), stored(12), "the actor goes on");
}

#[test]
fn actors_and_streams_are_bounded() {
    let mut replay = Replay::new(&small_spec(), &unlimited(1 << 15), 8).unwrap();
    for actor in 0..ACTORS_MAX as u32 {
        join(&mut replay, actor, 1);
        let reply = replay.insert(&Chunk::zeroed(header(actor, 1, 0, 0)));
        assert!(is_stored(&reply), "{reply:?}");
    }
    let one_more = ACTORS_MAX as u32;
    assert!(replay.join_actor(life(one_more, 1)).is_err());
    let reply = replay.insert(&Chunk::zeroed(header(one_more, 1, 0, 0)));
    assert!(is_refused(&reply), "{reply:?}");
    replay.goodbye(&last_word(one_more, 1, 6));
    assert_eq!(replay.status().transitions_lost, 0);
    let last = insert(&mut replay, header(one_more - 1, 1, 1, 6));
    assert!(is_stored(&last), "the known ones go on");
    let wide = ChunkHeader {
        streams: STREAMS_MAX + 1,
        steps: 1,
        ..header(0, 1, 1, 6)
    };
    assert!(is_refused(&insert(&mut replay, wide)));
}

#[test]
fn the_run_ends_when_all_is_in_and_sampled() {
    let mut config = unlimited(1000);
    (config.replay_ratio, config.slack_transitions) = (4.0, 6);
    (config.warmup_transitions, config.transitions_max) = (6, Some(18));
    let mut replay = Replay::new(&small_spec(), &config, 8).unwrap();
    let warm_up = Waiting::WarmUp { have: 0, need: 6 };
    assert_eq!(replay.waiting(), warm_up);
    assert_eq!(replay.sample(8), Err(Unready::Wait(warm_up)));
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    let hungry = Err(Unready::Wait(Waiting::LearnerWaitsForActors));
    assert_eq!(replay.sample(8), hungry);
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), stored(12));
    // 6 ahead, of a slack of 6.
    assert_eq!(insert(&mut replay, header(1, 1, 0, 0)), stored(18));
    assert!(replay.status().finished);
    // A retry is still a retry.
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), stored(18));
    for sequence in [2, 7] {
        let reply = insert(&mut replay, header(0, 1, sequence, 12));
        assert_eq!(reply, InsertReply::Finished { inserted_total: 18 });
    }
    for _ in 0..6 {
        replay.sample(8).unwrap();
    }
    assert_eq!(replay.sample(8), Err(Unready::Finished));
    assert_eq!(replay.waiting(), Waiting::Finished);
    // 48 rows of 12 transitions after the warm-up.
    assert_eq!(replay.status().replay_ratio(), Some(4.0));
    replay.goodbye(&last_word(0, 1, 12));
    assert_eq!(replay.status().transitions_lost, 0);
}

#[test]
fn a_blocked_insert_waits_and_what_can_never_be_served_is_refused() {
    let mut config = unlimited(1000);
    (config.replay_ratio, config.slack_transitions) = (4.0, 2);
    let mut replay = Replay::new(&small_spec(), &config, 8).unwrap();
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), wait(6));
    let early = insert(&mut replay, header(0, 1, 2, 12));
    assert_eq!(early, InsertReply::OutOfOrder { expected: 1 });
    assert_eq!(replay.waiting(), Waiting::ActorsWaitForLearner);
    // None, and more than slack * ratio.
    for rows in [0, 9] {
        let drawn = replay.sample(rows);
        assert!(matches!(drawn, Err(Unready::Refused { .. })), "{drawn:?}");
    }
    let leaving = ChunkHeader {
        leaving: true,
        ..header(1, 1, 0, 0)
    };
    // An actor that leaves does not wait.
    assert_eq!(insert(&mut replay, leaving), stored(12));
    for _ in 0..5 {
        replay.sample(8).unwrap();
    }
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), stored(18));
    let foreign = affinity(1, 4, vec![0.25; 16]);
    assert!(replay.set_affinity(&foreign).is_err());
    assert_eq!(replay.status().messages_refused, 3);
}

#[test]
fn what_other_shards_are_said_to_have_counted_is_bounded() {
    let mut config = unlimited(1000);
    (config.shards, config.replay_ratio) = (2, 4.0);
    (config.slack_transitions, config.transitions_max) = (100, Some(5000));
    let mut replay = Replay::shard(&small_spec(), &config, 8, 0).unwrap();
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    let tally = |inserted, rows_sampled| Tally {
        inserted,
        rows_sampled,
    };
    // Rows: 4 for each of the 106 transitions that are stored, of a capacity of 1000 and of a slack of 100.
    for (lie, bound) in [
        (tally(6001, 0), "at most 6000"),
        (tally(u64::MAX, u64::MAX), "at most 6000"),
        (tally(100, 4825), "at most 4824"),
        (tally(100, u64::MAX), "at most 4824"),
    ] {
        let why = replay.set_other_shards(lie).unwrap_err();
        assert!(why.contains(bound), "{why}");
    }
    replay.set_other_shards(tally(100, 400)).unwrap();
    replay.sample(8).expect("of the lies nothing was counted");
    replay.set_other_shards(tally(100, 4824)).unwrap();
    assert_eq!(
        replay.sample(8),
        Err(Unready::Wait(Waiting::LearnerWaitsForActors))
    );
    replay.check_valid();
}

#[test]
fn a_version_of_the_affinity_that_no_run_reaches_is_refused() {
    let mut replay = Replay::new(&small_spec(), &unlimited(1000), 8).unwrap();
    insert(&mut replay, header(0, 1, 0, 0));
    replay.sample(8).unwrap();
    let affinity = |version| affinity(version, 5, vec![0.2; 25]);
    // 2^32 ahead of the rows.
    let most: u64 = 8 + (1 << 32);
    for version in [most + 1, u64::MAX] {
        let why = replay.set_affinity(&affinity(version)).unwrap_err();
        let why = why.to_string();
        assert!(
            why.contains("of the affinity, in a run that has served 8 rows"),
            "{why}"
        );
    }
    let status = replay.status();
    assert_eq!((status.messages_refused, status.affinity_version), (2, 0));
    replay.set_affinity(&affinity(most)).unwrap();
    assert_eq!(replay.status().affinity_version, most);
}
