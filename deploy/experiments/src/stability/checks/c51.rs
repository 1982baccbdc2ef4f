//! The C51 loss: projection, softmax, and the KL divergence with its slopes (gradients).

use driml_learner::losses::{
    c51::{self, ENTRY_ERROR, KL_ERROR, SLOPE_ERROR},
    projection::{MASS_ERROR, entry_error, project},
};

use crate::stability::property::*;

const STEPS: &str = "rewards 0, 1e-45, 1, 1e30, 3.4e38, infinite; discounts 0, 1e-45, 1 - 6e-8, 1; 2, 51, 1,001 atoms; supports 1 ulp to 1e30 wide";
const LOGITS: &str =
    "2, 51, 1,001 equal logits of 0, 1e-45, +-1e12, +-1e38, +-3.4e38; ramps of 1e-40 to 3.4e38";
const GAPS: &str = "drawn; logits of -inf under targets of 0; targets sum to 0.5 to 1.5";
const SPOILT: &str = "a logit infinite or not a number; the same under a target of 0, but for -inf; a target not a number";

pub(super) fn properties() -> Vec<Property> {
    let steps = "rewards any, infinite ones included; discounts 0 to 1; a support within 1e30";
    vec![
        Property::new("C51 projection", steps)
            // `entry_error` is 1e-7 + 1e-15 N max|v| / width. No probability is negative.
            .promise("a probability, as a share of `entry_error`", 1.0)
            .promise("what a row sums to, before and after", MASS_ERROR)
            .promise("rows that hide it, or change others' bits", 0.0)
            .check(STEPS, Listed, projection)
            .check("drawn", Drawn(1.0), projection)
            .check("not a number in one row", Drawn(0.1), projection_of_nan),
        Property::new("softmax", "logits finite")
            .promise("a probability, as a share of it", ENTRY_ERROR)
            .check(LOGITS, Listed, softmax)
            .check("drawn", Drawn(1.0), softmax),
        Property::new("C51 loss (KL)", "logits finite; targets sum to 1")
            // The error is a share of 10 + sum of target (max logit - logit).
            .promise("the loss, as a share of its terms", KL_ERROR)
            .promise("a slope, as a share of 6.1e-8 of it + 1e-15", 1.0)
            .promise("cases in which the loss is finite all the same", 0.0)
            .check(LOGITS, Listed, kl)
            .check("drawn", Drawn(1.0), |cases| {
                Batch::draw(&mut cases.rng).record_errors(cases)
            })
            .check(GAPS, Drawn(1.0), |cases| {
                draw_with_gaps(&mut cases.rng).record_errors(cases)
            })
            .check(SPOILT, Drawn(2.0), kl_of_a_spoilt_atom),
    ]
}

/// Projects rows `probs` [B, N] with these rewards and discounts [B] on one support.
fn project_rows(probs: &[f32], reward: &[f32], discount: &[f32], support: (f32, f32)) -> Vec<f32> {
    let mut out = vec![f32::NAN; probs.len()];
    project(probs, reward, discount, support.0, support.1, &mut out);
    out
}

