//! N-step returns and discounts, as batches of a whole replay have them.

use driml_protocol::{End, InsertReply, TimeoutRule};
use driml_replay_server::{RETURN_ERROR, return_sum_error};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::replays::{chunk, replay, spec};
use crate::stability::{
    check::{Context, Routine, Row},
    edges::{exact_sum, finite, finites, shown},
};

const RETURNS: Routine = Routine {
    name: "n-step return",
    range: "rewards within 3.4e38 / n; n 1 to 1,000; gamma 0 to 1",
};

/// One replay's steps.
struct Case<'a> {
    n: usize,
    gamma: f64,
    timeout: TimeoutRule,
    steps: &'a [(f32, End)],
}

/// Return of the row at step `t`, the sum of its terms' sizes, and its discount.
fn expected(case: &Case<'_>, t: usize) -> (f64, f64, f64) {
    let (mut terms, mut follows) = (Vec::new(), Some(case.n));
    for (i, (reward, end)) in case.steps[t..].iter().take(case.n).enumerate() {
        if *end == End::TimedOut && case.timeout == TimeoutRule::Bootstrap {
            follows = Some(i);
            break;
        }
        terms.push(case.gamma.powi(i as i32) * f64::from(*reward));
        if end.is_episode_end() {
            follows = None;
            break;
        }
    }
    let largest = f64::from(f32::MAX);
    let sizes = exact_sum(terms.iter().map(|term| term.abs()));
    let discount = follows.map_or(0.0, |i| case.gamma.powi(i as i32));
    (exact_sum(terms).clamp(-largest, largest), sizes, discount)
}

fn see(row: &mut Row, case: &Case<'_>) -> anyhow::Result<()> {
    let rows = 16;
    let spec = spec(case.n as u32, case.gamma, case.timeout);
    let mut replay = replay(&spec, rows)?;
    let stored = replay.insert(&chunk(case.steps));
    anyhow::ensure!(
        matches!(stored, InsertReply::Stored { .. }),
        "a chunk within the limits was not stored: {stored:?}"
    );
    // An episode may have ended nowhere in reach.
    let Ok(batch) = replay.sample(rows) else {
        return Ok(());
    };
    let (returns, discounts) = (batch.n_step_returns(), batch.bootstrap_discounts());
    for (at, frame) in batch.states_t().chunks_exact(4).enumerate() {
        let t = u32::from_le_bytes([frame[0], frame[1], frame[2], frame[3]]) as usize;
        let (wanted, sizes, discount) = expected(case, t);
        let least = f64::from(f32::MIN_POSITIVE);
        let found = f64::from(returns[at]);
        let allowed = RETURN_ERROR * wanted.abs().max(least) + return_sum_error(case.n) * sizes;
        let in_return = (found - wanted).abs() / allowed;
        let in_discount =
            (f64::from(discounts[at]) - discount).abs() / (RETURN_ERROR * discount.max(least));
        row.see(in_return.max(in_discount), || {
            let rewards: Vec<f32> = case.steps[t..].iter().take(case.n).map(|it| it.0).collect();
            format!(
                "n = {}, gamma = {:e}, rewards {}",
                case.n,
                case.gamma,
                shown(&rewards)
            )
        });
    }
    Ok(())
}

fn row(extreme: &str) -> Row {
    Row::new(
        RETURNS,
        extreme,
        "error of return or discount, as a share of 6.1e-8 of it + 2.2e-16 n of the terms' sizes; never infinite",
        1.0,
    )
}

fn ends(count: usize, likely: f64, rng: &mut ChaCha8Rng) -> Vec<End> {
    let mut end = || match rng.random_bool(likely) {
        true => [End::Terminal, End::TimedOut, End::LevelChange][rng.random_range(0..3)],
        false => End::Running,
    };
    (0..count).map(|_| end()).collect()
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut listed = row(
        "rewards 0, 1e-45, +-1e30 that cancel, 3.4e38 / n; n 1, 7, 1,000; gamma 0, 1e-320, 0.5, 0.99, 1 - 1e-12, 1",
    );
    for n in [1usize, 7, 1000] {
        let count = 2 * n + 40;
        let most = f32::MAX / n as f32;
        let kinds: [&dyn Fn(usize) -> f32; 5] = [
            &|_| 0.0,
            &|_| 1e-45,
            &|i| [1e30, 1.0, -1e30][i % 3],
            &|_| most,
            &|i| if i % 2 == 0 { -most } else { most },
        ];
        for gamma in [0.0, 1e-320, 0.5, 0.99, 1.0 - 1e-12, 1.0] {
            for reward in kinds {
                for timeout in [TimeoutRule::Terminal, TimeoutRule::Bootstrap] {
                    let ends = ends(count, 0.5 / n as f64, &mut context.rng);
                    let steps: Vec<_> = (0..count).map(|i| (reward(i), ends[i])).collect();
                    let steps = &steps;
                    see(
                        &mut listed,
                        &Case {
                            n,
                            gamma,
                            timeout,
                            steps,
                        },
                    )?;
                }
            }
            context.progress.advance(0)?;
        }
    }
    let mut drawn = row("drawn");
    context.draw(0.1, |_, rng| {
        let n = rng.random_range(1..60);
        let most = f32::MAX / n as f32;
        let count = n + rng.random_range(17..60);
        let likely = rng.random_range(0.0..0.2);
        let ends = ends(count, likely, rng);
        let rewards = finites(count, rng);
        let steps: Vec<_> = rewards
            .iter()
            .map(|r| r.clamp(-most, most))
            .zip(ends)
            .collect();
        let gamma = match rng.random_range(0..3) {
            0 => rng.random(),
            1 => f64::from(finite(rng)).abs().min(1.0),
            _ => [0.0, 1e-320, 0.99, 1.0 - 1e-12, 1.0][rng.random_range(0..5)],
        };
        let timeout = [TimeoutRule::Terminal, TimeoutRule::Bootstrap][rng.random_range(0..2)];
        see(
            &mut drawn,
            &Case {
                n,
                gamma,
                timeout,
                steps: &steps,
            },
        )
    })?;
    Ok(vec![listed, drawn])
}
