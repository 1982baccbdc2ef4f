//! The schedule of epsilon, and counters beyond 2^32.

use std::fmt::Arguments;

use driml_actor::{Incarnation, Schedule};
use driml_learner::{AffinityEstimator, Alphabet, LearnedAffinity, LearnedSettings};
use driml_protocol::{Chunk, End, InsertReply, LearnerJoin, RunSpec, Tally, TimeoutRule};
use driml_replay_server::{RateLimiter, Replay};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    affinity::LEARNED,
    replay::{self, chunk, config},
};
use crate::stability::property::{Cases, broken};

fn see_schedule(
    extreme: &str,
    cases: &mut Cases<'_>,
    (start, end): (f64, f64),
    decay_frames: u64,
    frames: &[u64],
) -> anyhow::Result<()> {
    let schedule = Schedule::Falling {
        start,
        end,
        decay_frames,
    };
    let mut before = start;
    for &frames in frames {
        let found = schedule.epsilon(frames);
        // The share of two counts, right to the last place: 64 bits of the quotient, as an integer.
        let share = match frames >= decay_frames {
            true => 1.0,
            false => ((u128::from(frames) << 64) / u128::from(decay_frames)) as f64 / 2f64.powi(64),
        };
        let error = match (before.min(end)..=before.max(end)).contains(&found) {
            true => found - (start + (end - start) * share),
            false => f64::NAN,
        };
        let input = format_args!("{start} to {end} over {decay_frames}, after {frames}: {found}");
        cases.see(extreme, input, [error])?;
        before = found;
    }
    Ok(())
}

pub(crate) fn epsilon(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let ends = [
        (1.0, 0.0),
        (0.1, 0.01),
        (1.0, 0.999_999_9),
        (0.05, 0.05),
        (0.0, 1.0),
    ];
    for decay in [0, 1, 100_000, 10_000_000_000, 1 << 32, 1 << 53, u64::MAX] {
        let hundredths = (0..=100u32).map(|i| (u128::from(decay) * u128::from(i) / 100) as u64);
        let beside = hundredths.flat_map(|at| [at.saturating_sub(1), at, at.saturating_add(1)]);
        let mut frames: Vec<u64> = beside.chain([u64::MAX]).collect();
        frames.sort_unstable();
        let extreme = "decay over 0, 1, 1e5, 1e10, 2^32, 2^53, 2^64 - 1 frames, from before the first to after the last";
        for ends in ends {
            see_schedule(extreme, cases, ends, decay, &frames)?;
        }
    }
    for _ in cases.draws(1.0) {
        let rng = &mut cases.rng;
        let mut count = || rng.random::<u64>() >> rng.random_range(0..64);
        let (decay, mut frames) = (count(), [count(), count(), count(), count()]);
        frames.sort_unstable();
        let ends = (rng.random(), rng.random());
        see_schedule("drawn", cases, ends, decay, &frames)?;
    }
    Ok(())
}

const LARGE: [u64; 6] = [
    1 << 31,
    1 << 32,
    (1 << 32) + 7,
    10_000_000_000,
    1 << 40,
    1 << 49,
];
const SLACK: u64 = 1000;

fn spec() -> RunSpec {
    replay::spec(3, 0.99, TimeoutRule::Terminal)
}

fn fresh() -> anyhow::Result<Replay> {
    replay::replay(&spec(), 32, &config(4096))
}

fn forty() -> Chunk {
    chunk(&[(1.0, End::Running); 40])
}

pub(crate) fn counters(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for number in cases.draws(1.0) {
        see_limiter(cases, number)?;
    }
    see_resumed(cases)?;
    see_headers(cases)?;
    see_seeds(cases)?;
    see_affinity(cases)
}

/// What the rate limiter says, against integers.
fn see_limiter(cases: &mut Cases<'_>, number: u64) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
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
    let limiter = RateLimiter::new(8.0, 0, SLACK, None).counting_on(own, others);
    let near = credit.unsigned_abs() as u32;
    for rows in [1, 32, 256, near, near + 1] {
        let right = limiter.may_sample(rows) == (i64::from(rows) <= credit)
            && limiter.may_insert() == (credit <= 8 * SLACK as i64);
        let extreme = "rate limiter, up to 2^50 transitions at a replay ratio of 8, in one shard and in several";
        let input = format_args!("{inserted} in, {rows_sampled} out, {rows} asked");
        cases.see(extreme, input, [broken(right)])?;
    }
    Ok(())
}

