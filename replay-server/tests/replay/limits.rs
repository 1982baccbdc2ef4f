//! Messages that a replay rejects or delays, settings that cannot work, and the end of a run: neither side waits forever.
//! Rows are checked only for the smallest replay. No message is lost or repeated.

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, End, Horizon, InsertReply, Leave, RunSpec, ShardCounts, Waiting,
};
use driml_replay_server::{
    ACTORS_MAX, Config, NotReady, RateLimiter, RatioStart, Replay, STREAMS_MAX,
};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    batches::check_rows,
    calls::{
        Actor, affinity, header, insert, is_refused, is_stored, join, limited, small_replay,
        small_spec, stored, wait,
    },
    history::{History, spec},
};

const HUNGRY: Waiting = Waiting::LearnerWaitsForActors;

#[test]
fn unfit_chunks_are_refused_with_a_reason() {
    let spec = RunSpec {
        n_step: 7,
        ..small_spec()
    };
    let mut replay = Replay::new(&spec, &Config::unlimited(100), 8).unwrap();
    insert(&mut replay, header(0, 1, 0, 0));
    type Spoil = fn(&mut ChunkHeader);
    let headers: [(Spoil, &str); 6] = [
        (|it| it.frame_bytes = 7, "frames of 7 bytes"),
        (|it| it.streams = 3, "3 streams after 2"),
        (|it| it.steps = 51, "102 transitions"),
        (|it| it.steps = 0, "0 transitions"),
        (
            |it| it.first_transition = u64::MAX,
            "counts that no run reaches",
        ),
        (|it| it.sequence = u64::MAX, "counts that no run reaches"),
    ];
    let good = Chunk::zeroed(header(0, 1, 1, 6));
    let with = |action, reward| {
        let mut chunk = good.clone();
        chunk.set(2, action, reward, End::Running);
        chunk
    };
    let mut unfit = vec![(with(5, 0.0), "action 5; this run has 5")];
    // The sum of seven rewards must be a finite f32.
    for reward in [3e38, -3e38, f32::MAX, f32::NAN] {
        unfit.push((with(0, reward), "scale the world's rewards"));
    }
    for (spoil, reason) in headers {
        let mut header = good.header;
        spoil(&mut header);
        unfit.push((Chunk::zeroed(header), reason));
    }
    for (chunk, reason) in &unfit {
        match replay.insert(chunk) {
            InsertReply::Refused { why } => assert!(why.contains(reason), "{why}"),
            reply => panic!("{reply:?} instead of {reason}"),
        }
    }
    assert_eq!(replay.status().messages_refused, unfit.len() as u64);
    let largest = with(0, f32::MAX / 7.0);
    assert_eq!(replay.insert(&largest), stored(12), "the actor continues");
}

#[test]
fn actors_and_streams_are_bounded() {
    let mut replay = small_replay(&Config::unlimited(1 << 15));
    for actor in 0..ACTORS_MAX as u32 {
        join(&mut replay, actor, 1);
        let reply = replay.insert(&Chunk::zeroed(header(actor, 1, 0, 0)));
        assert!(is_stored(&reply), "{reply:?}");
    }
    let one_more = ACTORS_MAX as u32;
    assert!(replay.join_actor(ActorJoin::new(one_more, 1)).is_err());
    let reply = replay.insert(&Chunk::zeroed(header(one_more, 1, 0, 0)));
    assert!(is_refused(&reply), "{reply:?}");
    replay.leave(&Leave::new(one_more, 1, 6));
    assert_eq!(replay.status().transitions_lost, 0);
    let last = insert(&mut replay, header(one_more - 1, 1, 1, 6));
    assert!(is_stored(&last), "the known ones continue");
    for (streams, is_fine) in [(STREAMS_MAX + 1, false), (STREAMS_MAX, true)] {
        let mut replay = small_replay(&Config::unlimited(1 << 15));
        join(&mut replay, 0, 1);
        let wide = ChunkHeader {
            streams,
            steps: 1,
            ..header(0, 1, 0, 0)
        };
        assert_eq!(is_stored(&insert(&mut replay, wide)), is_fine, "{streams}");
    }
}

