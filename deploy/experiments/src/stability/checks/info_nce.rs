//! InfoNCE: the soft clip of a score, and the loss with its slopes.

use driml_learner::losses::{
    info_nce::{LOSS_ERROR, info_nce, slope_error},
    scores::{self, CLIP_ERROR, ScoreClip},
};

use crate::stability::property::*;

const DOTS: &str =
    "dot products 0 to 3.4e38, bounds 1e-30, 1e-3, 1, 20, 1e9, 1e12, 1e15, 1e17, 1e30";
const BATCHES: &str = "2, 3, 17, 256 rows; bounds 1e-30 to 1e30; dot products all 0, all 3.4e38, 1 to 1e4, 1e30; none, one, all rows valid";
const NOT_FINITE: &str = "infinite or not a number in rows and columns that are not valid; of two valid rows infinite, beside 3.4e38, or not a number";

pub(super) fn properties() -> Vec<Property> {
    let any_rows = "dot products finite; bounds 1e-30 to 1e30; any rows valid";
    vec![
        Property::new("soft clip", "dot products finite; bounds 1e-30 to 1e30")
            .promise("a score, as a share of it", CLIP_ERROR)
            .promise("its slope, as a share of `slope_error` times it", 1.0)
            .check(DOTS, Listed, clip)
            .check("drawn", Drawn(5.0), clip),
        Property::new("InfoNCE", any_rows)
            .promise("the loss, as a share of 10 + the largest score", LOSS_ERROR)
            // `slope_error` is 1e-7 of the slope + 1e-15 + the effect of rounding the largest score.
            .promise("a slope, as a share of `slope_error`", 1.0)
            .promise("cases with other bits, or that hide it", 0.0)
            .check(BATCHES, Listed, loss)
            .check("drawn", Drawn(0.5), loss)
            .check(NOT_FINITE, Drawn(0.1), loss_of_not_finite),
    ]
}

fn clip(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let bounds = [1e-30, 1e-3, 1.0, 20.0, 1e9, 1e12, 1e15, 1e17, 1e30];
    let bound: f64 = cases.listed_or(&bounds, |rng| 10f64.powf(rng.random_range(-30.0..=30.0)));
    let dots = [0.0, 1e-45, 1e-20, 3.7, 400.0, 7e3, 1e10, 1e30, f32::MAX];
    let dot = cases.listed_or(&dots, draw_finite) * cases.listed_or(&[1.0, -1.0], |_| 1.0);
    let embedding_dim = cases.listed_or(&[256usize], |rng| rng.random_range(1..4096));
    let (score, slope) = ScoreClip::new(embedding_dim, bound).score_and_slope(dot);
    let x = f64::from(dot) / (embedding_dim as f64).sqrt();
    let ratio = x / bound;
    let expected = bound * ratio.tanh();
    let of_score = match expected {
        0.0 => score.abs() * f64::MAX,
        _ => (score - expected) / expected,
    };
    // Divide twice by cosh: its square may overflow although the slope is still representable.
    let expected = 1.0 / (embedding_dim as f64).sqrt() / ratio.cosh() / ratio.cosh();
    let allowed = scores::slope_error(x, bound) * expected.max(scores::LEAST_SLOPE);
    let of_slope = (slope - expected).abs() / allowed;
    let input = format_args!("dot {dot:e}, width {embedding_dim}, bound {bound:e}");
    cases.record_errors(input, [of_score, of_slope])
}

/// A batch of dot products `dots` [L, B, B] of vectors with 64 entries.
struct Batch {
    dots: Vec<f32>,
    valid: Vec<u8>,
    bound: f64,
}

impl Batch {
    fn loss(&self) -> (f64, Vec<f32>) {
        let mut slopes = vec![f32::NAN; self.dots.len()];
        let clip = ScoreClip::new(64, self.bound);
        (info_nce(&self.dots, &self.valid, clip, &mut slopes), slopes)
    }

    fn bits(&self) -> (u64, Vec<u32>) {
        let (loss, slopes) = self.loss();
        (loss.to_bits(), bits(&slopes))
    }

    fn valid_rows(&self) -> Vec<usize> {
        let rows = 0..self.valid.len();
        rows.filter(|&row| self.valid[row] != 0).collect()
    }

