//! C51's losses: projection, softmax, and the divergence with its slopes.

use driml_learner::losses::{
    c51::{self, ENTRY_ERROR, SLOPE_ERROR},
    projection::{entry_error, project},
};
use rand::Rng;

use crate::stability::{
    edges::{
        SUPPORTS, Shown, exact_sum, finite, finites, law, not_finite, off, probability, support,
        widened, worst,
    },
    property::{Cases, broken},
};

const PROJECTIONS: &str = "rewards 0, 1e-45, 1, 1e30, 3.4e38, infinite; discounts 0, 1e-45, 1 - 6e-8, 1; 2, 51, 1,001 atoms; supports 1 ulp to 1e30 wide";
const LOGITS: &str =
    "2, 51, 1,001 equal logits of 0, 1e-45, +-1e12, +-1e38, +-3.4e38; ramps of 1e-40 to 3.4e38";

/// Rows on one support: return distributions [B, N], rewards and discounts.
struct Step {
    probs: Vec<f32>,
    rewards: Vec<f32>,
    discounts: Vec<f32>,
    support: (f32, f32),
}

impl Step {
    fn projected(&self) -> Vec<f32> {
        let mut out = vec![f32::NAN; self.probs.len()];
        let (low, high) = self.support;
        project(
            &self.probs,
            &self.rewards,
            &self.discounts,
            low,
            high,
            &mut out,
        );
        out
    }

    /// Errors of the first row's probabilities and of their sum. Each atom lands as the height of the hats of the atoms beside it: 1
    /// at an atom, 0 at its neighbours.
    fn errors(&self) -> [f64; 2] {
        let (atoms, out) = (self.probs.len(), self.projected());
        let last = (atoms - 1) as f64;
        let [reward, discount] = [self.rewards[0], self.discounts[0]].map(f64::from);
        let (low, high) = (f64::from(self.support.0), f64::from(self.support.1));
        let width = high - low;
        let mut hats = vec![0.0; atoms];
        for (i, &p) in self.probs.iter().enumerate() {
            let moved = reward + discount * (low + width * (i as f64 / last));
            let place = (moved.clamp(low, high) - low) / width * last;
            let first = (place as usize).saturating_sub(1);
            for (j, sum) in hats.iter_mut().enumerate().skip(first).take(3) {
                *sum += f64::from(p) * (1.0 - (place - j as f64).abs()).max(0.0);
            }
        }
        let allowed = entry_error(atoms, self.support.0, self.support.1);
        let errors = out.iter().zip(hats).map(|(&p, expected)| match p {
            0.0..=f32::MAX => (f64::from(p) - expected).abs() / allowed,
            _ => f64::NAN,
        });
        let sum = |values: &[f32]| exact_sum(widened(values));
        [worst(errors), sum(&out) - sum(&self.probs)]
    }

    fn see(&self, extreme: &str, cases: &mut Cases<'_>) -> anyhow::Result<()> {
        let (reward, discount) = (self.rewards[0], self.discounts[0]);
        let (atoms, (low, high)) = (self.probs.len(), self.support);
        let input = format_args!(
            "reward {reward:e}, discount {discount:e}, {atoms} atoms on [{low:e}, {high:e}]"
        );
        Ok(cases.see(extreme, input, self.errors())?)
    }
}

