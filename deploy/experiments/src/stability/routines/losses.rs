//! C51's losses: projection, softmax, and the divergence with its slopes.

use driml_learner::losses::{
    c51::{ENTRY_ERROR, KL_ERROR, SLOPE_ERROR, kl as product_kl, softmax as product_softmax},
    projection::{MASS_ERROR, entry_error, project},
};
use rand::{Rng, seq::IndexedRandom};

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{exact_sum, finite, finites, law, probability, shown, support, widened},
};

const PROJECTION: Routine = Routine {
    name: "C51 projection",
    range: "rewards any, infinite ones included; discounts 0 to 1; a support within 1e30",
};
const SOFTMAX: Routine = Routine {
    name: "softmax",
    range: "logits finite",
};
const KL: Routine = Routine {
    name: "C51 loss (KL)",
    range: "logits finite; targets sum to 1",
};

/// One row's projection: return distribution, reward, discount, support.
struct Step<'a> {
    probs: &'a [f32],
    reward: f32,
    discount: f32,
    support: (f32, f32),
}

/// Where each atom lands, as the height of the hats of the atoms beside it: 1 at an atom, 0 at its neighbours.
fn hats(step: &Step<'_>) -> Vec<f64> {
    let last = step.probs.len() - 1;
    let (low, high) = (f64::from(step.support.0), f64::from(step.support.1));
    let width = high - low;
    let mut sums = vec![0.0; last + 1];
    for (i, &p) in step.probs.iter().enumerate() {
        let z = low + width * (i as f64 / last as f64);
        let moved = f64::from(step.reward) + f64::from(step.discount) * z;
        let place = (moved.clamp(low, high) - low) / width * last as f64;
        let near = place.floor() as usize;
        let first = near.saturating_sub(1);
        for (j, sum) in sums.iter_mut().enumerate().skip(first).take(3) {
            *sum += f64::from(p) * (1.0 - (place - j as f64).abs()).max(0.0);
        }
    }
    sums
}

fn see_projection(entry: &mut Row, mass: &mut Row, step: &Step<'_>) {
    let mut out = vec![f32::NAN; step.probs.len()];
    let (low, high) = step.support;
    project(
        step.probs,
        &[step.reward],
        &[step.discount],
        low,
        high,
        &mut out,
    );
    let allowed = entry_error(out.len(), low, high);
    let input = || {
        format!(
            "reward {:e}, discount {:e}, {} atoms on [{low:e}, {high:e}]",
            step.reward,
            step.discount,
            step.probs.len()
        )
    };
    let errors = out.iter().zip(hats(step)).map(|(p, expected)| {
        let error = (f64::from(*p) - expected).abs() / allowed;
        // No probability: as bad as it gets.
        if *p >= 0.0 && p.is_finite() {
            error
        } else {
            f64::MAX
        }
    });
    entry.see(errors.fold(0.0, worse), input);
    let sum = |values: &[f32]| exact_sum(widened(values));
    mass.see(sum(&out) - sum(step.probs), input);
}

