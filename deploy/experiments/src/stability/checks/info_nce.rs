//! InfoNCE: the soft clip of a score, and the loss with its slopes.

use driml_learner::losses::{
    info_nce::{info_nce, slope_error},
    scores::{self, Scores},
};
use rand::Rng;

use super::c51::shares;
use crate::stability::{
    edges::{Shown, exact_sum, finite, finites, not_finite, one_of, worst},
    property::{Cases, broken},
};

/// Errors of a score and of its slope.
fn clip_errors(dot: f32, rkhs: usize, bound: f64) -> [f64; 2] {
    let (score, slope) = Scores::new(rkhs, bound).clip(dot);
    let x = f64::from(dot) / (rkhs as f64).sqrt();
    let ratio = x / bound;
    let expected = bound * ratio.tanh();
    let of_score = match expected {
        0.0 => score.abs() * f64::MAX,
        _ => (score - expected) / expected,
    };
    // Divided twice, as the square of the cosh may be too large for a float where the slope is not yet too small for one.
    let expected = 1.0 / (rkhs as f64).sqrt() / ratio.cosh() / ratio.cosh();
    let allowed = scores::slope_error(x, bound) * expected.max(scores::LEAST_SLOPE);
    [of_score, (slope - expected).abs() / allowed]
}

pub(crate) fn clip(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let see = |cases: &mut Cases<'_>, extreme, dot: f32, rkhs, bound: f64| {
        let input = format_args!("dot {dot:e}, width {rkhs}, bound {bound:e}");
        cases.see(extreme, input, clip_errors(dot, rkhs, bound))
    };
    let listed = "dot products 0 to 3.4e38, bounds 1e-30, 1e-3, 1, 20, 1e9, 1e12, 1e15, 1e17, 1e30";
    for bound in [1e-30, 1e-3, 1.0, 20.0, 1e9, 1e12, 1e15, 1e17, 1e30] {
        for dot in [0.0, 1e-45, 1e-20, 3.7, 400.0, 7e3, 1e10, 1e30, f32::MAX] {
            see(cases, listed, dot, 256, bound)?;
            see(cases, listed, -dot, 256, bound)?;
        }
    }
    for _ in cases.draws(5.0) {
        let bound = 10f64.powf(cases.rng.random_range(-30.0..=30.0));
        let (dot, rkhs) = (finite(&mut cases.rng), cases.rng.random_range(1..4096));
        see(cases, "drawn", dot, rkhs, bound)?;
    }
    Ok(())
}

/// `dots` [L, B, B] of vectors of 64 numbers.
struct Batch {
    dots: Vec<f32>,
    valid: Vec<u8>,
    bound: f64,
}

impl Batch {
    fn loss(&self) -> (f64, Vec<f32>) {
        let mut slopes = vec![f32::NAN; self.dots.len()];
        let scores = Scores::new(64, self.bound);
        let loss = info_nce(&self.dots, &self.valid, scores, &mut slopes);
        (loss, slopes)
    }

    fn bits(&self) -> (u64, Vec<u32>) {
        let (loss, slopes) = self.loss();
        (
            loss.to_bits(),
            slopes.iter().map(|slope| slope.to_bits()).collect(),
        )
    }

    /// The rows that count.
    fn there(&self) -> Vec<usize> {
        (0..self.valid.len())
            .filter(|&row| self.valid[row] != 0)
            .collect()
    }

    /// Errors of the loss and of its slopes.
    fn errors(&self) -> [f64; 2] {
        let (rows, bound, there) = (self.valid.len(), self.bound, self.there());
        let (loss, slopes) = self.loss();
        let weight = 1.0 / (there.len() * self.dots.len() / (rows * rows)).max(1) as f64;
        let (mut losses, mut largest) = (Vec::new(), 0.0f64);
        let mut expected = vec![0.0; slopes.len()];
        for (at, row) in self.dots.chunks_exact(rows).enumerate() {
            let anchor = at % rows;
            if self.valid[anchor] == 0 {
                continue;
            }
            let ratio = |j: usize| f64::from(row[j]) / 8.0 / bound;
            let score = |j: usize| bound * ratio(j).tanh();
            let scores: Vec<f64> = there.iter().map(|&j| score(j)).collect();
            let (shares, max, sum) = shares(&scores);
            losses.extend([sum.ln(), max - score(anchor)]);
            largest = scores
                .iter()
                .fold(largest, |most, score| most.max(score.abs()));
            for (&j, share) in there.iter().zip(shares) {
                let target = if j == anchor { 1.0 } else { 0.0 };
                let slope = (share - target) * weight / 8.0;
                expected[at * rows + j] = slope / ratio(j).cosh() / ratio(j).cosh();
            }
        }
        let of_slopes = slopes.iter().zip(expected).map(|(slope, expected)| {
            let allowed = slope_error(expected, weight, Scores::new(64, bound), largest);
            (f64::from(*slope) - expected).abs() / allowed
        });
        let of_loss = (loss - exact_sum(losses) * weight) / (10.0 + largest);
        [of_loss, worst(of_slopes)]
    }