pub(crate) fn projection(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let sizes = [0.0, 1e-45, 1e-40, 1.0, 7.3, 1e30, f32::MAX, f32::INFINITY];
    for atoms in [2, 51, 1001] {
        let mut at_an_end = vec![0.0; atoms];
        at_an_end[atoms - 1] = 1.0;
        let even = vec![1.0 / atoms as f32; atoms];
        for probs in [even, at_an_end, law(atoms, &mut cases.rng)] {
            for support in SUPPORTS {
                let rewards = sizes.iter().flat_map(|&x| [x, -x]);
                for reward in rewards.chain([support.0, support.1]) {
                    for discount in [0.0, 1e-45, 1e-40, 0.932, 1.0 - f32::EPSILON / 2.0, 1.0] {
                        let step = Step {
                            probs: probs.clone(),
                            rewards: vec![reward],
                            discounts: vec![discount],
                            support,
                        };
                        step.see(PROJECTIONS, cases)?;
                    }
                }
            }
        }
    }
    for _ in cases.draws(1.0) {
        let rng = &mut cases.rng;
        let atoms = rng.random_range(2..120);
        let reward = match rng.random_range(0..20) {
            0 => f32::INFINITY,
            1 => f32::NEG_INFINITY,
            _ => finite(rng),
        };
        let step = Step {
            probs: law(atoms, rng),
            rewards: vec![reward],
            discounts: vec![probability(rng)],
            support: support(rng),
        };
        step.see("drawn", cases)?;
    }
    // Between two good rows, one that the batch's check would refuse: what comes here all the same must show.
    for _ in cases.draws(0.1) {
        let rng = &mut cases.rng;
        let atoms = rng.random_range(2..60);
        let mut step = Step {
            support: support(rng),
            probs: (0..3).flat_map(|_| law(atoms, rng)).collect(),
            rewards: (0..3).map(|_| finite(rng)).collect(),
            discounts: (0..3).map(|_| probability(rng)).collect(),
        };
        let good = step.projected();
        let which = rng.random_range(0..3);
        match which {
            0 => step.rewards[1] = f32::NAN,
            1 => step.discounts[1] = f32::NAN,
            _ => step.probs[atoms + rng.random_range(0..atoms)] = f32::NAN,
        }
        let bad = step.projected();
        let shows = bad[atoms..2 * atoms].iter().any(|p| p.is_nan());
        let mut others = (0..3 * atoms).filter(|at| at / atoms != 1);
        let kept = shows && others.all(|at| good[at].to_bits() == bad[at].to_bits());
        let name = ["return", "discount", "probability"][which];
        let input = format_args!("{name}, {atoms} atoms on {:?}", step.support);
        let extreme = "return, discount or a probability is not a number";
        cases.see(extreme, input, [None, None, Some(broken(kept))])?;
    }
    Ok(())
}

/// exp(x - max) / sum of a row, without a logarithm; the largest, and the sum.
pub(super) fn shares(row: &[f64]) -> (Vec<f64>, f64, f64) {
    let max = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = row.iter().map(|x| (x - max).exp()).collect();
    let sum = exact_sum(weights.iter().copied());
    let shares = weights.iter().map(|weight| weight / sum);
    (shares.collect(), max, sum)
}

/// Rows of logits at which a softmax may go wrong.
fn listed_logits() -> Vec<Vec<f32>> {
    let ramp = |scale: f32| -> Vec<f32> {
        let place = |i: u16| f32::from(i * 37 % 51) / 51.0;
        (0..51).map(|i| place(i) * scale - scale / 2.0).collect()
    };
    let equal = [0.0, 1e-45, 1e4, -1e4, 1e12, 1e38, -1e38, f32::MAX, f32::MIN];
    let equal = equal
        .iter()
        .flat_map(|&x| [51, 2, 1001].map(|atoms| vec![x; atoms]));
    let ramps = [1e-40f32, 1.0, 80.0, 104.0, 200.0, 1e4, 1e20, f32::MAX].map(ramp);
    let mut apart = vec![f32::MIN; 51];
    apart[17] = f32::MAX;
    equal.chain(ramps).chain([apart]).collect()
}

pub(crate) fn softmax(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let error = |logits: &[f32]| {
        let mut probs = vec![f32::NAN; logits.len()];
        c51::softmax(logits, &mut probs);
        let (expected, ..) = shares(&widened(logits));
        worst(
            probs
                .iter()
                .zip(expected)
                .map(|(&p, expected)| off(p, expected)),
        )
    };
    for logits in listed_logits() {
        cases.see(LOGITS, format_args!("{}", Shown(&logits)), [error(&logits)])?;
    }
    for _ in cases.draws(1.0) {
        let count = cases.rng.random_range(1..120);
        let logits = finites(count, &mut cases.rng);
        cases.see(
            "drawn",
            format_args!("{}", Shown(&logits)),
            [error(&logits)],
        )?;
    }
    Ok(())
}

/// Logits and targets [B, N].
struct Batch {
    atoms: usize,
    logits: Vec<f32>,
    target: Vec<f32>,
}

impl Batch {
    fn loss(&self, gradient: &mut [f32]) -> f64 {
        c51::kl(&self.logits, &self.target, self.atoms, gradient)
    }

