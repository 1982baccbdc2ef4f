//! The schedule of epsilon, and counters beyond 2^32.

use driml_actor::{Incarnation, Schedule};
use driml_learner::{AffinityEstimator, Alphabet, LearnedAffinity, LearnedSettings};
use driml_protocol::{
    Chunk, End, InsertReply, LearnerJoin, RunSpec, ShardCounts, TimeoutRule, codec,
};
use driml_replay_server::{RateLimiter, Replay};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    affinity::LEARNED,
    replay::{self, chunk, config},
};
use crate::stability::property::{Cases, Drawn, Listed, Property};

const FRAMES: &str = "decay over 0, 1, 1e5, 1e10, 2^32, 2^53, 2^64 - 1 frames, from before the first to after the last";
const LIMITER: &str =
    "rate limiter, up to 2^50 transitions at a replay ratio of 8, in one shard and in several";
const SEEDS: &str = "random numbers of an actor whose run is resumed after more than 2^32 updates, beside those of other starts";
const HEADERS: &str = "sequence, first_transition and weights_version of a chunk, 2^31 to 2^48";
const RESUMED: &str = "replay resumed after up to 2^48 updates of 32 rows";

pub(super) const PROPERTIES: &[Property] = &[
    Property {
        routine: "epsilon",
        range: "any counts of frames; start and end 0 to 1",
        promises: &[("epsilon; never back or beyond its ends", Schedule::ERROR)],
        extremes: &[(FRAMES, Listed, epsilon), ("drawn", Drawn(1.0), epsilon)],
    },
    Property {
        routine: "counters",
        range: "up to 2^53 rows and transitions; others up to 2^64",
        promises: &[("cases whose counts are not those of integers", 0.0)],
        extremes: &[
            (LIMITER, Listed, limiter),
            (LIMITER, Drawn(1.0), limiter),
            (RESUMED, Listed, resumed),
            (HEADERS, Listed, headers),
            (SEEDS, Listed, seeds),
            (
                "learned affinity after 2^31 to 2^53 updates",
                Listed,
                learned,
            ),
        ],
    },
];

/// Of any size.
fn count(rng: &mut ChaCha8Rng) -> u64 {
    rng.random::<u64>() >> rng.random_range(0..64)
}

