//! The schedule of epsilon, and counters beyond 2^32.

use driml_actor::{Incarnation, Schedule};
use driml_learner::{AffinityEstimator, Alphabet, LearnedAffinity, LearnedSettings};
use driml_protocol::{Chunk, End, InsertReply, LearnerJoin, Tally, TimeoutRule};
use driml_replay_server::RateLimiter;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::replays::{chunk, replay, spec};
use crate::stability::check::{Context, Routine, Row};

const EPSILON: Routine = Routine {
    name: "epsilon",
    range: "any counts of frames; start and end 0 to 1",
};
const COUNTERS: Routine = Routine {
    name: "counters",
    range: "up to 2^53 rows and transitions; others up to 2^64",
};

/// The share of two counts, right to the last place: 64 bits of the quotient, as an integer.
fn share(part: u64, whole: u64) -> f64 {
    if part >= whole {
        return 1.0;
    }
    let quotient = (u128::from(part) << 64) / u128::from(whole);
    quotient as f64 / 2f64.powi(64)
}

fn see_schedule(row: &mut Row, start: f64, end: f64, decay_frames: u64, frames: &[u64]) {
    let schedule = Schedule::Falling {
        start,
        end,
        decay_frames,
    };
    let mut before = start;
    for &frames in frames {
        let found = schedule.epsilon(frames);
        let expected = start + (end - start) * share(frames, decay_frames);
        let (least, most) = (before.min(end), before.max(end));
        let error = if (least..=most).contains(&found) {
            found - expected
        } else {
            f64::MAX
        };
        row.see(error, || {
            format!("from {start} to {end} over {decay_frames} frames, after {frames}: {found}")
        });
        before = found;
    }
}

fn epsilon(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let row = |extreme: &str| {
        Row::new(
            EPSILON,
            extreme,
            "error of epsilon; never back, never beyond start and end",
            Schedule::ERROR,
        )
    };
    let mut listed = row(
        "decay over 0, 1, 1e5, 1e10, 2^32, 2^53, 2^64 - 1 frames, from before the first to after the last",
    );
    for decay in [0, 1, 100_000, 10_000_000_000, 1 << 32, 1 << 53, u64::MAX] {
        for (start, end) in [
            (1.0, 0.0),
            (0.1, 0.01),
            (1.0, 0.999_999_9),
            (0.05, 0.05),
            (0.0, 1.0),
        ] {
            let mut frames: Vec<u64> = (0..=100u32)
                .map(|i| (u128::from(decay) * u128::from(i) / 100) as u64)
                .flat_map(|at| [at.saturating_sub(1), at, at.saturating_add(1)])
                .chain([u64::MAX])
                .collect();
            frames.sort_unstable();
            see_schedule(&mut listed, start, end, decay, &frames);
        }
    }
    let mut drawn = row("drawn");
    context.draw(1.0, |_, rng| {
        let mut count = || rng.random::<u64>() >> rng.random_range(0..64);
        let (decay, mut frames) = (count(), [count(), count(), count(), count()]);
        frames.sort_unstable();
        see_schedule(&mut drawn, rng.random(), rng.random(), decay, &frames);
        Ok(())
    })?;
    Ok(vec![listed, drawn])
}

fn row(extreme: &str, promise: &str) -> Row {
    Row::new(COUNTERS, extreme, promise, 0.0)
}

const LARGE: [u64; 6] = [
    1 << 31,
    1 << 32,
    (1 << 32) + 7,
    10_000_000_000,
    1 << 40,
    1 << 49,
];

/// What the rate limiter says, against integers.
fn limiter(context: &mut Context<'_>) -> anyhow::Result<Row> {
    let mut row = row(
        "rate limiter, up to 2^50 transitions at a replay ratio of 8, in one shard and in several",
        "batches and chunks that pass or wait and should not",
    );
    let slack = 1000u64;
    context.draw(1.0, |number, rng| {
        let inserted = match LARGE.get(number as usize) {
            Some(&count) => count,
            None => rng.random_range(1 << 20..1 << 50),
        };
        let credit = rng.random_range(-20_000i64..20_000);
        let rows_sampled = (8 * inserted).saturating_add_signed(-credit);
        // What the other shards have of it.
        let part = |count: u64, rng: &mut ChaCha8Rng| match number % 2 {
            0 => 0,
            _ => rng.random_range(0..=count),
        };
        let others = Tally {
            inserted: part(inserted, rng),
            rows_sampled: part(rows_sampled, rng),
        };
        let own = Tally {
            inserted: inserted - others.inserted,
            rows_sampled: rows_sampled - others.rows_sampled,
        };
        let limiter = RateLimiter::new(8.0, 0, slack, None).counting_on(own, others);
        for rows in [
            1u32,
            32,
            256,
            credit.unsigned_abs() as u32,
            credit.unsigned_abs() as u32 + 1,
        ] {
            let right = limiter.may_sample(rows) == (i64::from(rows) <= credit)
                && limiter.may_insert() == (credit <= 8 * slack as i64);
            row.must(right, || {
                format!("{inserted} in, {rows_sampled} out, {rows} asked")
            });
        }
        Ok(())
    })?;
    Ok(row)
}

