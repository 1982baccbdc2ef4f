//! InfoNCE: the soft clip of a score, and the loss with its slopes.

use driml_learner::losses::{
    info_nce::{LOSS_ERROR, info_nce, slope_error},
    scores::{self, CLIP_ERROR, Scores},
};
use rand::Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{exact_sum, finite, finites, shown},
    routines::losses::worse,
};

const CLIP: Routine = Routine {
    name: "soft clip",
    range: "dot products finite; bounds 1e-30 to 1e30",
};
const INFO_NCE: Routine = Routine {
    name: "InfoNCE",
    range: "dot products finite; bounds 1e-30 to 1e30; any rows valid",
};

pub(super) fn clip(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let rows = |extreme: &str| {
        [
            Row::new(
                CLIP,
                extreme,
                "error of a score, as a share of it",
                CLIP_ERROR,
            ),
            Row::new(
                CLIP,
                extreme,
                "error of its slope, as a share of 2e-15 + 2e-15 |score| / bound times it",
                1.0,
            ),
        ]
    };
    let see = |score_row: &mut Row, slope_row: &mut Row, dot: f32, rkhs: usize, bound: f64| {
        let scores = Scores::new(rkhs, bound);
        let (score, slope) = scores.clip(dot);
        let x = f64::from(dot) / (rkhs as f64).sqrt();
        let ratio = x / bound;
        let input = || format!("dot {dot:e}, width {rkhs}, bound {bound:e}");
        let expected = bound * ratio.tanh();
        let error = if expected == 0.0 {
            score.abs() * f64::MAX
        } else {
            (score - expected) / expected
        };
        score_row.see(error, input);
        // Divided twice, as the square of the cosh may be too large for a float where the slope is not yet too small for one.
        let expected = 1.0 / (rkhs as f64).sqrt() / ratio.cosh() / ratio.cosh();
        let allowed = scores::slope_error(x, bound) * expected.max(scores::LEAST_SLOPE);
        slope_row.see((slope - expected).abs() / allowed, input);
    };
    let [mut score, mut slope] =
        rows("dot products 0 to 3.4e38, bounds 1e-30, 1e-3, 1, 20, 1e9, 1e12, 1e15, 1e17, 1e30");
    for bound in [1e-30, 1e-3, 1.0, 20.0, 1e9, 1e12, 1e15, 1e17, 1e30] {
        for dot in [0.0, 1e-45, 1e-20, 3.7, 400.0, 7e3, 1e10, 1e30, f32::MAX] {
            for dot in [dot, -dot] {
                see(&mut score, &mut slope, dot, 256, bound);
            }
        }
    }
    let [mut drawn_score, mut drawn_slope] = rows("drawn");
    context.draw(5.0, |_, rng| {
        let bound = 10f64.powf(rng.random_range(-30.0..=30.0));
        let (dot, rkhs) = (finite(rng), rng.random_range(1..4096));
        see(&mut drawn_score, &mut drawn_slope, dot, rkhs, bound);
        Ok(())
    })?;
    Ok(vec![score, slope, drawn_score, drawn_slope])
}

/// `dots` [L, B, B] of vectors of 64 numbers.
struct Batch {
    dots: Vec<f32>,
    valid: Vec<u8>,
    bound: f64,
}