fn epsilon(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let ends = [
        (1.0, 0.0),
        (0.1, 0.01),
        (1.0, 0.999_999_9),
        (0.05, 0.05),
        (0.0, 1.0),
    ];
    let (start, end) = cases.of(&ends, |rng| (rng.random(), rng.random()));
    let decays = [0, 1, 100_000, 10_000_000_000, 1 << 32, 1 << 53, u64::MAX];
    let decay_frames = cases.of(&decays, count);
    let hundredths = (0..=100u32).map(|i| (u128::from(decay_frames) * u128::from(i) / 100) as u64);
    let beside = hundredths.flat_map(|at| [at.saturating_sub(1), at, at.saturating_add(1)]);
    let listed: Vec<u64> = beside.chain([u64::MAX]).collect();
    let mut frames = cases.of(&[listed], |rng| (0..4).map(|_| count(rng)).collect());
    frames.sort_unstable();
    let schedule = Schedule::Falling {
        start,
        end,
        decay_frames,
    };
    let mut before: f64 = start;
    for frames in frames {
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
        cases.see(input, [error])?;
        before = found;
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

/// What the rate limiter says, against integers.
fn limiter(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let inserted = cases.of(&LARGE, |rng| rng.random_range(1 << 20..1 << 50));
    let is_sharded = cases.each(&[false, true]);
    let rng = &mut cases.rng;
    let credit = rng.random_range(-20_000i64..20_000);
    let rows_sampled = (8 * inserted).saturating_add_signed(-credit);
    // What the other shards have of it.
    let mut part = |count: u64| match is_sharded {
        true => rng.random_range(0..=count),
        false => 0,
    };
    let others = ShardCounts {
        inserted: part(inserted),
        rows_sampled: part(rows_sampled),
    };
    let own = ShardCounts {
        inserted: inserted - others.inserted,
        rows_sampled: rows_sampled - others.rows_sampled,
    };
    let limiter = RateLimiter::new(8.0, 0, SLACK, None).counting_on(own, others);
    let near = credit.unsigned_abs() as u32;
    for rows in [1, 32, 256, near, near + 1] {
        let right = limiter.may_sample(rows) == (i64::from(rows) <= credit)
            && limiter.may_insert() == (credit <= 8 * SLACK as i64);
        let input = format_args!("{inserted} in, {rows_sampled} out, {rows} asked");
        cases.keeps(0, input, right)?;
    }
    Ok(())
}

/// A replay that resumes where a long run was.
fn resumed(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let updates = cases.each(&[1 << 31, 1 << 32, 10_000_000_000, 1 << 40, 1 << 48]);
    let mut replay = fresh()?;
    let before = updates * 32 / 8;
    let join = LearnerJoin {
        learner: 1,
        run: 1,
        updates,
        counts: ShardCounts {
            inserted: before,
            rows_sampled: updates * 32,
        },
        other_shards: ShardCounts::default(),
        restart: false,
    };
    replay.join_learner(join).map_err(anyhow::Error::msg)?;
    let stored = replay.insert(&forty());
    let is_counted = matches!(stored, InsertReply::Stored { inserted_total, .. } if inserted_total == before + 40);
    let right = is_counted && replay.sample(32).is_ok();
    cases.keeps(0, format_args!("{updates} updates: {stored:?}"), right)
}

/// What an actor counts, on its way into a replay.
fn headers(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let count = cases.each(&LARGE).min((1 << 48) - 40);
    let mut all = forty();
    all.header.sequence = count;
    all.header.first_transition = count;
    all.header.weights_version = count;
    let bytes = codec::encode(7, &all.header, all.payload())?;
    let decoded = Chunk::decode(&bytes, 7)?.header;
    cases.keeps(
        0,
        format_args!("decoded: {decoded:?}"),
        decoded == all.header,
    )?;
    // A number that lost its upper half would be the one that is expected, or an earlier one.
    let mut replay = fresh()?;
    let reply = replay.insert(&all);
    let is_refused = matches!(reply, InsertReply::OutOfOrder { expected: 0 });
    cases.keeps(0, format_args!("sequence {count}: {reply:?}"), is_refused)?;
    let mut acted = forty();
    acted.header.weights_version = count;
    replay.insert(&acted);
    let found = replay.sample(32).map(|batch| batch.header.weights_versions);
    let right = matches!(found, Ok(both) if both == (count, count));
    cases.keeps(0, format_args!("weights_version {count}: {found:?}"), right)?;
    let mut replay = fresh()?;
    let mut first = forty();
    first.header.first_transition = count;
    insert_silently(&mut replay, &first);
    let lost = replay.status().transitions_lost;
    let input = format_args!("first_transition {count}: {lost} lost");
    cases.keeps(0, input, lost == count)
}

/// What the replay server logs of such a chunk would look like a fault.
pub(super) fn insert_silently(replay: &mut Replay, chunk: &Chunk) -> InsertReply {
    let silence = tracing::subscriber::NoSubscriber::default();
    tracing::subscriber::with_default(silence, || replay.insert(chunk))
}

/// Seeds of a run that is resumed late.
fn seeds(cases: &mut Cases<'_>) -> anyhow::Result<()> {
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
                cases.keeps(0, format_args!("{life:?}"), !seen.contains(&seed))?;
                seen.push(seed);
            }
        }
    }
    Ok(())
}

/// The learned affinity's own count of updates.
fn learned(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let settings = LearnedSettings {
        hidden: 8,
        ..LEARNED
    };
    let learned = LearnedAffinity::new(Alphabet::raw(3)?, settings, &mut cases.rng)?;
    let mut state = serde_json::to_value(AffinityEstimator::Learned(learned))?;
    // By 2^24 updates 0.999^t is 0 beside 1, and bias corrections are 1.
    let updates = cases.each(&[1u64 << 31, 1 << 32, 1 << 40, 1 << 53]);
    let after = [1 << 24, updates].map(|updates| -> anyhow::Result<_> {
        state["updates"] = updates.into();
        let mut estimate: AffinityEstimator = serde_json::from_value(state.clone())?;
        let (pairs, mut rng) = ([(0, 1), (1, 2), (2, 0)], cases.rng.clone());
        let is_taken = (0..20).all(|_| estimate.observe(&pairs, &mut rng).is_ok());
        Ok((is_taken, estimate.matrix().to_vec()))
    });
    let [settled, found] = after;
    let (settled, found) = (settled?, found?);
    let right = found.0 && found == settled;
    cases.keeps(0, format_args!("{updates} updates"), right)
}