pub(super) fn projection(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let rows = |extreme: &str| {
        [
            Row::new(
                PROJECTION,
                extreme,
                "error of a probability, as a share of 1e-7 + 1e-15 N max|v| / width; none is negative",
                1.0,
            ),
            Row::new(
                PROJECTION,
                extreme,
                "what a row's probabilities sum to changes by",
                MASS_ERROR,
            ),
        ]
    };
    let [mut entry, mut mass] = rows(
        "rewards 0, 1e-45, 1, 1e30, 3.4e38, infinite; discounts 0, 1e-45, 1 - 6e-8, 1; 2, 51, 1,001 atoms; supports 1 ulp to 1e30 wide",
    );
    let supports = [
        (-10.0, 10.0),
        (1.0, 1.0f32.next_up()),
        (1e6, 1e6f32.next_up()),
        (-1e-6, 1e-6),
        (-1e6, 1e6),
        (-1.0, 1e6),
        (-1e30, 1e30),
        (0.0, 1e-45),
        (1000.0, 1001.0),
    ];
    let sizes = [0.0, 1e-45, 1e-40, 1.0, 7.3, 1e30, f32::MAX, f32::INFINITY];
    let rewards: Vec<f32> = sizes.iter().flat_map(|&x| [x, -x]).collect();
    let discounts = [0.0, 1e-45, 1e-40, 0.932, 1.0 - f32::EPSILON / 2.0, 1.0];
    for atoms in [2, 51, 1001] {
        let mut at_an_end = vec![0.0; atoms];
        at_an_end[atoms - 1] = 1.0;
        for probs in [
            vec![1.0 / atoms as f32; atoms],
            at_an_end,
            law(atoms, &mut context.rng),
        ] {
            for support in supports {
                for &reward in rewards.iter().chain(&[support.0, support.1]) {
                    for discount in discounts {
                        let probs = &probs;
                        see_projection(
                            &mut entry,
                            &mut mass,
                            &Step {
                                probs,
                                reward,
                                discount,
                                support,
                            },
                        );
                    }
                }
            }
            context.progress.advance(0)?;
        }
    }
    let [mut drawn_entry, mut drawn_mass] = rows("drawn");
    context.draw(1.0, |_, rng| {
        let atoms = rng.random_range(2..120);
        let reward = match rng.random_range(0..20) {
            0 => f32::INFINITY,
            1 => f32::NEG_INFINITY,
            _ => finite(rng),
        };
        let step = Step {
            probs: &law(atoms, rng),
            reward,
            discount: probability(rng),
            support: support(rng),
        };
        see_projection(&mut drawn_entry, &mut drawn_mass, &step);
        Ok(())
    })?;
    let no_number = no_number(context)?;
    Ok(vec![entry, mass, drawn_entry, drawn_mass, no_number])
}

/// Between two good rows, one whose return, discount or probability is no number: the batch's check refuses the first two by name, and
/// what comes here all the same must show.
fn no_number(context: &mut Context<'_>) -> anyhow::Result<Row> {
    let mut row = Row::new(
        PROJECTION,
        "return, discount or a probability is no number",
        "rows that hide it, and other rows whose bits it changes",
        0.0,
    );
    context.draw(0.1, |_, rng| {
        let atoms = rng.random_range(2..60);
        let (v_min, v_max) = support(rng);
        let mut probs: Vec<f32> = (0..3).flat_map(|_| law(atoms, rng)).collect();
        let mut rewards: [f32; 3] = std::array::from_fn(|_| finite(rng));
        let mut discounts: [f32; 3] = std::array::from_fn(|_| probability(rng));
        let (mut good, mut bad) = (vec![0.0; 3 * atoms], vec![0.0; 3 * atoms]);
        project(&probs, &rewards, &discounts, v_min, v_max, &mut good);
        let which = match rng.random_range(0..3) {
            0 => {
                rewards[1] = f32::NAN;
                "return"
            }
            1 => {
                discounts[1] = f32::NAN;
                "discount"
            }
            _ => {
                probs[atoms + rng.random_range(0..atoms)] = f32::NAN;
                "probability"
            }
        };
        project(&probs, &rewards, &discounts, v_min, v_max, &mut bad);
        let shows = bad[atoms..2 * atoms].iter().any(|p| p.is_nan());
        let kept = (0..3 * atoms)
            .filter(|at| at / atoms != 1)
            .all(|at| good[at].to_bits() == bad[at].to_bits());
        row.must(shows && kept, || {
            format!("{which}, {atoms} atoms on [{v_min:e}, {v_max:e}]")
        });
        Ok(())
    })?;
    Ok(row)
}

/// exp(x - max) / sum of a row, without a logarithm.
fn shares(row: &[f64]) -> Vec<f64> {
    let max = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = row.iter().map(|x| (x - max).exp()).collect();
    let sum = exact_sum(weights.iter().copied());
    weights.iter().map(|weight| weight / sum).collect()
}