fn projection(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let atoms = cases.listed_or(&[2, 51, 1001], |rng| rng.random_range(2..120));
    let support = cases.listed_or(&SUPPORTS, draw_support);
    let sizes = [0.0, 1e-45, 1e-40, 1.0, 7.3, 1e30, f32::MAX, f32::INFINITY];
    let rewards: Vec<f32> = sizes.iter().flat_map(|&x| [x, -x]).collect();
    let rewards = [rewards, vec![support.0, support.1]].concat();
    let reward = cases.listed_or(&rewards, |rng| match rng.random_range(0..20) {
        0 => f32::INFINITY,
        1 => f32::NEG_INFINITY,
        _ => draw_finite(rng),
    });
    let discounts = [0.0, 1e-45, 1e-40, 0.932, 1.0 - f32::EPSILON / 2.0, 1.0];
    let discount = cases.listed_or(&discounts, draw_probability);
    let probs = match cases.listed_or(&["even", "at an end", "any"], |_| "any") {
        "even" => vec![1.0 / atoms as f32; atoms],
        "at an end" => one_hot(atoms, atoms - 1),
        _ => draw_probs(atoms, &mut cases.rng),
    };

    // Each moved atom spreads its mass by hat functions: the hat of an atom is 1 there and 0 at its neighbours.
    let [low, high] = [support.0, support.1].map(f64::from);
    let (last, width) = ((atoms - 1) as f64, high - low);
    let mut hats = vec![0.0; atoms];
    for (i, &p) in probs.iter().enumerate() {
        let moved = f64::from(reward) + f64::from(discount) * (low + width * (i as f64 / last));
        let place = (moved.clamp(low, high) - low) / width * last;
        let first = (place as usize).saturating_sub(1);
        for (j, sum) in hats.iter_mut().enumerate().skip(first).take(3) {
            *sum += f64::from(p) * (1.0 - (place - j as f64).abs()).max(0.0);
        }
    }
    let out = project_rows(&probs, &[reward], &[discount], support);
    let allowed = entry_error(atoms, support.0, support.1);
    let errors = out.iter().zip(hats).map(|(&p, expected)| {
        let error = (f64::from(p) - expected).abs() / allowed;
        nan_unless((0.0..=f32::MAX).contains(&p), error)
    });
    let [before, after] = [&probs, &out].map(|law| exact_sum(to_f64(law)));
    let errors = [max_error(errors), after - before];
    let input = format_args!(
        "reward {reward:e}, discount {discount:e}, {atoms} atoms on [{low:e}, {high:e}]"
    );
    cases.record_errors(input, errors)
}

/// Puts a NaN row, which the batch's check would reject, between two good rows. The result must show the NaN in this row alone.
fn projection_of_nan(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let (atoms, support) = (rng.random_range(2..60), draw_support(rng));
    let mut probs: Vec<f32> = (0..3).flat_map(|_| draw_probs(atoms, rng)).collect();
    let mut rewards = [(); 3].map(|()| draw_finite(rng));
    let mut discounts = [(); 3].map(|()| draw_probability(rng));
    let good = project_rows(&probs, &rewards, &discounts, support);
    let name = one_of(&["return", "discount", "probability"], rng);
    match name {
        "return" => rewards[1] = f32::NAN,
        "discount" => discounts[1] = f32::NAN,
        _ => probs[atoms + rng.random_range(0..atoms)] = f32::NAN,
    }
    let mut bad = project_rows(&probs, &rewards, &discounts, support);
    let shows_nan = bad[atoms..2 * atoms].iter().any(|p| p.is_nan());
    bad[atoms..2 * atoms].copy_from_slice(&good[atoms..2 * atoms]);
    let input = format_args!("{name}, {atoms} atoms on {support:?}");
    let is_kept = shows_nan && bits(&good) == bits(&bad);
    cases.record_errors(input, [None, None, Some(f64::from(!is_kept))])
}

fn one_hot(atoms: usize, at: usize) -> Vec<f32> {
    let mut probs = vec![0.0; atoms];
    probs[at] = 1.0;
    probs
}

fn softmax(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let atoms = cases.listed_or(&[2, 51, 1001], |rng| rng.random_range(1..120));
    let logits = cases.listed_or(&extremes(atoms), |rng| draw_finites(atoms, rng));
    let mut probs = vec![f32::NAN; logits.len()];
    c51::softmax(&logits, &mut probs);
    let (expected, ..) = softmax_f64(&to_f64(&logits));
    let errors = probs.iter().zip(expected).map(|(&p, it)| rel_error(p, it));
    cases.record_errors(format_args!("{}", Preview(&logits)), [max_error(errors)])
}

/// Logits and targets [B, N].
struct Batch {
    atoms: usize,
    logits: Vec<f32>,
    target: Vec<f32>,
    /// The weights, one for each row; `None` means 1.
    weights: Option<Vec<f32>>,
}

impl Batch {
    fn draw(rng: &mut ChaCha8Rng) -> Self {
        let (rows, atoms) = (rng.random_range(1..4), rng.random_range(2..60));
        Self {
            atoms,
            logits: draw_finites(rows * atoms, rng),
            target: (0..rows).flat_map(|_| draw_probs(atoms, rng)).collect(),
            weights: rng
                .random::<bool>()
                .then(|| (0..rows).map(|_| draw_probability(rng)).collect()),
        }
    }