/// A replay that goes on where a long run was.
fn resumed() -> anyhow::Result<Row> {
    let mut row = row(
        "replay resumed after up to 2^48 updates of 32 rows",
        "counts after 40 more transitions and a batch that are not those of integers",
    );
    for updates in [1 << 31, 1 << 32, 10_000_000_000, 1 << 40, 1 << 48] {
        let spec = spec(3, 0.99, TimeoutRule::Terminal);
        let mut replay = replay(&spec, 32)?;
        let before = updates * 32 / 8;
        let join = LearnerJoin {
            learner: 1,
            run: 1,
            updates,
            tally: Tally {
                inserted: before,
                rows_sampled: updates * 32,
            },
            other_shards: Tally::default(),
            restart: false,
        };
        replay.join_learner(join).map_err(anyhow::Error::msg)?;
        let stored = replay.insert(&chunk(&[(1.0, End::Running); 40]));
        let found = match stored {
            InsertReply::Stored { inserted_total, .. } => inserted_total,
            other => anyhow::bail!("a chunk of a resumed run was not stored: {other:?}"),
        };
        let sampled = replay.sample(32).is_ok();
        row.must(sampled && found == before + 40, || {
            format!("{updates} updates: {found} transitions, sampled: {sampled}")
        });
    }
    Ok(row)
}

/// What an actor counts, on its way into a replay.
fn headers() -> anyhow::Result<Row> {
    let mut row = row(
        "sequence, first_transition and weights_version of a chunk, 2^31 to 2^48",
        "counts that are others once decoded, stored or sampled",
    );
    let spec = spec(3, 0.99, TimeoutRule::Terminal);
    for count in LARGE.map(|count| count.min((1 << 48) - 40)) {
        let mut all = chunk(&[(1.0, End::Running); 40]);
        all.header.sequence = count;
        all.header.first_transition = count;
        all.header.weights_version = count;
        let (head, payload) = all.seal(7)?;
        let decoded = Chunk::decode(&[head.as_slice(), payload].concat(), 7, 2)?;
        row.must(decoded.header == all.header, || {
            format!("decoded: {:?}", decoded.header)
        });
        let mut fresh = replay(&spec, 32)?;
        // A number that lost its upper half would be the one that is expected, or an earlier one.
        let reply = fresh.insert(&all);
        let is_refused = matches!(reply, InsertReply::OutOfOrder { expected: 0 });
        row.must(is_refused, || format!("sequence {count}: {reply:?}"));
        let mut acted = chunk(&[(1.0, End::Running); 40]);
        acted.header.weights_version = count;
        fresh.insert(&acted);
        let found = fresh.sample(32).map(|batch| batch.header.weights_versions);
        row.must(matches!(found, Ok(both) if both == (count, count)), || {
            format!("weights_version {count}: {found:?}")
        });
        let mut late = replay(&spec, 32)?;
        let mut first = chunk(&[(1.0, End::Running); 40]);
        first.header.first_transition = count;
        // What the replay server logs of it would look like a fault.
        let silence = tracing::subscriber::NoSubscriber::default();
        tracing::subscriber::with_default(silence, || late.insert(&first));
        let lost = late.status().transitions_lost;
        row.must(lost == count, || {
            format!("first_transition {count}: {lost} lost")
        });
    }
    Ok(row)
}

/// Seeds of a run that is resumed late.
fn seeds() -> Row {
    let mut row = row(
        "random numbers of an actor whose run is resumed after more than 2^32 updates",
        "seeds that are those of another start",
    );
    let spec = spec(3, 0.99, TimeoutRule::Terminal);
    let mut seen = Vec::new();
    for high in [0u64, 1, 2, 1 << 20, (1 << 32) - 1] {
        for low in [0u64, 7, (1 << 32) - 1] {
            for actor in [0, 3] {
                let life = Incarnation {
                    actor,
                    id: 1,
                    after_updates: high << 32 | low,
                    earlier_incarnations: 0,
                };
                let seed = life.seed(&spec, "world");
                row.must(!seen.contains(&seed), || format!("{life:?}"));
                seen.push(seed);
            }
        }
    }
    row
}

/// The learned affinity's own count of updates.
fn affinity(context: &mut Context<'_>) -> anyhow::Result<Row> {
    let mut row = row(
        "learned affinity after 2^31 to 2^53 updates",
        "further updates that are refused, or are not those of bias corrections of 1",
    );
    let settings = LearnedSettings {
        hidden: 8,
        lr: 2e-3,
        beta1: 0.9,
        beta2: 0.999,
        eps: 1e-8,
        keep: 0.9,
    };
    let learned = LearnedAffinity::new(Alphabet::raw(3)?, settings, &mut context.rng)?;
    let state = serde_json::to_value(AffinityEstimator::Learned(learned))?;
    let after = |updates: u64, context: &mut Context<'_>| -> anyhow::Result<Option<Vec<f32>>> {
        let mut state = state.clone();
        state["updates"] = updates.into();
        let mut estimate: AffinityEstimator = serde_json::from_value(state)?;
        let mut rng = context.rng.clone();
        for _ in 0..20 {
            if estimate
                .observe(&[(0, 1), (1, 2), (2, 0)], &mut rng)
                .is_err()
            {
                return Ok(None);
            }
        }
        Ok(Some(estimate.matrix().to_vec()))
    };
    // By then 0.999^t is 0 beside 1.
    let settled = after(1 << 24, context)?;
    for updates in [1 << 31, 1 << 32, 1 << 40, 1 << 53] {
        let found = after(updates, context)?;
        row.must(found.is_some() && found == settled, || {
            format!("{updates} updates")
        });
    }
    Ok(row)
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut rows = epsilon(context)?;
    rows.extend([
        limiter(context)?,
        resumed()?,
        headers()?,
        seeds(),
        affinity(context)?,
    ]);
    Ok(rows)
}