    /// Errors of the loss and of its slopes.
    fn errors(&self) -> [f64; 2] {
        let mut gradient = vec![f32::NAN; self.logits.len()];
        let loss = self.loss(&mut gradient);
        let rows = (self.logits.len() / self.atoms) as f64;
        let (mut terms, mut scale, mut slopes) = (Vec::new(), 0.0, Vec::new());
        let logits = self.logits.chunks_exact(self.atoms);
        let gradients = gradient.chunks_exact(self.atoms);
        for ((target, logits), gradient) in self
            .target
            .chunks_exact(self.atoms)
            .zip(logits)
            .zip(gradients)
        {
            let (x, t) = (widened(logits), widened(target));
            let (probs, max, sum) = shares(&x);
            let mass = exact_sum(t.iter().copied());
            let there = || x.iter().zip(&t).filter(|(_, t)| **t > 0.0);
            // t ln t, t (max - x) and t ln sum apart, as their sizes are.
            terms.extend(there().map(|(_, t)| t * t.ln()));
            terms.extend(there().map(|(x, t)| t * (max - x)));
            terms.push(mass * sum.ln());
            scale += 10.0 + exact_sum(there().map(|(x, t)| t * (max - x)));
            slopes.extend(gradient.iter().zip(probs).zip(&t).map(|((g, p), t)| {
                let expected = (mass * p - t) / rows;
                let least = f64::from(f32::MIN_POSITIVE);
                let allowed = ENTRY_ERROR * expected.abs().max(least) + SLOPE_ERROR;
                (f64::from(*g) - expected).abs() / allowed
            }));
        }
        [(loss * rows - exact_sum(terms)) / scale, worst(slopes)]
    }

    fn see(&self, extreme: &str, cases: &mut Cases<'_>) -> anyhow::Result<()> {
        let rows = self.logits.len() / self.atoms;
        let input = format_args!("{rows} rows, logits {}", Shown(&self.logits));
        Ok(cases.see(extreme, input, self.errors())?)
    }

    /// Whether what is not a number in the first row, at this atom, shows in the loss.
    fn see_spoilt(&self, extreme: &str, at: usize, cases: &mut Cases<'_>) -> anyhow::Result<()> {
        let shows = !self.loss(&mut vec![0.0; self.logits.len()]).is_finite();
        let (logit, target) = (self.logits[at], self.target[at]);
        let input = format_args!("logit {logit} under {target} at {at} of {}", self.atoms);
        Ok(cases.see(extreme, input, [None, None, Some(broken(shows))])?)
    }
}

pub(crate) fn kl(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for logits in listed_logits() {
        let atoms = logits.len();
        let mut one_hot = vec![0.0; atoms];
        one_hot[atoms / 2] = 1.0;
        for target in [one_hot, law(atoms, &mut cases.rng)] {
            let logits = logits.clone();
            Batch {
                atoms,
                logits,
                target,
            }
            .see(LOGITS, cases)?;
        }
    }
    for _ in cases.draws(1.0) {
        let rng = &mut cases.rng;
        let (rows, atoms) = (rng.random_range(1..4), rng.random_range(2..60));
        let mut batch = Batch {
            atoms,
            logits: finites(rows * atoms, rng),
            target: (0..rows).flat_map(|_| law(atoms, rng)).collect(),
        };
        batch.see("drawn", cases)?;
        // The same with a bad logit, under a target that is nowhere 0.
        let rng = &mut cases.rng;
        let at = rng.random_range(0..atoms);
        batch.logits[at] = not_finite(rng);
        batch.target.fill(1.0 / atoms as f32);
        batch.see_spoilt("one logit is infinite or not a number", at, cases)?;
        // One row, in which some atoms have no probability on either side, and the first always has one.
        let rng = &mut cases.rng;
        let mut batch = Batch {
            atoms,
            target: law(atoms, rng),
            logits: finites(atoms, rng),
        };
        batch.target[0] = 0.5;
        for i in 1..atoms {
            if i == at || rng.random_bool(0.3) {
                (batch.logits[i], batch.target[i]) = (f32::NEG_INFINITY, 0.0);
            }
        }
        let extreme = "drawn; logits of -inf under targets of 0; targets sum to 0.5 to 1.5";
        batch.see(extreme, cases)?;
        // And with what is not a probability, in one of these places or another.
        let at = cases.rng.random_range(1..atoms);
        match cases.rng.random_range(0..3) {
            0 => (batch.logits[at], batch.target[at]) = (f32::INFINITY, 0.0),
            1 => (batch.logits[at], batch.target[at]) = (f32::NAN, 0.0),
            _ => batch.target[at] = f32::NAN,
        }
        let extreme = "+inf, or not a number, under a target of 0; a target that is not a number";
        batch.see_spoilt(extreme, at, cases)?;
    }
    Ok(())
}
