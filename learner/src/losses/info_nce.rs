//! The InfoNCE loss over a matrix of dot products, which it scales and softly clips to scores.
//! It does not compute the dot products, and does not know which features they compare.

use candle_core::{D, DType, Result, Tensor, bail};
use candle_nn::ops::log_softmax;
use driml_model::{Kernels, exp_minus_max, soft_clip};
use rayon::prelude::*;

use super::{
    scalar_op::scalar_op,
    scores::{DotProducts, ScoreClip},
};

/// Largest error of the loss in nats, relative to 10 plus the largest score.
pub const LOSS_ERROR: f64 = 2e-14;

/// Largest error of a derivative: 1e-7 of it, about a unit in the last place of an f32, plus the error of a probability from the
/// rounding of scores up to `largest`. `weight` is 1 / (L valid rows).
pub fn slope_error(slope: f64, weight: f64, clip: ScoreClip, largest: f64) -> f64 {
    1e-7 * slope.abs() + weight * clip.scale * (1e-14 * largest).min(1.0) + 1e-15
}

/// Computes the InfoNCE of every valid row against all valid rows of the batch, at each location, and its gradient.
///
/// `dots` [L, B, B]: `dots[l, i, j]` is anchor i's dot product with candidate j at location l; the pair (i, i) is the
/// positive. `valid` [B]: a row with 0 is neither anchor nor candidate. With `s = clip(dots)` the loss is the mean over
/// l and valid i of `ln sum_{valid j} exp(s_lij) - s_lii`, in nats: 0 if fewer than two rows are valid.
/// `gradient` [L, B, B] is overwritten with the derivative by `dots`, 0 in the rows and columns that are not valid.
/// Every finite input gives a finite result. The arithmetic is f64: the loss is accurate to [`LOSS_ERROR`], its derivatives to
/// [`slope_error`].
/// Source: van den Oord et al. 2018, equation 4; the clip is Bachman et al. 2019, section 3.
///
/// # Panics
/// If the lengths disagree: the caller has checked its batch by then.
pub fn info_nce(dots: &[f32], valid: &[u8], clip: ScoreClip, gradient: &mut [f32]) -> f64 {
    let rows = valid.len();
    assert!(rows > 0, "no rows");
    let locations = dots.len() / (rows * rows);
    assert_eq!(dots.len(), locations * rows * rows, "dots [L, B, B]");
    assert_eq!(dots.len(), gradient.len(), "dots and gradient [L, B, B]");
    let candidates: Vec<usize> = (0..rows).filter(|&row| valid[row] != 0).collect();
    if candidates.is_empty() || locations == 0 {
        gradient.fill(0.0);
        return 0.0;
    }
    let count = candidates.len();
    let weight = 1.0 / (locations * count) as f64;
    let losses: Vec<f64> = dots
        .par_chunks_exact(rows)
        .zip(gradient.par_chunks_exact_mut(rows))
        .enumerate()
        .map_init(
            || Scratch {
                dots: vec![0.0; count],
                scores: vec![0.0; count],
                slopes: vec![0.0; count],
            },
            |scratch, (at, (dots, gradient))| {
                gradient.fill(0.0);
                let anchor = at % rows;
                if valid[anchor] == 0 {
                    return 0.0;
                }
                anchor_loss(dots, anchor, &candidates, clip, weight, scratch, gradient)
            },
        )
        .collect();
    // Summed in order, so that the result has the same bits whatever the threads did.
    losses.iter().sum::<f64>() * weight
}

/// Buffers for one anchor, with an entry per candidate.
struct Scratch {
    dots: Vec<f32>,
    /// First the scores, then their exponentials.
    scores: Vec<f64>,
    slopes: Vec<f64>,
}

/// Returns one anchor's `ln sum exp(s) - s_positive`; writes the derivative, times `weight`, to its row `gradient`.
fn anchor_loss(
    dots: &[f32],
    anchor: usize,
    candidates: &[usize],
    clip: ScoreClip,
    weight: f64,
    scratch: &mut Scratch,
    gradient: &mut [f32],
) -> f64 {
    for (dot, &j) in scratch.dots.iter_mut().zip(candidates) {
        *dot = dots[j];
    }
    let ScoreClip { scale, tanh_clip } = clip;
    let (values, slopes) = (&mut scratch.scores[..], &mut scratch.slopes[..]);
    soft_clip(&scratch.dots, scale, tanh_clip, values, slopes);
    let positive = candidates
        .binary_search(&anchor)
        .map_or(f64::NAN, |at| values[at]);
    let max = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    exp_minus_max(values, max);
    let sum: f64 = values.iter().sum();
    let share = 1.0 / sum;
    for ((&exp, &slope), &j) in values.iter().zip(&*slopes).zip(candidates) {
        let target = if j == anchor { 1.0 } else { 0.0 };
        gradient[j] = ((exp * share - target) * slope * weight) as f32;
    }
    sum.ln() + max - positive
}