/// A replay that resumes where a long run was.
fn see_resumed(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for updates in [1 << 31, 1 << 32, 10_000_000_000, 1 << 40, 1 << 48] {
        let mut replay = fresh()?;
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
        let stored = replay.insert(&forty());
        let is_counted = matches!(stored, InsertReply::Stored { inserted_total, .. } if inserted_total == before + 40);
        let right = is_counted && replay.sample(32).is_ok();
        let extreme = "replay resumed after up to 2^48 updates of 32 rows";
        cases.see(
            extreme,
            format_args!("{updates} updates: {stored:?}"),
            [broken(right)],
        )?;
    }
    Ok(())
}

/// What an actor counts, on its way into a replay.
fn see_headers(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let mut see = |input: Arguments<'_>, right: bool| {
        let extreme = "sequence, first_transition and weights_version of a chunk, 2^31 to 2^48";
        cases.see(extreme, input, [broken(right)])
    };
    for count in LARGE.map(|count| count.min((1 << 48) - 40)) {
        let mut all = forty();
        all.header.sequence = count;
        all.header.first_transition = count;
        all.header.weights_version = count;
        let (head, payload) = all.seal(7)?;
        let decoded = Chunk::decode(&[head.as_slice(), payload].concat(), 7, 2)?.header;
        see(format_args!("decoded: {decoded:?}"), decoded == all.header)?;
        let mut replay = fresh()?;
        // A number that lost its upper half would be the one that is expected, or an earlier one.
        let reply = replay.insert(&all);
        let is_refused = matches!(reply, InsertReply::OutOfOrder { expected: 0 });
        see(format_args!("sequence {count}: {reply:?}"), is_refused)?;
        let mut acted = forty();
        acted.header.weights_version = count;
        replay.insert(&acted);
        let found = replay.sample(32).map(|batch| batch.header.weights_versions);
        let right = matches!(found, Ok(both) if both == (count, count));
        see(format_args!("weights_version {count}: {found:?}"), right)?;
        let mut replay = fresh()?;
        let mut first = forty();
        first.header.first_transition = count;
        // What the replay server logs of it would look like a fault.
        let silence = tracing::subscriber::NoSubscriber::default();
        tracing::subscriber::with_default(silence, || replay.insert(&first));
        let lost = replay.status().transitions_lost;
        see(
            format_args!("first_transition {count}: {lost} lost"),
            lost == count,
        )?;
    }
    Ok(())
}

/// Seeds of a run that is resumed late.
fn see_seeds(cases: &mut Cases<'_>) -> anyhow::Result<()> {
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
                let seed = life.seed(&spec(), "world");
                let extreme = "random numbers of an actor whose run is resumed after more than 2^32 updates, beside those of other starts";
                let is_new = broken(!seen.contains(&seed));
                cases.see(extreme, format_args!("{life:?}"), [is_new])?;
                seen.push(seed);
            }
        }
    }
    Ok(())
}

/// The learned affinity's own count of updates.
fn see_affinity(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let settings = LearnedSettings {
        hidden: 8,
        ..LEARNED
    };
    let learned = LearnedAffinity::new(Alphabet::raw(3)?, settings, &mut cases.rng)?;
    let state = serde_json::to_value(AffinityEstimator::Learned(learned))?;
    let rng = cases.rng.clone();
    let after = |updates: u64| -> anyhow::Result<Option<Vec<f32>>> {
        let (mut state, mut rng) = (state.clone(), rng.clone());
        state["updates"] = updates.into();
        let mut estimate: AffinityEstimator = serde_json::from_value(state)?;
        let pairs = [(0, 1), (1, 2), (2, 0)];
        let is_taken = (0..20).all(|_| estimate.observe(&pairs, &mut rng).is_ok());
        Ok(is_taken.then(|| estimate.matrix().to_vec()))
    };
    // By then 0.999^t is 0 beside 1, and bias corrections are 1.
    let settled = after(1 << 24)?;
    for updates in [1 << 31, 1 << 32, 1 << 40, 1 << 53] {
        let found = after(updates)?;
        let right = broken(found.is_some() && found == settled);
        let extreme = "learned affinity after 2^31 to 2^53 updates";
        cases.see(extreme, format_args!("{updates} updates"), [right])?;
    }
    Ok(())
}