#[test]
fn the_run_ends_when_all_is_in_and_sampled() {
    let mut replay = small_replay(&Config {
        warmup_transitions: 6,
        transitions_max: Some(18),
        ..limited(6)
    });
    let warm_up = Waiting::WarmUp { have: 0, need: 6 };
    assert_eq!(replay.waiting(), warm_up);
    assert_eq!(replay.sample(8), Err(NotReady::Wait(warm_up)));
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    assert_eq!(replay.sample(8), Err(NotReady::Wait(HUNGRY)));
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), stored(12));
    // 6 transitions ahead, with a slack of 6.
    assert_eq!(insert(&mut replay, header(1, 1, 0, 0)), stored(18));
    assert!(replay.status().finished);
    // A retry is still answered `Stored`.
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), stored(18));
    for sequence in [2, 7] {
        let reply = insert(&mut replay, header(0, 1, sequence, 12));
        assert_eq!(reply, InsertReply::Finished { inserted_total: 18 });
    }
    for _ in 0..6 {
        replay.sample(8).unwrap();
    }
    assert_eq!(replay.sample(8), Err(NotReady::Finished));
    assert_eq!(replay.waiting(), Waiting::Finished);
    // 48 rows for 12 transitions after the warm-up.
    assert_eq!(replay.status().replay_ratio(), Some(4.0));
    replay.leave(&Leave::new(0, 1, 12));
    assert_eq!(replay.status().transitions_lost, 0);
}

#[test]
fn a_blocked_insert_waits_and_what_can_never_be_served_is_refused() {
    let mut replay = small_replay(&limited(2));
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), wait(6));
    let early = insert(&mut replay, header(0, 1, 2, 12));
    assert_eq!(early, InsertReply::OutOfOrder { expected: 1 });
    assert_eq!(replay.waiting(), Waiting::ActorsWaitForLearner);
    // No rows, and more than slack * ratio.
    for rows in [0, 9] {
        let drawn = replay.sample(rows);
        assert!(matches!(drawn, Err(NotReady::Refused { .. })), "{drawn:?}");
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
    let foreign = affinity(1, vec![0.25; 16]);
    assert!(replay.set_affinity(&foreign).is_err());
    assert_eq!(replay.status().messages_refused, 2);
}

#[test]
fn an_actor_that_leaves_and_does_not_stop_waits_like_the_others() {
    let mut replay = small_replay(&limited(2));
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    for incarnation in [1, 2] {
        join(&mut replay, 1, incarnation);
        let mut insert = |sequence: u64| {
            let leaving = ChunkHeader {
                leaving: true,
                ..header(1, incarnation, sequence, 6 * sequence)
            };
            insert(&mut replay, leaving)
        };
        let passed = (0..300).take_while(|&it| is_stored(&insert(it)));
        assert_eq!(passed.count(), 128, "incarnation {incarnation}");
        assert!(is_stored(&insert(127)), "a retry");
    }
    let total = 6 * (1 + 2 * 128);
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), wait(total));
}

/// No episode ends and no stream is long enough for an anchor. Both sides would wait for each other if the limiter held the actors back.
#[test]
fn without_any_anchor_actors_continue_and_the_end_has_a_reason() {
    let config = Config {
        replay_ratio: 64.0,
        slack_transitions: 1,
        transitions_max: Some(60),
        ..Config::unlimited(10_000)
    };
    let mut replay = Replay::new(&spec(3, 1, 4, Horizon::None {}), &config, 64).unwrap();
    let chunk = |sequence| ChunkHeader {
        streams: 20,
        steps: 1,
        ..header(0, 1, sequence, 20 * sequence)
    };
    for sequence in 0..3 {
        let total = 20 * (sequence + 1);
        assert_eq!(insert(&mut replay, chunk(sequence)), stored(total));
        let next = insert(&mut replay, chunk(sequence + 1));
        let drawn = replay.sample(64);
        if total < 60 {
            assert_eq!(next, wait(total));
            assert_eq!(drawn, Err(NotReady::Wait(HUNGRY)));
            assert_eq!(replay.waiting(), HUNGRY);
        } else {
            assert_eq!(next, InsertReply::Finished { inserted_total: 60 });
            assert!(matches!(drawn, Err(NotReady::Refused { .. })), "{drawn:?}");
        }
    }
}