    fn errors(&self) -> [f64; 2] {
        let (rows, bound, valid) = (self.valid.len(), self.bound, self.valid_rows());
        let (loss, slopes) = self.loss();
        let weight = 1.0 / (valid.len() * self.dots.len() / (rows * rows)).max(1) as f64;
        let (mut losses, mut largest) = (Vec::new(), 0.0f64);
        let mut expected = vec![0.0; slopes.len()];
        for (at, row) in self.dots.chunks_exact(rows).enumerate() {
            let anchor = at % rows;
            if self.valid[anchor] == 0 {
                continue;
            }
            let ratio = |j: usize| f64::from(row[j]) / 8.0 / bound;
            let score = |j: usize| bound * ratio(j).tanh();
            let scores: Vec<f64> = valid.iter().map(|&j| score(j)).collect();
            let (shares, max, sum) = softmax_f64(&scores);
            losses.extend([sum.ln(), max - score(anchor)]);
            let sizes = scores.iter().map(|score| score.abs());
            largest = sizes.fold(largest, f64::max);
            for (&j, share) in valid.iter().zip(shares) {
                let target = if j == anchor { 1.0 } else { 0.0 };
                let slope = (share - target) * weight / 8.0;
                expected[at * rows + j] = slope / ratio(j).cosh() / ratio(j).cosh();
            }
        }
        let of_slopes = slopes.iter().zip(expected).map(|(slope, expected)| {
            let allowed = slope_error(expected, weight, ScoreClip::new(64, bound), largest);
            (f64::from(*slope) - expected).abs() / allowed
        });
        let of_loss = (loss - exact_sum(losses) * weight) / (10.0 + largest);
        [of_loss, max_error(of_slopes)]
    }
}

fn loss(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rows = cases.listed_or(&[2usize, 3, 17, 256], |rng| rng.random_range(1..12));
    let bound = cases.one_of(&[1e-30, 1e-3, 1.0, 20.0, 1e6, 1e15, 1e17, 1e30]);
    let equal = [0.0, f32::MAX].map(|x| vec![x; rows * rows]);
    let spread = [1.0, 1e4, 1e30].map(|scale| {
        let dot = |i: usize| ((i * 37 % 101) as f32 / 50.0 - 1.0) * scale;
        (0..rows * rows).map(dot).collect::<Vec<_>>()
    });
    let dots = cases.listed_or(&[&equal[..], &spread].concat(), |rng| {
        draw_finites(rng.random_range(1..3) * rows * rows, rng)
    });
    let first = |count: usize| (0..rows).map(|row| u8::from(row < count)).collect();
    let valid = cases.listed_or(&[first(0), first(1), first(rows)], |rng| -> Vec<u8> {
        (0..rows).map(|_| rng.random_bool(0.8).into()).collect()
    });
    let batch = Batch { dots, valid, bound };
    let (valid, dots) = (batch.valid_rows().len(), Preview(&batch.dots));
    let input = format_args!("{rows} rows, {valid} of them valid, bound {bound:e}, dots {dots}");
    cases.record_errors(input, batch.errors())
}

/// Checks dot products that are not finite, in rows that are not valid and in valid rows.
fn loss_of_not_finite(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let count = rng.random_range(2..12);
    // The first row is valid, the last is not.
    let mut valid = |row| row == 0 || (row < count - 1 && rng.random_bool(0.7));
    let valid: Vec<u8> = (0..count).map(|row| u8::from(valid(row))).collect();
    let dots = draw_finites(count * count, rng);
    let bound = 20.0;
    let mut batch = Batch { dots, valid, bound };
    let before = batch.bits();
    for (at, dot) in batch.dots.iter_mut().enumerate() {
        if batch.valid[at / count] == 0 || batch.valid[at % count] == 0 {
            *dot = draw_nonfinite(rng);
        }
    }
    record_kept(cases, &batch, batch.bits() == before)?;
    let (valid, rng) = (batch.valid_rows(), &mut cases.rng);
    let at = one_of(&valid, rng) * count + one_of(&valid, rng);
    for end in [f32::MAX, f32::MIN] {
        batch.dots[at] = end;
        let at_the_bound = batch.bits();
        batch.dots[at] = end * 2.0;
        record_kept(cases, &batch, batch.bits() == at_the_bound)?;
    }
    batch.dots[at] = f32::NAN;
    record_kept(cases, &batch, !batch.loss().0.is_finite())
}

/// Counts whether the promise about dot products that are not finite holds for this batch.
fn record_kept(cases: &mut Cases<'_>, batch: &Batch, is_kept: bool) -> anyhow::Result<()> {
    let input = format_args!("valid {:?}, dots {}", batch.valid, Preview(&batch.dots));
    cases.record_errors(input, [None, None, Some(f64::from(!is_kept))])
}
