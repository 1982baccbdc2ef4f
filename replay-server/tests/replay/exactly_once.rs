//! Every transition is stored once and every batch counted once, over a network that delays, repeats and drops messages and
//! their answers.
//! It does not look at rows.

use driml_protocol::{
    ActorJoin, Buffer, ChunkHeader, ChunkPoll, Horizon, InsertReply, LearnerJoin, Leave, RequestId,
};
use driml_replay_server::{Config, NotReady, Replay};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::{
        affinity, header, insert, is_refused, join, learned, learner, limited, small_replay, stored,
    },
    history::spec,
};

proptest! {
    #[test]
    fn delays_repeats_and_drops_change_nothing(seed in any::<u64>(), actors in 1u32..4, chunks in 1u64..30) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // The limiter blocks now and then; the learner below frees it.
        let mut replay = small_replay(&Config {
            replay_ratio: 1.0,
            slack_transitions: 16,
            ..Config::unlimited(10_000)
        });
        let mut next = vec![0u64; actors as usize];
        let mut in_flight: Vec<ChunkHeader> = vec![];
        let steps = |actor: u32, sequence: u64| 1 + (u64::from(actor) * 7 + sequence * 3) % 5;
        let first = |actor: u32, sequence: u64| (0..sequence).map(|s| 2 * steps(actor, s)).sum::<u64>();
        while next.iter().any(|&sequence| sequence < chunks) {
            let actor = rng.random_range(0..actors);
            // Sends the chunk that the actor thinks is due, or one of the next two.
            let sequence = (next[actor as usize] + rng.random_range(0..3)).min(chunks - 1);
            let header = header(actor, 9, sequence, first(actor, sequence));
            in_flight.push(ChunkHeader { steps: steps(actor, sequence) as u32, ..header });
            // Any message in flight arrives; it may stay in flight and arrive again.
            let at = rng.random_range(0..in_flight.len());
            let arrived = if rng.random_bool(0.7) { in_flight.swap_remove(at) } else { in_flight[at] };
            let reply = insert(&mut replay, arrived);
            let lost_answer = rng.random_bool(0.3);
            match reply {
                InsertReply::Stored { .. } if !lost_answer => {
                    let next = &mut next[arrived.actor as usize];
                    *next = (*next).max(arrived.sequence + 1);
                }
                InsertReply::OutOfOrder { expected } => {
                    prop_assert!(expected < arrived.sequence);
                    if !lost_answer {
                        next[arrived.actor as usize] = expected;
                    }
                }
                InsertReply::Stored { .. } | InsertReply::Wait { .. } => {}
                InsertReply::Finished { .. } | InsertReply::Refused { .. } => panic!("{reply:?}"),
            }
            let _ = replay.sample(8);
            in_flight.truncate(20);
        }
        let produced: Vec<u64> = (0..actors).map(|actor| first(actor, chunks)).collect();
        for (actor, &produced) in produced.iter().enumerate() {
            replay.leave(&Leave::new(actor as u32, 9, produced));
        }
        let status = replay.status();
        prop_assert_eq!(status.transitions_inserted, produced.iter().sum::<u64>());
        prop_assert_eq!((status.transitions_lost, status.transitions_duplicated), (0, 0));
        prop_assert_eq!(status.messages_refused, 0);
    }

    #[test]
    fn batches_that_do_not_arrive_do_not_count(seed in any::<u64>(), clients in 1u64..4, batches in 1u64..30) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut config = Config::unlimited(10_000);
        (config.replay_ratio, config.slack_transitions) = (1.0, 10_000);
        config.transitions_max = Some(8 * batches);
        let spec = spec(3, 1, 1, Horizon::Uniform { k_max: 3 });
        let mut replay = Replay::new(&spec, &config, 8).unwrap();
        for sequence in 0.. {
            let header = ChunkHeader { steps: 4, ..header(0, 9, sequence, 8 * sequence) };
            if insert(&mut replay, header) != stored(8 * (sequence + 1)) {
                break;
            }
        }
        let mut requests: Vec<_> = (0..clients).map(RequestId::first).collect();
        let mut ks = vec![0; 4];
        let (mut arrived, mut lost) = (0, 0);
        // The requests sent, including overtaken ones. They arrive in random order.
        let mut in_flight: Vec<RequestId> = vec![];
        for _ in 0..20_000 {
            if arrived == batches {
                break;
            }
            let client_id = rng.random_range(0..clients) as usize;
            requests[client_id] = requests[client_id].retry();
            in_flight.push(requests[client_id]);
            let at = rng.random_range(0..in_flight.len());
            let id = in_flight.remove(at);
            in_flight.truncate(20);
            let draft = replay.draw_for(id, 8, Buffer::zeroed);
            replay.check_valid();
            let is_awaited = requests[id.client_id as usize] == id;
            match draft {
                Ok(draft) if is_awaited && rng.random_bool(0.7) => {
                    arrived += 1;
                    draft.unpack().ks().iter().for_each(|&k| ks[usize::from(k)] += 1);
                    requests[id.client_id as usize] = id.next();
                }
                Ok(_) => lost += 1,
                Err(NotReady::Finished | NotReady::Wait(_)) => {}
                Err(refused) => panic!("{refused:?}"),
            }
        }
        let status = replay.status();
        prop_assert_eq!((arrived, status.rows_sampled), (batches, 8 * batches));
        prop_assert_eq!((status.batches_retried, status.k_histogram), (lost, ks));
    }
}