#[test]
fn what_other_shards_are_said_to_have_counted_is_bounded() {
    let config = Config {
        shards: 2,
        transitions_max: Some(5000),
        ..limited(100)
    };
    let mut replay = small_replay(&config);
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    // The limit of rows: 4 for each of 106 transitions stored, a capacity of 1000 and a slack of 100.
    for (lie, bound) in [
        (ShardCounts::new(6001, 0), "at most 6000"),
        (ShardCounts::new(u64::MAX, u64::MAX), "at most 6000"),
        (ShardCounts::new(100, 4825), "at most 4824"),
        (ShardCounts::new(100, u64::MAX), "at most 4824"),
    ] {
        let why = replay.set_other_shards(lie).unwrap_err();
        assert!(why.contains(bound), "{why}");
    }
    replay.set_other_shards(ShardCounts::new(100, 400)).unwrap();
    replay.sample(8).expect("of the lies nothing was counted");
    let most = ShardCounts::new(100, 4824);
    replay.set_other_shards(most).unwrap();
    assert_eq!(replay.sample(8), Err(NotReady::Wait(HUNGRY)));
    replay.check_valid();
    // Without a learner, each of two others stored the whole run.
    let three = Config {
        shards: 3,
        ..config
    };
    let whole = ShardCounts::new(10_000, 0);
    small_replay(&three).set_other_shards(whole).unwrap();
}

proptest! {
    #[test]
    fn neither_side_waits_for_ever_and_the_ratio_is_kept(
        ratio in 0.02f64..70.0,
        rows in 1u32..600,
        warmup in 0u64..3000,
        extra in 0u64..200,
        length in 0u64..5000,
        // A resume with another warm-up, ratio or batch size: transitions and rows before it.
        resumed in prop::option::of((0u64..4000, 0u64..10_000)),
        moves in prop::collection::vec((any::<bool>(), 1u64..300), 1..400),
    ) {
        let batch = (f64::from(rows) / ratio).ceil() as u64 + 1;
        let slack = 4 * batch + extra;
        let (transitions, rows_before) = resumed.unwrap_or_default();
        let start = transitions.max(warmup);
        let max = start + batch + length;
        let mut limiter = RateLimiter::new(&Config {
            replay_ratio: ratio,
            warmup_transitions: warmup,
            slack_transitions: slack,
            transitions_max: Some(max),
            since: resumed.map(|_| RatioStart { transitions, rows: rows_before, updates: 0 }),
            ..Config::unlimited(1)
        })
        .with_counts(ShardCounts::new(transitions, rows_before), ShardCounts::default());
        let (mut inserted, mut sampled) = (transitions, rows_before);
        // The rows that the ratio allows, counted one transition at a time.
        let mut allowed = rows_before as f64;
        let mut moves = moves.into_iter();
        // First the given moves, then all moves that are possible, to the end.
        loop {
            let next = moves.next();
            let (insert, chunk) = next.unwrap_or((limiter.may_insert(), 50));
            if insert && limiter.may_insert() {
                limiter.count_inserted(chunk);
                allowed += ratio * ((inserted + chunk).max(start) - inserted.max(start)) as f64;
                inserted += chunk;
            } else if limiter.may_sample(rows) {
                limiter.count_sampled(rows);
                sampled += u64::from(rows);
            }
            let (may_insert, may_sample) = (limiter.may_insert(), limiter.may_sample(rows));
            prop_assert_eq!(limiter.is_finished(rows), inserted >= max && !may_sample);
            prop_assert!(may_insert || may_sample || limiter.is_finished(rows), "both sides wait");
            prop_assert!(sampled as f64 <= allowed + 1e-6, "{} rows of {}", sampled, allowed);
            prop_assert!(sampled == rows_before || inserted >= warmup);
            let ahead = allowed - sampled as f64 - ratio * slack as f64;
            prop_assert!(ahead <= ratio * 300.0 + 1e-6, "a chunk at most beyond the slack");
            match limiter.waiting(rows) {
                Waiting::Neither => prop_assert!(may_sample && (may_insert || inserted >= max)),
                Waiting::WarmUp { have, need } => prop_assert!(have < need && may_insert && !may_sample),
                Waiting::LearnerWaitsForActors => prop_assert!(may_insert && !may_sample),
                Waiting::ActorsWaitForLearner => prop_assert!(!may_insert && may_sample),
                Waiting::Finished => {
                    prop_assert!(!may_insert && !may_sample);
                    if next.is_none() {
                        break;
                    }
                }
            }
        }
        prop_assert!(allowed - (sampled as f64) < f64::from(rows) + 1e-6, "less than a batch is left");
        prop_assert_eq!(limiter.counts().rows_sampled, sampled);
    }

    #[test]
    fn the_longest_runs_are_allowed_what_integers_allow(
        inserted in (1u64 << 49..1 << 50, 0u32..30).prop_map(|(count, shift)| count >> shift),
        credit in -20_000i64..20_000,
        others in prop::option::of((any::<u64>(), any::<u64>())),
    ) {
        let rows_sampled = (8 * inserted).saturating_add_signed(-credit);
        let (inserted_there, sampled_there) = others.unwrap_or_default();
        let there = ShardCounts::new(inserted_there % inserted, sampled_there % rows_sampled);
        let here = ShardCounts::new(inserted - there.inserted, rows_sampled - there.rows_sampled);
        let config = Config { replay_ratio: 8.0, slack_transitions: 1000, ..Config::unlimited(1) };
        let limiter = RateLimiter::new(&config).with_counts(here, there);
        let near = credit.unsigned_abs() as u32;
        for rows in [1, 32, 256, near, near + 1] {
            prop_assert_eq!(limiter.may_sample(rows), i64::from(rows) <= credit);
        }
        prop_assert_eq!(limiter.may_insert(), credit <= 8000);
    }
}