/// Rows of logits at which a softmax may go wrong.
fn listed_logits() -> Vec<Vec<f32>> {
    let ramp = |scale: f32| -> Vec<f32> {
        (0..51)
            .map(|i| (i * 37 % 51) as f32 / 51.0 * scale - scale / 2.0)
            .collect()
    };
    let mut rows: Vec<Vec<f32>> = [0.0, 1e-45, 1e4, -1e4, 1e12, 1e38, -1e38, f32::MAX, f32::MIN]
        .iter()
        .flat_map(|&x| [vec![x; 51], vec![x; 2], vec![x; 1001]])
        .collect();
    rows.extend([1e-40f32, 1.0, 80.0, 104.0, 200.0, 1e4, 1e20, f32::MAX].map(ramp));
    let mut apart = vec![f32::MIN; 51];
    apart[17] = f32::MAX;
    rows.push(apart);
    rows
}

pub(super) fn softmax(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let row = |extreme: &str| {
        Row::new(
            SOFTMAX,
            extreme,
            "error of a probability, as a share of it (of 1.2e-38 below that)",
            ENTRY_ERROR,
        )
    };
    let see = |row: &mut Row, logits: &[f32]| {
        let mut probs = vec![f32::NAN; logits.len()];
        product_softmax(logits, &mut probs);
        let all = probs.iter().zip(shares(&widened(logits)));
        let errors = all.map(|(p, expected)| {
            (f64::from(*p) - expected).abs() / expected.max(f32::MIN_POSITIVE.into())
        });
        row.see(errors.fold(0.0, worse), || shown(logits));
    };
    let mut listed = row(
        "2, 51, 1,001 equal logits of 0, 1e-45, +-1e12, +-1e38, +-3.4e38; ramps of 1e-40 to 3.4e38",
    );
    for logits in listed_logits() {
        see(&mut listed, &logits);
    }
    let mut drawn = row("drawn");
    context.draw(1.0, |_, rng| {
        let count = rng.random_range(1..120);
        see(&mut drawn, &finites(count, rng));
        Ok(())
    })?;
    Ok(vec![listed, drawn])
}

/// The larger of two errors, and no number if either is none.
pub(super) fn worse(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() {
        f64::NAN
    } else {
        a.max(b)
    }
}

/// A batch: logits and targets [B, N].
struct Batch {
    atoms: usize,
    logits: Vec<f32>,
    target: Vec<f32>,
}

fn see_kl(loss_row: &mut Row, slope_row: &mut Row, batch: &Batch) {
    let (atoms, rows) = (batch.atoms, batch.logits.len() / batch.atoms);
    let mut gradient = vec![f32::NAN; batch.logits.len()];
    let loss = product_kl(&batch.logits, &batch.target, atoms, &mut gradient);
    let (mut terms, mut scale, mut slope) = (Vec::new(), 0.0, 0.0);
    for ((target, logits), gradient) in batch
        .target
        .chunks_exact(atoms)
        .zip(batch.logits.chunks_exact(atoms))
        .zip(gradient.chunks_exact(atoms))
    {
        let x = widened(logits);
        let max = x.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let log_sum = exact_sum(x.iter().map(|x| (x - max).exp())).ln();
        let t = widened(target);
        let mass = exact_sum(t.iter().copied());
        let there = || x.iter().zip(&t).filter(|(_, t)| **t > 0.0);
        // t ln t, t (max - x) and t ln sum apart, as their sizes are.
        terms.extend(there().map(|(_, t)| t * t.ln()));
        terms.extend(there().map(|(x, t)| t * (max - x)));
        terms.push(mass * log_sum);
        scale += 10.0 + exact_sum(there().map(|(x, t)| t * (max - x)));
        for ((g, p), t) in gradient.iter().zip(shares(&x)).zip(&t) {
            let expected = (mass * p - t) / rows as f64;
            let least = f64::from(f32::MIN_POSITIVE);
            let allowed = ENTRY_ERROR * expected.abs().max(least) + SLOPE_ERROR;
            slope = worse(slope, (f64::from(*g) - expected).abs() / allowed);
        }
    }
    let input = || format!("{rows} rows, logits {}", shown(&batch.logits));
    loss_row.see((loss * rows as f64 - exact_sum(terms)) / scale, input);
    slope_row.see(slope, input);
}

