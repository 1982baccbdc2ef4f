//! The rate limiter: neither side waits for ever, and the ratio comes out exactly.

use driml_protocol::Waiting;
use driml_replay_server::RateLimiter;
use proptest::prelude::*;

#[test]
fn a_run_from_first_to_last() {
    let rows = 256;
    let mut limiter = RateLimiter::new(8.0, 1000, 64, Some(1100));
    let (have, need) = (0, 1000);
    assert_eq!(limiter.waiting(rows), Waiting::WarmUp { have, need });
    limiter.inserted(1000);
    assert!(limiter.may_insert() && !limiter.may_sample(rows));
    assert_eq!(limiter.waiting(rows), Waiting::LearnerWaitsForActors);
    limiter.inserted(31);
    assert!(!limiter.may_sample(rows), "31 * 8 < 256");
    limiter.inserted(1);
    assert!(limiter.may_sample(rows), "32 * 8 = 256");
    assert_eq!(limiter.waiting(rows), Waiting::Nobody);
    limiter.inserted(32);
    assert!(limiter.may_insert(), "64 ahead, of a slack of 64");
    limiter.inserted(1);
    assert!(!limiter.may_insert());
    assert_eq!(limiter.waiting(rows), Waiting::ActorsWaitForLearner);
    limiter.sampled(rows);
    assert!(limiter.may_insert());
    limiter.inserted(35);
    assert!(limiter.all_in() && !limiter.may_insert() && !limiter.finished(rows));
    assert_eq!(
        limiter.waiting(rows),
        Waiting::Nobody,
        "the learner still has rows to take"
    );
    limiter.sampled(rows);
    limiter.sampled(rows);
    assert!(
        limiter.finished(rows),
        "800 rows are allowed, 768 are sampled"
    );
    assert_eq!(limiter.waiting(rows), Waiting::Finished);
}

proptest! {
    #[test]
    fn neither_side_waits_for_ever_and_the_ratio_is_kept(
        ratio in 0.02f64..70.0,
        rows in 1u32..600,
        warmup in 0u64..3000,
        extra in 0u64..200,
        length in 0u64..5000,
        moves in prop::collection::vec((any::<bool>(), 1u64..300), 1..400),
    ) {
        let batch = (f64::from(rows) / ratio).ceil() as u64 + 1;
        let slack = 4 * batch + extra;
        let max = warmup + batch + length;
        let mut limiter = RateLimiter::new(ratio, warmup, slack, Some(max));
        let (mut inserted, mut sampled) = (0u64, 0u64);
        // Rows that the ratio has allowed, counted one transition at a time.
        let mut allowed = 0.0;
        let mut moves = moves.into_iter();
        // The moves first, then whatever is possible to the end.
        loop {
            let next = moves.next();
            let (insert, chunk) = next.unwrap_or((limiter.may_insert(), 50));
            if insert && limiter.may_insert() {
                limiter.inserted(chunk);
                allowed += ratio * ((inserted + chunk).max(warmup) - inserted.max(warmup)) as f64;
                inserted += chunk;
            } else if limiter.may_sample(rows) {
                limiter.sampled(rows);
                sampled += u64::from(rows);
            }
            let (may_insert, may_sample) = (limiter.may_insert(), limiter.may_sample(rows));
            prop_assert_eq!(limiter.finished(rows), inserted >= max && !may_sample);
            prop_assert!(may_insert || may_sample || limiter.finished(rows), "both sides wait");
            prop_assert!(sampled as f64 <= allowed + 1e-6, "{} rows of {}", sampled, allowed);
            prop_assert!(sampled == 0 || inserted >= warmup);
            let ahead = allowed - sampled as f64 - ratio * slack as f64;
            prop_assert!(ahead <= ratio * 300.0 + 1e-6, "a chunk at most beyond the slack");
            match limiter.waiting(rows) {
                Waiting::Nobody => prop_assert!(may_sample && (may_insert || inserted >= max)),
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
        prop_assert_eq!(limiter.tally().rows_sampled, sampled);
    }
}