/// [`info_nce`] as a candle operation: `dots` [L, B, B] to a scalar, with scores clipped to `tanh_clip`.
///
/// # Errors
/// Dots that are not [L, B, B] f32 with the B of `valid`.
pub fn info_nce_loss(
    dot_products: &DotProducts,
    valid: &[u8],
    tanh_clip: f64,
    kernels: Kernels,
) -> Result<Tensor> {
    let clip = ScoreClip::new(dot_products.width, tanh_clip);
    let dots = &dot_products.values;
    let (_, anchors, candidates) = dots.dims3()?;
    let rows = valid.len();
    if anchors != rows || candidates != rows {
        bail!("scores of {anchors} anchors and {candidates} candidates meet {rows} rows");
    }
    if kernels == Kernels::Candle {
        return info_nce_by_candle(dots, valid, clip);
    }
    let valid = valid.to_vec();
    scalar_op("info-nce", dots, move |dots, gradient| {
        info_nce(dots, &valid, clip, gradient)
    })
}

/// [`info_nce_loss`] by candle's own operations, for devices that this project has no kernels for. Scores beyond about 8 times the clip
/// have derivative 0, which is `1 - tanh^2` in f32.
fn info_nce_by_candle(dots: &Tensor, valid: &[u8], clip: ScoreClip) -> Result<Tensor> {
    let device = dots.device();
    let rows = (0..).zip(valid);
    let rows = rows.filter_map(|(row, &valid)| (valid != 0).then_some(row));
    let rows: Vec<u32> = rows.collect();
    let count = rows.len();
    let locations = dots.dim(0)?;
    if count == 0 || locations == 0 {
        return Tensor::zeros((), DType::F32, device);
    }
    let dots = if count == valid.len() {
        dots.clone()
    } else {
        let rows = Tensor::from_vec(rows, count, device)?;
        let anchors = dots.contiguous()?.index_select(&rows, 1)?;
        anchors.index_select(&rows, 2)?
    };
    let bound = clip.tanh_clip;
    let scores = dots.affine(clip.scale / bound, 0.0)?.tanh()?;
    let log_p = log_softmax(&scores.affine(bound, 0.0)?, D::Minus1)?;
    let positive = Tensor::eye(count, DType::F32, device)?;
    log_p
        .broadcast_mul(&positive)?
        .sum_all()?
        .affine(-1.0 / (locations * count) as f64, 0.0)
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    const LOCATIONS: usize = 2;
    const ROWS: usize = 3;
    const WIDTH: usize = 16;

    /// Includes the bounds of the clip's range. `driml experiment stability` checks the loss and the gradient of the function itself.
    #[test]
    fn the_operations_give_the_function_and_its_slopes() -> Result<()> {
        let dot = |i: usize| ((i * 37 % 19) as f32 - 9.0) * 3.0;
        let dots: Vec<f32> = (0..LOCATIONS * ROWS * ROWS).map(dot).collect();
        let cases = [[1, 1, 1], [1, 0, 1], [0, 1, 0], [0, 0, 0]].map(|valid| (valid, 20.0));
        let clips = [1e-30, 1e-6, 1e6, 1e15, 1e30].map(|tanh_clip| ([1; ROWS], tanh_clip));
        for (valid, tanh_clip) in cases.into_iter().chain(clips) {
            let clip = ScoreClip::new(WIDTH, tanh_clip);
            let mut slopes = vec![f32::NAN; dots.len()];
            let expected = info_nce(&dots, &valid, clip, &mut slopes);
            for kernels in [Kernels::FUSED, Kernels::Candle] {
                let case = format!("{kernels:?} {valid:?} {tanh_clip}");
                let var = Var::from_slice(&dots, (LOCATIONS, ROWS, ROWS), &Device::Cpu)?;
                let dot_products = DotProducts {
                    values: var.as_tensor().clone(),
                    width: WIDTH,
                };
                let loss = info_nce_loss(&dot_products, &valid, tanh_clip, kernels)?;
                let grads = loss.affine(2.0, 0.0)?.backward()?;
                let loss = loss.to_scalar::<f32>()?;
                let error = f64::from(loss) - expected;
                assert!(error.abs() < 1e-5, "{case}: {error}");
                let found = match grads.get(&var) {
                    Some(found) => found.flatten_all()?.to_vec1::<f32>()?,
                    None => vec![0.0; slopes.len()],
                };
                if kernels == Kernels::FUSED {
                    let doubled: Vec<_> = slopes.iter().map(|it| it * 2.0).collect();
                    assert_eq!((loss, &found), (expected as f32, &doubled), "{case}");
                }
                for (found, slope) in found.iter().zip(&slopes) {
                    let error = (found / 2.0 - slope).abs();
                    assert!(error < 1e-6, "{case}: {found}, {slope}");
                }
            }
        }
        Ok(())
    }
}