pub(super) fn kl(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let rows = |extreme: &str| {
        [
            Row::new(
                KL,
                extreme,
                "error of the loss, as a share of 10 + sum of target (max logit - logit)",
                KL_ERROR,
            ),
            Row::new(
                KL,
                extreme,
                "error of a slope, as a share of 6.1e-8 of it + 1e-15",
                1.0,
            ),
        ]
    };
    let [mut loss, mut slope] = rows(
        "2, 51, 1,001 equal logits of 0, 1e-45, +-1e12, +-1e38, +-3.4e38; ramps of 1e-40 to 3.4e38",
    );
    for logits in listed_logits() {
        let atoms = logits.len();
        let mut one_hot = vec![0.0; atoms];
        one_hot[atoms / 2] = 1.0;
        for target in [one_hot, law(atoms, &mut context.rng)] {
            let batch = Batch {
                atoms,
                logits: logits.clone(),
                target,
            };
            see_kl(&mut loss, &mut slope, &batch);
        }
    }
    let [mut drawn_loss, mut drawn_slope] = rows("drawn");
    let mut hidden = Row::new(
        KL,
        "one logit is infinite or no number",
        "cases in which the loss is finite all the same",
        0.0,
    );
    let [mut blocked_loss, mut blocked_slope] =
        rows("drawn; logits of -inf under targets of 0; targets sum to 0.5 to 1.5");
    let mut hidden_under_0 = Row::new(
        KL,
        "+inf or no number under a target of 0; a target that is no number",
        "cases in which the loss is finite all the same",
        0.0,
    );
    context.draw(1.0, |_, rng| {
        let (rows, atoms) = (rng.random_range(1..4), rng.random_range(2..60));
        let mut batch = Batch {
            atoms,
            logits: finites(rows * atoms, rng),
            target: (0..rows).flat_map(|_| law(atoms, rng)).collect(),
        };
        see_kl(&mut drawn_loss, &mut drawn_slope, &batch);
        // The same with a bad logit, under a target that is nowhere 0.
        let bad = [f32::INFINITY, f32::NEG_INFINITY, f32::NAN];
        let bad = bad.choose(rng).copied().unwrap_or(f32::NAN);
        let at = rng.random_range(0..atoms);
        batch.logits[at] = bad;
        batch.target.fill(1.0 / atoms as f32);
        let mut gradient = vec![0.0; batch.logits.len()];
        let loss = product_kl(&batch.logits, &batch.target, atoms, &mut gradient);
        hidden.must(!loss.is_finite(), || format!("{bad} at {at}"));
        // One row, in which some atoms have no probability on either side, and the first always has one.
        let mut target = law(atoms, rng);
        let mut logits = finites(atoms, rng);
        target[0] = 0.5;
        for i in 1..atoms {
            if i == at || rng.random_bool(0.3) {
                (logits[i], target[i]) = (f32::NEG_INFINITY, 0.0);
            }
        }
        let mut batch = Batch {
            atoms,
            logits,
            target,
        };
        see_kl(&mut blocked_loss, &mut blocked_slope, &batch);
        // And with what is no probability at all, in one of these places or another.
        let at = rng.random_range(1..atoms);
        let bad = match rng.random_range(0..3) {
            0 => {
                (batch.logits[at], batch.target[at]) = (f32::INFINITY, 0.0);
                "a logit of +inf"
            }
            1 => {
                (batch.logits[at], batch.target[at]) = (f32::NAN, 0.0);
                "a logit that is no number"
            }
            _ => {
                batch.target[at] = f32::NAN;
                "a target that is no number"
            }
        };
        let mut gradient = vec![0.0; atoms];
        let loss = product_kl(&batch.logits, &batch.target, atoms, &mut gradient);
        hidden_under_0.must(!loss.is_finite(), || format!("{bad} at {at} of {atoms}"));
        Ok(())
    })?;
    Ok(vec![
        loss,
        slope,
        drawn_loss,
        drawn_slope,
        hidden,
        blocked_loss,
        blocked_slope,
        hidden_under_0,
    ])
}