fn config_error(config: &Config, spec: &RunSpec, batch_size: u32) -> String {
    let refused = Replay::new(spec, config, batch_size).map(drop);
    refused.unwrap_err().to_string()
}

/// The snapshot of refused settings has the answers to all other settings that cannot work.
#[test]
fn a_replay_that_no_memory_holds_is_refused_with_its_key() {
    let spec = spec(3, 4, 7, Horizon::Nhg { k_max: 5 });
    for (capacity, expected) in [
        (u64::MAX, "hold fewer"),
        (1 << 57, "hold fewer"),
        (1 << 50, "does not grant the"),
    ] {
        let text = config_error(&Config::unlimited(capacity), &spec, 256);
        assert!(text.starts_with("replay.capacity_transitions"), "{text}");
        assert!(text.contains(expected), "{text}");
    }
    let vast = RunSpec {
        frame_height: 4096,
        frame_width: 4096,
        frame_channels: 16,
        frame_stack: 16,
        ..spec
    };
    assert!(config_error(&Config::unlimited(10_000), &vast, 256).contains("4 GiB"));
}

#[test]
fn the_least_capacity_works_and_a_smaller_one_is_refused() {
    let rng = &mut ChaCha8Rng::seed_from_u64(5);
    for (n_step, stack) in [(1, 1), (1, 4), (2, 2), (7, 1), (8, 4), (1000, 4)] {
        let spec = spec(3, stack, n_step, Horizon::None {});
        let least = u64::from(n_step + stack);
        let error = config_error(&Config::unlimited(least - 1), &spec, 4);
        let named = format!("replay.capacity_transitions = {} ", least - 1);
        assert!(error.starts_with(&named), "{error}");
        for capacity in least..least + 8 {
            let what = format!("n_step {n_step}, stack {stack}, capacity {capacity}");
            let mut replay = Replay::new(&spec, &Config::unlimited(capacity), 4).unwrap();
            let mut history = History::new(&spec, capacity);
            history.ends = false;
            let mut actor = Actor::new(0, 1);
            join(&mut replay, 0, 1);
            while history.inserted < 3 * capacity {
                let steps = rng.random_range(1..=capacity.min(300));
                let chunk = history.next_chunk(actor.send(1, steps as u32), 0, rng);
                assert_eq!(replay.insert(&chunk), stored(history.inserted), "{what}");
                match replay.sample(4) {
                    Ok(batch) => drop(check_rows(&batch, &history)),
                    Err(why) => {
                        assert!(matches!(why, NotReady::Wait(_)), "{what}: {why:?}");
                        assert!(history.valid_anchors().is_empty(), "{what}");
                    }
                }
            }
        }
    }
}