    fn kl(&self) -> (f64, Vec<f32>) {
        let (weights, mut slopes) = (self.weights.as_deref(), vec![f32::NAN; self.logits.len()]);
        let loss = c51::kl(&self.logits, &self.target, weights, self.atoms, &mut slopes);
        (loss, slopes)
    }

    fn record_errors(&self, cases: &mut Cases<'_>) -> anyhow::Result<()> {
        let rows = self.logits.len() / self.atoms;
        let (loss, gradient) = self.kl();
        let (mut terms, mut scale, mut slopes) = (Vec::new(), 0.0, Vec::new());
        for row in 0..rows {
            let weight = self.weights.as_ref().map_or(1.0, |it| f64::from(it[row]));
            let row = row * self.atoms..(row + 1) * self.atoms;
            let [x, t] = [&self.logits, &self.target].map(|all| to_f64(&all[row.clone()]));
            let (probs, max, sum) = softmax_f64(&x);
            let mass = exact_sum(t.iter().copied());
            let positive = || x.iter().zip(&t).filter(|(_, t)| **t > 0.0);
            // t ln t, t (max - x) and t ln sum are separate terms because their sizes differ.
            terms.extend(positive().map(|(_, t)| weight * t * t.ln()));
            terms.extend(positive().map(|(x, t)| weight * t * (max - x)));
            terms.push(weight * mass * sum.ln());
            scale += weight * (10.0 + exact_sum(positive().map(|(x, t)| t * (max - x))));
            slopes.extend(gradient[row].iter().zip(probs).zip(&t).map(|((g, p), t)| {
                let expected = (mass * p - t) * weight / rows as f64;
                let allowed = ENTRY_ERROR * expected.abs().max(MIN_NORMAL) + SLOPE_ERROR;
                (f64::from(*g) - expected).abs() / allowed
            }));
        }
        // The scale is 0 if all weights are 0.
        let of_loss = (loss * rows as f64 - exact_sum(terms)) / scale.max(MIN_NORMAL);
        let input = format_args!("{rows} rows, logits {}", Preview(&self.logits));
        cases.record_errors(input, [of_loss, max_error(slopes)])
    }
}

fn kl(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let atoms = cases.one_of(&[2, 51, 1001]);
    let logits = cases.one_of(&extremes(atoms));
    let target = match cases.one_of(&["one-hot", "any"]) {
        "any" => draw_probs(atoms, &mut cases.rng),
        _ => one_hot(atoms, atoms / 2),
    };
    let batch = Batch {
        atoms,
        logits,
        target,
        weights: None,
    };
    batch.record_errors(cases)
}

/// Draws a batch in which some atoms of the first row have probability 0 in logits and target. The first atom never has 0.
fn draw_with_gaps(rng: &mut ChaCha8Rng) -> Batch {
    let mut batch = Batch::draw(rng);
    batch.target[0] = 0.5;
    let gap = rng.random_range(1..batch.atoms);
    for i in 1..batch.atoms {
        if i == gap || rng.random_bool(0.3) {
            (batch.logits[i], batch.target[i]) = (f32::NEG_INFINITY, 0.0);
        }
    }
    batch
}

/// Checks that the loss shows a value that is not finite at one atom, whether its target is 0 or not.
fn kl_of_a_spoilt_atom(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let mut batch = draw_with_gaps(rng);
    let kind = rng.random_range(0..6);
    // Kinds 3 and above spare the first atom, which may be the only one left with a probability.
    let at = rng.random_range(usize::from(kind >= 3)..batch.atoms);
    (batch.logits[at], batch.target[at]) = match kind {
        0..3 => (draw_nonfinite(rng), 1.0 / batch.atoms as f32),
        3 => (f32::INFINITY, 0.0),
        4 => (f32::NAN, 0.0),
        _ => (batch.logits[at], f32::NAN),
    };
    let (logit, target) = (batch.logits[at], batch.target[at]);
    let input = format_args!("logit {logit} under {target} at {at} of {}", batch.atoms);
    let hides_it = batch.kl().0.is_finite();
    cases.record_errors(input, [None, None, Some(f64::from(hides_it))])
}
