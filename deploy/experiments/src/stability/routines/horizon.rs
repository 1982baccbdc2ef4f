//! The draw of k along the stored actions: each step's probability by itself, and the law of k.

use driml_protocol::AffinityUpdate;
use driml_replay_server::horizon::{
    Affinity,
    nhg::{GO_ON_ERROR, draw_k},
};
use rand::{Rng, RngCore};

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{exact_sum, probability},
};

const NHG: Routine = Routine {
    name: "k by NHG",
    range: "A 0 to 1; k_max 1 to 1,000",
};

/// Gives every value that a float can be drawn as, one after the other.
struct EveryFloat(u32);

impl RngCore for EveryFloat {
    fn next_u32(&mut self) -> u32 {
        self.0 = self.0.wrapping_add(1 << 8);
        self.0
    }

    fn next_u64(&mut self) -> u64 {
        u64::from(self.next_u32())
    }

    fn fill_bytes(&mut self, bytes: &mut [u8]) {
        bytes.fill(0);
    }
}

fn affinity(num_actions: u32, matrix: Vec<f32>) -> anyhow::Result<Affinity> {
    let mut affinity = Affinity::uniform(num_actions);
    affinity.update(&AffinityUpdate {
        learner: 1,
        version: 1,
        num_actions,
        matrix,
    })?;
    Ok(affinity)
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut row = Row::new(
        NHG,
        "A 0, 1e-45, 1e-9, 0.5, 1 - 6e-8, 1 and drawn; all 2^24 values that a draw can have",
        "distance of the probability to go on from A",
        GO_ON_ERROR,
    );
    let mut probabilities = vec![0.0, -0.0, 1e-45, 1e-9, 0.5, 1.0 - f32::EPSILON / 2.0, 1.0];
    for _ in 0..context.settings.whole_draws {
        probabilities.push(probability(&mut context.rng));
    }
    for a in probabilities {
        let affinity = affinity(1, vec![a])?;
        let mut every = EveryFloat(0);
        let draws = 1u32 << 24;
        let on = (0..draws).filter(|_| draw_k(&affinity, &[0, 0], &mut every) == 2);
        let found = on.count() as f64 / f64::from(draws);
        // Certain is certain, and impossible impossible.
        let error = if (a == 0.0 && found != 0.0) || (a == 1.0 && found != 1.0) {
            f64::MAX
        } else {
            found - f64::from(a)
        };
        row.see(error, || format!("A = {a:e}: {found}"));
        context.progress.advance(0)?;
    }
    Ok(vec![row, law(context)?])
}

/// P(k = i) for i = 1, .., H along this walk.
fn law_of(a: &[f32]) -> Vec<f64> {
    let mut reached = 1.0;
    let mut law = Vec::new();
    for &a in a {
        law.push(reached * (1.0 - f64::from(a)));
        reached *= f64::from(a);
    }
    law.push(reached);
    law
}

/// How far counts are from a law, in standard deviations of a normal of the same tail; cells that expect less than 5 are one.
///
/// Pearson's chi-square by the cube root of Wilson and Hilferty 1931. Infinite where something was seen that cannot be.
pub(super) fn deviations(counts: &[u64], law: &[f64]) -> f64 {
    let total = counts.iter().sum::<u64>() as f64;
    let (mut cells, mut few) = (Vec::new(), (0.0, 0.0));
    for (&count, &p) in counts.iter().zip(law) {
        if p == 0.0 && count > 0 {
            return f64::INFINITY;
        }
        if total * p < 5.0 {
            few = (few.0 + count as f64, few.1 + total * p);
        } else {
            cells.push((count as f64, total * p));
        }
    }
    if few.1 >= 5.0 {
        cells.push(few);
    }
    let degrees = cells.len().saturating_sub(1) as f64;
    if degrees == 0.0 {
        return 0.0;
    }
    let square = exact_sum(
        cells
            .iter()
            .map(|(have, want)| (have - want).powi(2) / want),
    );
    let spread = 2.0 / (9.0 * degrees);
    ((square / degrees).cbrt() - (1.0 - spread)) / spread.sqrt()
}

/// Deviations that one right law in two million passes.
pub(super) const DEVIATIONS: f64 = 5.0;

fn law(context: &mut Context<'_>) -> anyhow::Result<Row> {
    let draws = context.settings.law_draws;
    let mut row = Row::new(
        NHG,
        "H 1, 2, 5, 50, 255, 1,000; A 0, 1e-9, 0.5, 0.99, 1 - 6e-8, 1, and drawn",
        "deviations of a chi-square from the law of k",
        DEVIATIONS,
    );
    for steps in [1usize, 2, 5, 50, 255, 1000] {
        for kind in 0..8 {
            let same = [0.0, 1e-9, 0.5, 0.99, 1.0 - f32::EPSILON / 2.0, 1.0];
            let draw = |rng: &mut rand_chacha::ChaCha8Rng| match same.get(kind) {
                Some(&a) => a,
                None if kind == 6 => rng.random(),
                None => probability(rng),
            };
            let matrix: Vec<f32> = (0..16).map(|_| draw(&mut context.rng)).collect();
            let actions: Vec<u8> = (0..steps).map(|_| context.rng.random_range(0..4)).collect();
            let walk: Vec<f32> = actions
                .windows(2)
                .map(|pair| matrix[usize::from(pair[0]) * 4 + usize::from(pair[1])])
                .collect();
            let affinity = affinity(4, matrix)?;
            let mut counts = vec![0u64; steps];
            for _ in 0..draws / 10 {
                let k = draw_k(&affinity, &actions, &mut context.rng) as usize;
                counts[k - 1] += 1;
            }
            let found = deviations(&counts, &law_of(&walk));
            row.see(found.max(0.0), || format!("H = {steps}, kind {kind} of A"));
            context.progress.advance(0)?;
        }
    }
    Ok(row)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_law_deviates_and_a_right_one_does_not() {
        assert!(deviations(&[500, 510], &[0.5, 0.5]).abs() < 1.0);
        assert!(deviations(&[60_000, 40_000], &[0.5, 0.5]) > 10.0);
        assert!(deviations(&[1, 99], &[0.0, 1.0]).is_infinite());
    }
}
