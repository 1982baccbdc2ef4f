//! Rows drawn by priority: the chances that their batch says, the law of the draws, and the weights that undo their bias.

use anyhow::Context as _;
use driml_learner::importance::{WEIGHT_ERROR, importance_weights};
use driml_protocol::{End, PriorityPart, PriorityUpdate, RunSpec, Sampling, TimeoutRule};
use driml_replay_server::{CHANCE_ERROR, Config, PRIORITY_MIN, Replay};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    horizon::deviations,
    replays::{chunk, config, replay_with, spec},
};
use crate::stability::{
    check::{Context, Routine, Row},
    edges::{exact_sum, finite, finites, shown},
};

const DRAW: Routine = Routine {
    name: "prioritised draw",
    range: "priorities, which are C51 losses, 0 to 3.4e38; alpha 0 to 1",
};
const WEIGHT: Routine = Routine {
    name: "importance weight",
    range: "chances 1.2e-38 to 1; beta 0 to 1",
};
/// Transitions that can be drawn.
const HELD: usize = 300;
const ROWS: u32 = 64;

/// A replay that draws by a seed of its own, whose transitions have these priorities, and the law of its draws.
fn prioritised(seed: u64, alpha: f64, priorities: &[f32]) -> anyhow::Result<(Replay, Vec<f64>)> {
    let config = Config {
        sampling: Sampling::Prioritised {
            alpha,
            beta_start: 0.4,
            beta_end: 1.0,
            beta_updates: 100,
        },
        // As often as the law is to be seen.
        replay_ratio: 1e9,
        ..config(4096)
    };
    let spec = RunSpec {
        seed,
        ..spec(1, 0.99, TimeoutRule::Terminal)
    };
    let mut replay = replay_with(&spec, ROWS, &config)?;
    // The last one lacks a step that follows.
    replay.insert(&chunk(&[(1.0, End::Running); HELD + 1]));
    let batch = replay
        .sample(ROWS)
        .map_err(|why| anyhow::anyhow!("no batch of {HELD} transitions: {why:?}"))?;
    let update = PriorityUpdate {
        learner: 1,
        number: 1,
        parts: vec![PriorityPart {
            origin: batch.header.origin.context("rows drawn by priority")?,
            transitions: (0..HELD as u64).collect(),
            priorities: priorities.to_vec(),
        }],
    };
    replay.set_priorities(&update).map_err(anyhow::Error::msg)?;
    let mass = |&priority: &f32| (f64::from(priority) + PRIORITY_MIN).powf(alpha);
    let sum = exact_sum(priorities.iter().map(mass));
    let law = priorities.iter().map(|it| mass(it) / sum);
    Ok((replay, law.collect()))
}

/// Sees the chances of a batch's rows; counts which transitions they are.
fn see_batch(
    row: &mut Row,
    replay: &mut Replay,
    law: &[f64],
    counts: &mut [u64],
) -> anyhow::Result<()> {
    let batch = replay
        .sample(ROWS)
        .map_err(|why| anyhow::anyhow!("no batch of {HELD} transitions: {why:?}"))?;
    let chances = batch.probabilities().context("rows drawn by priority")?;
    for (frame, chance) in batch.states_t().chunks_exact(4).zip(chances) {
        let transition = u32::from_le_bytes([frame[0], frame[1], frame[2], frame[3]]) as usize;
        let expected = law[transition].max(f32::MIN_POSITIVE.into());
        row.see(f64::from(chance) / expected - 1.0, || {
            format!("{chance:e}, which should be {expected:e}")
        });
        counts[transition] += 1;
    }
    Ok(())
}

fn draws(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let chance = |extreme: &str| {
        Row::new(
            DRAW,
            extreme,
            "error of the chance that a batch says of a row, as a share of it (of 1.2e-38 below that)",
            CHANCE_ERROR,
        )
    };
    let mut listed =
        chance("all 0, 1e-45, 1, 3.4e38; one of 3.4e38 among 0; 1e-45 to 3.4e38; alpha 0, 0.5, 1");
    let mut law_row = Row::new(
        DRAW,
        "the same",
        "deviations of a chi-square from the law of the draws",
        5.0,
    );
    let ramp = |at: usize| 10f64.powf(-45.0 + 83.5 * at as f64 / HELD as f64) as f32;
    let kinds: [&dyn Fn(usize) -> f32; 6] = [
        &|_| 0.0,
        &|_| 1e-45,
        &|_| 1.0,
        &|_| f32::MAX,
        &|at| if at == HELD / 2 { f32::MAX } else { 0.0 },
        &ramp,
    ];
    for (number, kind) in kinds.iter().enumerate() {
        let priorities: Vec<f32> = (0..HELD).map(kind).collect();
        for alpha in [0.0, 0.5, 1.0] {
            let (mut replay, law) = prioritised(context.rng.random(), alpha, &priorities)?;
            let mut counts = vec![0; HELD];
            for _ in 0..context.settings.law_draws / u64::from(ROWS) {
                see_batch(&mut listed, &mut replay, &law, &mut counts)?;
            }
            law_row.see(deviations(&counts, &law).max(0.0), || {
                format!("kind {} of priorities, alpha {alpha}", number + 1)
            });
            context.progress.advance(0)?;
        }
    }
    let mut drawn = chance("drawn");
    context.draw(0.01, |_, rng| {
        let sizes: Vec<f32> = finites(HELD, rng).into_iter().map(f32::abs).collect();
        let (mut replay, law) = prioritised(rng.random(), rng.random(), &sizes)?;
        see_batch(&mut drawn, &mut replay, &law, &mut vec![0; HELD])
    })?;
    Ok(vec![listed, law_row, drawn])
}

fn weights(context: &mut Context<'_>) -> anyhow::Result<Row> {
    let mut row = Row::new(
        WEIGHT,
        "2 to 64 rows, chances 1.2e-38 to 1 and equal ones, beta 0, 1 and between, drawn",
        "error of a weight, as a share of it; the least likely row's is 1",
        WEIGHT_ERROR,
    );
    context.draw(1.0, |number, rng| {
        let count = rng.random_range(2..=64);
        let chances = chances(count, rng);
        let beta = match number % 4 {
            0 => 0.0,
            1 => 1.0,
            _ => rng.random(),
        };
        let least = chances.iter().copied().fold(f32::INFINITY, f32::min);
        let found = importance_weights(&chances, beta);
        for (&found, &chance) in found.iter().zip(&chances) {
            let expected = (beta * (f64::from(least).ln() - f64::from(chance).ln())).exp();
            let error = match chance == least && found != 1.0 {
                true => f64::MAX,
                false => f64::from(found) / expected - 1.0,
            };
            row.see(error, || {
                format!("beta {beta}, chances {}", shown(&chances))
            });
        }
        Ok(())
    })?;
    Ok(row)
}

/// Chances of any size, or all the same.
fn chances(count: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let one = |rng: &mut ChaCha8Rng| finite(rng).abs().clamp(f32::MIN_POSITIVE, 1.0);
    match rng.random_bool(0.2) {
        true => vec![one(rng); count],
        false => (0..count).map(|_| one(rng)).collect(),
    }
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut rows = draws(context)?;
    rows.push(weights(context)?);
    Ok(rows)
}
