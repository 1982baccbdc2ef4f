//! The n-step returns and discounts in the batches of a replay.

use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, End, InsertReply, RunSpec, Sampling, TimeoutRule,
};
use driml_replay_server::{Config, RETURN_ERROR, Replay, return_sum_error};

use crate::stability::property::*;

const REWARDS: &str = "rewards 0, 1e-45, +-1e30 that cancel, 3.4e38 / n; n 1, 7, 1,000; gamma 0, 1e-320, 0.5, 0.99, 1 - 1e-12, 1";

pub(super) fn properties() -> Vec<Property> {
    let terms = "rewards within 3.4e38 / n; n 1 to 1,000; gamma 0 to 1";
    vec![
        Property::new("n-step return", terms)
            // The bound of a return is 6.1e-8 of it + 2.2e-16 n of the sum of its terms' sizes. A return is never infinite.
            .promise("return or discount, as a share of its bound", 1.0)
            .check(REWARDS, Listed, returns)
            .check("drawn", Drawn(0.1), returns),
    ]
}

/// Returns the spec of a world in which each frame holds the number of its step.
pub(super) fn numbered_spec() -> RunSpec {
    RunSpec {
        frame_width: 4,
        ..RunSpec::smallest()
    }
}

/// Creates a replay with these steps of actor 0, in which neither the actors nor the learner wait.
pub(super) fn new_replay(
    spec: &RunSpec,
    sampling: Sampling,
    rows: u32,
    steps: &[(f32, End)],
) -> anyhow::Result<Replay> {
    let config = Config {
        sampling,
        ..Config::unlimited(4096)
    };
    let mut replay = Replay::new(spec, &config, rows)?;
    let join = ActorJoin::new(0, 1);
    replay.join_actor(join).map_err(anyhow::Error::msg)?;
    let mut chunk = Chunk::zeroed(ChunkHeader {
        incarnation: 1,
        streams: 1,
        steps: steps.len() as u32,
        frame_bytes: 4,
        ..ChunkHeader::default()
    });
    for (row, (reward, end)) in steps.iter().enumerate() {
        let number = (row as u32).to_le_bytes();
        chunk.frame_mut(row).copy_from_slice(&number);
        chunk.set(row, 1, *reward, *end);
    }
    let stored = replay.insert(&chunk);
    let is_stored = matches!(stored, InsertReply::Stored { .. });
    anyhow::ensure!(is_stored, "the chunk was not stored: {stored:?}");
    Ok(replay)
}

/// Returns the step number that a state [1, 4, 1] holds.
pub(super) fn step_number(state: &[u8]) -> usize {
    u32::from_le_bytes([state[0], state[1], state[2], state[3]]) as usize
}

/// Returns the n-step return at the first of these steps, the sum of the sizes of its terms, and its discount.
fn expected_return(spec: &RunSpec, steps: &[(f32, End)]) -> (f64, f64, f64) {
    let n = spec.n_step as usize;
    let (mut terms, mut follows) = (Vec::new(), Some(n));
    for (i, (reward, end)) in steps.iter().take(n).enumerate() {
        if *end == End::TimedOut && spec.timeout == TimeoutRule::Bootstrap {
            follows = Some(i);
            break;
        }
        terms.push(spec.gamma.powi(i as i32) * f64::from(*reward));
        if end.is_episode_end() {
            follows = None;
            break;
        }
    }
    let largest = f64::from(f32::MAX);
    let sizes = exact_sum(terms.iter().map(|term| term.abs()));
    let discount = follows.map_or(0.0, |i| spec.gamma.powi(i as i32));
    (exact_sum(terms).clamp(-largest, largest), sizes, discount)
}

fn returns(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let n = cases.listed_or(&[1usize, 7, 1000], |rng| rng.random_range(1..60));
    let gammas = [0.0, 1e-320, 0.5, 0.99, 1.0 - 1e-12, 1.0];
    let gamma = cases.listed_or(&gammas, |rng| match rng.random_range(0..3) {
        0 => rng.random(),
        1 => f64::from(draw_finite(rng)).abs().min(1.0),
        _ => one_of(&gammas, rng),
    });
    let timeout = cases.one_of(&[TimeoutRule::Terminal, TimeoutRule::Bootstrap]);
    let count = cases.listed_or(&[2 * n + 40], |rng| n + rng.random_range(17..60));
    let end_chance = cases.listed_or(&[0.5 / n as f64], |rng| rng.random_range(0.0..0.2));
    let reward_max = f32::MAX / n as f32;
    let patterns = [
        vec![0.0],
        vec![1e-45],
        vec![1e30, 1.0, -1e30],
        vec![reward_max],
        vec![-reward_max, reward_max],
    ];
    let repeated = patterns.map(|it| it.into_iter().cycle().take(count).collect());
    let rewards: Vec<f32> = cases.listed_or(&repeated, |rng| draw_clamped(count, reward_max, rng));
    let ends = [End::Terminal, End::TimedOut, End::LevelChange];
    let end = |_| match cases.rng.random_bool(end_chance) {
        true => one_of(&ends, &mut cases.rng),
        false => End::Running,
    };
    let steps: Vec<_> = rewards.into_iter().zip((0..count).map(end)).collect();

    let rows = 16;
    let spec = RunSpec {
        n_step: n as u32,
        gamma,
        timeout,
        ..numbered_spec()
    };
    let mut replay = new_replay(&spec, Sampling::default(), rows, &steps)?;
    // If no row is complete, the replay has nothing to sample.
    let Ok(batch) = replay.sample(rows) else {
        return Ok(());
    };
    let found = batch.n_step_returns().into_iter();
    let found = found.zip(batch.bootstrap_discounts());
    for (state, (found, discount)) in batch.states_t().chunks_exact(4).zip(found) {
        let t = step_number(state);
        let (expected, sizes, expected_discount) = expected_return(&spec, &steps[t..]);
        let allowed = RETURN_ERROR * expected.abs().max(MIN_NORMAL) + return_sum_error(n) * sizes;
        let of_return = (f64::from(found) - expected).abs() / allowed;
        let of_discount = rel_error(discount, expected_discount) / RETURN_ERROR;
        let input = format_args!("n = {n}, gamma = {gamma:e}, the row at {t}: {found:e}");
        cases.record_errors(input, [of_return.max(of_discount)])?;
    }
    Ok(())
}