    fn see(&self, extreme: &str, cases: &mut Cases<'_>) -> anyhow::Result<()> {
        let (rows, there, dots) = (self.valid.len(), self.there().len(), Shown(&self.dots));
        let bound = self.bound;
        let input =
            format_args!("{rows} rows, {there} of them valid, bound {bound:e}, dots {dots}");
        Ok(cases.see(extreme, input, self.errors())?)
    }
}

pub(crate) fn loss(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let listed = "2, 3, 17, 256 rows; bounds 1e-30 to 1e30; dot products all 0, all 3.4e38, 1 to 1e4, 1e30; none, one, all rows valid";
    for count in [2usize, 3, 17, 256] {
        let equal = [0.0, f32::MAX].map(|dot| vec![dot; count * count]);
        let ramps = [1.0f32, 1e4, 1e30].map(|scale| {
            let dot = |i: usize| ((i * 37 % 101) as f32 / 50.0 - 1.0) * scale;
            (0..count * count).map(dot).collect()
        });
        for bound in [1e-30, 1e-3, 1.0, 20.0, 1e6, 1e15, 1e17, 1e30] {
            for dots in equal.iter().chain(&ramps) {
                for valid in [0, 1, count] {
                    let batch = Batch {
                        dots: dots.clone(),
                        valid: (0..count).map(|row| u8::from(row < valid)).collect(),
                        bound,
                    };
                    batch.see(listed, cases)?;
                }
            }
        }
    }
    for _ in cases.draws(0.5) {
        let rng = &mut cases.rng;
        let (locations, count) = (rng.random_range(1..3), rng.random_range(1..12));
        let batch = Batch {
            dots: finites(locations * count * count, rng),
            valid: (0..count).map(|_| u8::from(rng.random_bool(0.8))).collect(),
            bound: one_of(&[1e-30, 1e-3, 1.0, 20.0, 1e6, 1e17, 1e30], rng),
        };
        batch.see("drawn", cases)?;
    }
    for _ in cases.draws(0.1) {
        see_not_finite(cases)?;
    }
    Ok(())
}

/// Dot products that are not finite: in rows that do not count, and in those that do.
fn see_not_finite(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let count = rng.random_range(2..12);
    // The first row is valid, the last is not.
    let mut valid = |row| row == 0 || (row < count - 1 && rng.random_bool(0.7));
    let valid: Vec<u8> = (0..count).map(|row| u8::from(valid(row))).collect();
    let dots = finites(count * count, rng);
    let bound = 20.0;
    let mut batch = Batch { dots, valid, bound };
    let before = batch.bits();
    for (at, dot) in batch.dots.iter_mut().enumerate() {
        if batch.valid[at / count] == 0 || batch.valid[at % count] == 0 {
            *dot = not_finite(rng);
        }
    }
    let there = batch.there();
    let at = one_of(&there, rng) * count + one_of(&there, rng);
    let mut see = |extreme, batch: &Batch, kept| {
        let input = format_args!("valid {:?}, dots {}", batch.valid, Shown(&batch.dots));
        cases.see(extreme, input, [None, None, Some(broken(kept))])
    };
    let extreme = "infinite or not a number in rows and columns that are not valid";
    see(extreme, &batch, before == batch.bits())?;
    for end in [f32::MAX, f32::MIN] {
        batch.dots[at] = end;
        let at_the_bound = batch.bits();
        batch.dots[at] = end * 2.0;
        let extreme = "an infinite dot product of two valid rows, beside 3.4e38";
        see(extreme, &batch, batch.bits() == at_the_bound)?;
    }
    batch.dots[at] = f32::NAN;
    let shows = !batch.loss().0.is_finite();
    see(
        "a dot product of two valid rows is not a number",
        &batch,
        shows,
    )?;
    Ok(())
}