/// A message of an actor: actor, incarnation, and more.
enum Said {
    Joins(u32, u64),
    Leaves(u32, u64, u64),
    /// The next chunk: its sequence number, and the count of earlier transitions that it claims.
    Sends(u32, u64, u64, u64),
}
use Said::{Joins, Leaves, Sends};
/// Messages, each with the counters (lost, duplicated, refused) after it, and a description.
type Story = [(Said, (u64, u64, u64), &'static str)];

/// Counts once all transitions that were produced and never stored, or the reverse.
#[test]
fn what_was_lost_or_stored_twice_is_counted_once() {
    let absurd = u64::MAX;
    let most = 1 << 48;
    let many = 1 << 40;
    let lost: &Story = &[
        (Sends(0, 1, 0, 4), (4, 0, 0), "before the first chunk"),
        (Sends(0, 1, 1, 10), (4, 0, 0), "nothing"),
        (Sends(0, 1, 2, 17), (5, 0, 0), "between chunks"),
        (Leaves(0, 1, 30), (12, 0, 0), "after the last chunk"),
        (Leaves(0, 1, 30), (12, 0, 0), "received twice"),
        (Leaves(1, 1, 3), (12, 0, 1), "one that has not joined"),
        (Joins(1, 1), (12, 0, 1), "nothing was said"),
        (Leaves(1, 1, 3), (15, 0, 1), "of which nothing came"),
        (Sends(2, 1, many, many), (15, 0, 1), "a chunk far ahead"),
        (Sends(2, 1, 0, many), (15 + many, 0, 1), "more than 2^32"),
    ];
    let duplicated: &Story = &[
        (Sends(0, 1, 0, 0), (0, 0, 0), "the first chunk"),
        (Sends(0, 1, 1, 4), (0, 2, 0), "chunks that overlap"),
        (Leaves(0, 1, 9), (0, 3, 0), "fewer than were stored"),
        (Joins(1, 0), (0, 3, 0), "nothing was said"),
        (Leaves(1, 0, absurd), (0, 3, 1), "an absurd count"),
        (Leaves(1, 0, most), (most, 3, 1), "the largest there can be"),
        (Joins(2, 0), (most, 3, 1), "nothing was said"),
        (Leaves(2, 0, most), (2 * most, 3, 1), "no overflow"),
    ];
    let replaced: &Story = &[
        (Sends(0, 1, 0, 0), (0, 0, 0), "a life's first chunk"),
        (Joins(0, 2), (0, 0, 0), "its next life"),
        (Sends(0, 1, 1, 6), (0, 0, 1), "a chunk of the past life"),
        (Leaves(0, 1, 18), (12, 0, 1), "what that could not deliver"),
        (Leaves(0, 1, 18), (12, 0, 1), "received twice"),
        (Sends(0, 2, 0, 0), (12, 0, 1), "the next life"),
    ];
    for story in [lost, duplicated, replaced] {
        let mut replay = small_replay(&Config::unlimited(1000));
        for (message, expected, what) in story {
            match *message {
                Joins(actor, incarnation) => join(&mut replay, actor, incarnation),
                Leaves(actor, incarnation, produced) => {
                    replay.leave(&Leave::new(actor, incarnation, produced));
                }
                Sends(actor, incarnation, sequence, first) => {
                    insert(&mut replay, header(actor, incarnation, sequence, first));
                }
            }
            let status = replay.status();
            let counted = (
                status.transitions_lost,
                status.transitions_duplicated,
                status.messages_refused,
            );
            assert_eq!(counted, *expected, "{what}");
        }
    }
}

#[test]
fn after_leave_or_a_new_start_only_retries_are_answered_stored() {
    let mut replay = small_replay(&Config::unlimited(1000));
    insert(&mut replay, header(0, 1, 0, 0));
    replay.leave(&Leave::new(0, 1, 6));
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    assert!(is_refused(&insert(&mut replay, header(0, 1, 1, 6))));
    let unknown = insert(&mut replay, header(0, 2, 0, 0));
    assert!(is_refused(&unknown), "a life that has not joined");
    // Nor does a `Leave` make the incarnation join.
    replay.leave(&Leave::new(0, 2, 6));
    join(&mut replay, 0, 2);
    let early = insert(&mut replay, header(0, 2, 1, 6));
    assert_eq!(early, InsertReply::OutOfOrder { expected: 0 });
    assert_eq!(insert(&mut replay, header(0, 2, 0, 0)), stored(12));
    let past = insert(&mut replay, header(0, 1, 0, 0));
    assert!(is_refused(&past), "a past life");
    let again = replay.join_actor(ActorJoin::new(0, 2));
    assert_eq!(again, Ok(1), "one life before it");
    let back = replay.join_actor(ActorJoin::new(0, 1));
    assert!(back.is_err(), "and it does not come back");
    let status = replay.status();
    assert_eq!((status.chunks_retried, status.transitions_lost), (1, 0));
    assert_eq!(status.messages_refused, 4, "three chunks and a `Leave`");
}

#[test]
fn a_poll_says_what_became_of_a_chunk() {
    let mut replay = small_replay(&Config {
        transitions_max: Some(12),
        ..Config::unlimited(1000)
    });
    let poll = |incarnation, sequence| ChunkPoll::new(0, incarnation, sequence);
    let unknown = replay.answer_poll(&poll(1, 0)).unwrap();
    assert!(is_refused(&unknown), "{unknown:?}");
    insert(&mut replay, header(0, 1, 0, 0));
    assert_eq!(replay.answer_poll(&poll(1, 0)), Some(stored(6)));
    assert_eq!(replay.answer_poll(&poll(1, 1)), None, "it is still to come");
    insert(&mut replay, header(0, 1, 1, 6));
    let finished = InsertReply::Finished { inserted_total: 12 };
    assert_eq!(replay.answer_poll(&poll(1, 2)), Some(finished));
    assert_eq!(replay.answer_poll(&poll(1, 1)), Some(stored(12)));
    assert_eq!(replay.status().chunks_retried, 0, "nothing was sent twice");
}

/// Returns a replay of ratio 4 after three chunks.
fn with_three_chunks(transitions_max: Option<u64>) -> Replay {
    let mut replay = small_replay(&Config {
        transitions_max,
        ..limited(100)
    });
    for sequence in 0..3 {
        insert(&mut replay, header(0, 1, sequence, 6 * sequence));
    }
    replay
}

/// A learner learned from fewer rows than it was served, and died: the other rows are served again to its successor.
#[test]
fn rows_that_were_not_learned_from_do_not_count() {
    let mut replay = with_three_chunks(Some(18));
    replay.join_learner(learner(1, 0, 0, 0)).unwrap();
    for _ in 0..9 {
        replay.sample(8).unwrap();
    }
    assert_eq!(replay.sample(8), Err(NotReady::Finished));
    let affinity = |version, p| affinity(version, vec![p; 25]);
    replay.set_affinity(&affinity(9, 0.5)).unwrap();
    replay.set_progress(learned(8, 5, 72)).unwrap();

    assert_eq!(replay.join_learner(learner(2, 5, 40, 18)), Ok(3));
    replay.check_valid();
    let status = replay.status();
    assert_eq!((status.rows_sampled, status.rows_unlearned), (40, 32));
    assert_eq!((status.updates, status.updates_relearned), (5, 3));
    replay.set_affinity(&affinity(6, 0.25)).unwrap();
    // The successor's matrix is used; a matrix that is older than that is ignored.
    assert_eq!(replay.status().affinity_version, 6);
    replay.set_affinity(&affinity(5, 0.5)).unwrap();
    assert_eq!(replay.status().affinity_version, 6);
    for _ in 0..4 {
        replay.sample(8).unwrap();
    }
    assert_eq!(replay.sample(8), Err(NotReady::Finished));
    replay.check_valid();
}

/// Which learners may replace one that has done 8 updates, and how many of these updates they repeat.
#[test]
fn a_learner_needs_a_checkpoint_of_the_run_or_the_word_to_restart() {
    let rejected = "the run has learned 8 updates, and the learner has no checkpoint of it: start the learner with the --run-dir \
                    that holds its checkpoints, or with --restart to begin again from the first update";
    let other_run = |updates, rows| LearnerJoin {
        run: 2,
        ..learner(2, updates, rows, 18)
    };
    let restarted = LearnerJoin {
        restart: true,
        ..other_run(0, 0)
    };
    let cases = [
        ("of this run", learner(2, 5, 40, 18), Ok(3)),
        ("that has learned more", learner(2, 9, 72, 18), Ok(0)),
        ("without a checkpoint", other_run(0, 0), Err(rejected)),
        ("of another run", other_run(5, 40), Err(rejected)),
        ("that begins again", restarted, Ok(8)),
        ("that asks again", learner(1, 0, 0, 0), Ok(0)),
    ];
    for (which, join, expected) in cases {
        let mut replay = with_three_chunks(None);
        // A run without any update accepts any learner that has none either.
        replay.join_learner(learner(0, 0, 0, 0)).unwrap();
        let begun = "another learner has begun this run anew, and this learner has a checkpoint after 5 updates";
        let further = replay.join_learner(other_run(5, 40)).unwrap_err();
        assert!(further.starts_with(begun), "{further}");
        replay.join_learner(learner(1, 0, 0, 0)).unwrap();
        for _ in 0..8 {
            replay.sample(8).unwrap();
        }
        replay.set_progress(learned(8, 5, 64)).unwrap();
        let joined = replay.join_learner(join);
        assert_eq!(joined, expected.map_err(String::from), "a learner {which}");
        let rows = match (joined.is_ok(), join.learner) {
            (true, 2) => join.counts.rows_sampled,
            _ => 64,
        };
        assert_eq!(replay.counts().rows_sampled, rows, "a learner {which}");
        replay.check_valid();
    }
}