fn see(loss_row: &mut Row, slope_row: &mut Row, batch: &Batch) {
    let (rows, bound) = (batch.valid.len(), batch.bound);
    let scores = Scores::new(64, bound);
    let mut gradient = vec![f32::NAN; batch.dots.len()];
    let loss = info_nce(&batch.dots, &batch.valid, scores, &mut gradient);
    let there: Vec<usize> = (0..rows).filter(|&row| batch.valid[row] != 0).collect();
    let terms = there.len() * batch.dots.len() / (rows * rows);
    let weight = 1.0 / terms.max(1) as f64;
    let (mut losses, mut largest) = (Vec::new(), 0.0f64);
    let mut slopes = vec![0.0; batch.dots.len()];
    for (at, row) in batch.dots.chunks_exact(rows).enumerate() {
        let anchor = at % rows;
        if batch.valid[anchor] == 0 {
            continue;
        }
        let ratio = |j: usize| f64::from(row[j]) / 8.0 / bound;
        let score = |j: usize| bound * ratio(j).tanh();
        let max = there
            .iter()
            .map(|&j| score(j))
            .fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = there.iter().map(|&j| (score(j) - max).exp()).collect();
        let sum = exact_sum(weights.iter().copied());
        losses.extend([sum.ln(), max - score(anchor)]);
        for (&j, exp) in there.iter().zip(&weights) {
            largest = largest.max(score(j).abs());
            let target = if j == anchor { 1.0 } else { 0.0 };
            slopes[at * rows + j] =
                (exp / sum - target) * weight / 8.0 / ratio(j).cosh() / ratio(j).cosh();
        }
    }
    let input = || {
        format!(
            "{rows} rows, {} of them valid, bound {bound:e}, dots {}",
            there.len(),
            shown(&batch.dots)
        )
    };
    let error = loss - exact_sum(losses) * weight;
    loss_row.see(error / (10.0 + largest), input);
    let each = gradient.iter().zip(&slopes).map(|(g, expected)| {
        let allowed = slope_error(*expected, weight, scores, largest);
        (f64::from(*g) - expected).abs() / allowed
    });
    slope_row.see(each.fold(0.0, worse), input);
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let rows = |extreme: &str| {
        [
            Row::new(
                INFO_NCE,
                extreme,
                "error of the loss, as a share of 10 + the largest score",
                LOSS_ERROR,
            ),
            Row::new(
                INFO_NCE,
                extreme,
                "error of a slope, as a share of 1e-7 of it + 1e-15 + what the rounding of the largest score leaves open",
                1.0,
            ),
        ]
    };
    let [mut loss, mut slope] = rows(
        "2, 3, 17, 256 rows; bounds 1e-30 to 1e30; dot products all 0, all 3.4e38, 1 to 1e4, 1e30; none, one, all rows valid",
    );
    for count in [2usize, 3, 17, 256] {
        let dots = |scale: f32| -> Vec<f32> {
            let each = (0..count * count).map(|i| ((i * 37 % 101) as f32 / 50.0 - 1.0) * scale);
            each.collect()
        };
        let kinds = [
            vec![0.0; count * count],
            vec![f32::MAX; count * count],
            dots(1.0),
            dots(1e4),
            dots(1e30),
        ];
        for bound in [1e-30, 1e-3, 1.0, 20.0, 1e6, 1e15, 1e17, 1e30] {
            for dots in &kinds {
                for valid in [0, 1, count] {
                    let batch = Batch {
                        dots: dots.clone(),
                        valid: (0..count).map(|row| u8::from(row < valid)).collect(),
                        bound,
                    };
                    see(&mut loss, &mut slope, &batch);
                }
            }
            context.progress.advance(0)?;
        }
    }
    let [mut drawn_loss, mut drawn_slope] = rows("drawn");
    context.draw(0.5, |_, rng| {
        let (locations, count) = (rng.random_range(1..3), rng.random_range(1..12));
        let bounds = [1e-30, 1e-3, 1.0, 20.0, 1e6, 1e17, 1e30];
        let batch = Batch {
            dots: finites(locations * count * count, rng),
            valid: (0..count).map(|_| u8::from(rng.random_bool(0.8))).collect(),
            bound: bounds[rng.random_range(0..bounds.len())],
        };
        see(&mut drawn_loss, &mut drawn_slope, &batch);
        Ok(())
    })?;
    let [invalid, endless, no_number] = not_finite(context)?;
    Ok(vec![
        loss,
        slope,
        drawn_loss,
        drawn_slope,
        invalid,
        endless,
        no_number,
    ])
}

/// The loss, and the bits of its slopes.
fn bits(dots: &[f32], valid: &[u8]) -> (f64, Vec<u32>) {
    let mut gradient = vec![f32::NAN; dots.len()];
    let loss = info_nce(dots, valid, Scores::new(64, 20.0), &mut gradient);
    (loss, gradient.iter().map(|slope| slope.to_bits()).collect())
}

/// Dot products that are not finite: in rows that do not count, and in those that do.
fn not_finite(context: &mut Context<'_>) -> anyhow::Result<[Row; 3]> {
    let row = |extreme: &str, promise: &str| Row::new(INFO_NCE, extreme, promise, 0.0);
    let mut invalid = row(
        "no number or infinite in rows and columns that are not valid",
        "cases in which the loss or a slope has other bits for it",
    );
    let mut endless = row(
        "an infinite dot product of two valid rows",
        "cases in which the loss or a slope has other bits than at 3.4e38, where a score is at its bound",
    );
    let mut no_number = row(
        "a dot product of two valid rows is no number",
        "cases in which the loss is finite all the same",
    );
    context.draw(0.1, |_, rng| {
        let count = rng.random_range(2..12);
        // The first row is valid, the last is not.
        let valid: Vec<u8> = (0..count)
            .map(|row| u8::from(row == 0 || (row < count - 1 && rng.random_bool(0.7))))
            .collect();
        let dots = finites(count * count, rng);
        let before = bits(&dots, &valid);
        let mut other = dots.clone();
        for (at, dot) in other.iter_mut().enumerate() {
            if valid[at / count] == 0 || valid[at % count] == 0 {
                *dot = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][rng.random_range(0..3)];
            }
        }
        let input = || format!("valid {valid:?}, dots {}", shown(&dots));
        let after = bits(&other, &valid);
        invalid.must(
            before.0.to_bits() == after.0.to_bits() && before.1 == after.1,
            input,
        );
        let there: Vec<usize> = (0..count).filter(|&row| valid[row] != 0).collect();
        let (i, j) = (
            there[rng.random_range(0..there.len())],
            there[rng.random_range(0..there.len())],
        );
        let mut with = |dot: f32| {
            other[i * count + j] = dot;
            bits(&other, &valid)
        };
        for (large, without_end) in [(f32::MAX, f32::INFINITY), (f32::MIN, f32::NEG_INFINITY)] {
            let (large, without_end) = (with(large), with(without_end));
            endless.must(
                large.0.to_bits() == without_end.0.to_bits() && large.1 == without_end.1,
                input,
            );
        }
        no_number.must(!with(f32::NAN).0.is_finite(), input);
        Ok(())
    })?;
    Ok([invalid, endless, no_number])
}
