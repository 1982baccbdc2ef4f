//! The C51 loss: KL divergence of the prediction for the taken action from a projected target.
//! It does not compute the target (`projection` does), and the target gets no gradient.

use candle_core::{D, Result, Tensor, bail};
use candle_nn::ops::log_softmax;
use driml_model::Kernels;

use super::scalar_op::scalar_op;

/// Largest relative error of a probability or of a derivative of the loss: half a unit in the last place of an f32. Below 1.2e-38,
/// the least normal number, the error is relative to 1.2e-38.
pub const ENTRY_ERROR: f64 = 6.1e-8;
/// Largest error of a derivative in addition to [`ENTRY_ERROR`], if probability and target cancel in f64.
pub const SLOPE_ERROR: f64 = 1e-15;
/// Largest error of a row's divergence, relative to `10 + sum_i target_i (max logit - logit_i)`.
pub const KL_ERROR: f64 = 1e-14;

/// Computes the mean over rows of `KL(target || softmax(logits))`, each times its weight, and the gradient of that mean.
///
/// `logits` [B, N] of the action that each row took; `target` [B, N], rows sum to 1; N is `atoms`; `weights` [B], finite and
/// not negative, or `None` for 1.
/// Loss: `1/B * sum_b weight sum_i target * (ln target - ln softmax)`, with `0 ln 0 = 0`, in nats.
/// `gradient` [B, N] is overwritten with the derivative by the logits: `weight (softmax - target) / B`. The arithmetic is f64 and
/// subtracts the largest logit, so that any finite logits work: the loss is accurate to [`KL_ERROR`], its derivatives to
/// [`ENTRY_ERROR`] and [`SLOPE_ERROR`]. The loss is beyond the finite f32 only if logits differ by more than 1e38. A logit that is not
/// finite, or a target that is NaN, gives a loss that is not finite, which the update rejects. The exception is a logit of -inf with
/// a target of 0: it adds nothing to the loss, as `0 ln 0 = 0`, and its derivative is 0.
/// Sources: Bellemare et al. 2017, equation 7; Schaul et al. 2016, Prioritized Experience Replay, algorithm 1, line 12.
///
/// # Panics
/// If the lengths disagree, or there is no row: the caller has checked its batch by then.
pub fn kl(
    logits: &[f32],
    target: &[f32],
    weights: Option<&[f32]>,
    atoms: usize,
    gradient: &mut [f32],
) -> f64 {
    let rows = logits.len() / atoms;
    let (len, weighted_rows) = (rows * atoms, weights.map_or(rows, <[f32]>::len));
    assert!(rows > 0 && logits.len() == len, "whole rows of logits");
    assert_eq!(target.len(), len, "logits and target [B, N]");
    assert_eq!(gradient.len(), len, "logits and gradient [B, N]");
    assert_eq!(weighted_rows, rows, "a weight for each row");
    let mut total = 0.0;
    for (row, ((logits, target), gradient)) in logits
        .chunks_exact(atoms)
        .zip(target.chunks_exact(atoms))
        .zip(gradient.chunks_exact_mut(atoms))
        .enumerate()
    {
        let weight = weights.map_or(1.0, |it| f64::from(it[row]));
        let log_p = LogSoftmax::new(logits);
        let mass: f64 = target.iter().map(|&t| f64::from(t)).sum();
        for ((&logit, &t), gradient) in logits.iter().zip(target).zip(gradient) {
            let (log_p, t) = (log_p.at(logit), f64::from(t));
            // Not t > 0, which would ignore a NaN.
            if t != 0.0 {
                total += weight * t * (t.ln() - log_p);
            }
            *gradient = ((mass * log_p.exp() - t) * weight / rows as f64) as f32;
        }
    }
    total / rows as f64
}

/// Computes `KL(target || softmax(logits))` of each row [B], in nats, accurate to [`KL_ERROR`]. A result below 0 by rounding is 0.
pub fn row_kls(logits: &[f32], target: &[f32], atoms: usize) -> Vec<f64> {
    let rows = logits.chunks_exact(atoms).zip(target.chunks_exact(atoms));
    let row = |(logits, target)| kl(logits, target, None, atoms, &mut vec![0.0; atoms]).max(0.0);
    rows.map(row).collect()
}

/// `ln softmax` of a row that is not empty, in f64.
///
/// The largest logit and the logarithm of the sum are stored separately: if all logits are large, their sum would lose the
/// logarithm to rounding.
struct LogSoftmax {
    max: f64,
    /// `ln(sum_i exp(x_i - max))`, from 0 to `ln N`.
    log_sum: f64,
}

impl LogSoftmax {
    fn new(row: &[f32]) -> Self {
        let max = f64::from(row.iter().copied().fold(f32::NEG_INFINITY, f32::max));
        let sum: f64 = row.iter().map(|&x| (f64::from(x) - max).exp()).sum();
        Self {
            max,
            log_sum: sum.ln(),
        }
    }

    /// The logarithm of the probability of the row's entry `x`.
    fn at(&self, x: f32) -> f64 {
        (f64::from(x) - self.max) - self.log_sum
    }
}

/// Writes the softmax of `row` to `out`, which has the same length. For any finite logits, the probabilities are accurate to
/// [`ENTRY_ERROR`].
pub fn softmax(row: &[f32], out: &mut [f32]) {
    let log_p = LogSoftmax::new(row);
    for (out, &x) in out.iter_mut().zip(row) {
        *out = log_p.at(x).exp() as f32;
    }
}

/// [`kl`] as a candle operation: `logits` [B, N] to a scalar.
///
/// # Errors
/// Logits that are not f32 [B, N] with as many values as `target` and as many rows as `weights`.
pub fn kl_loss(
    logits: &Tensor,
    target: Vec<f32>,
    weights: Option<Vec<f32>>,
    kernels: Kernels,
) -> Result<Tensor> {
    let (rows, atoms) = logits.dims2()?;
    let values = target.len();
    if values != rows * atoms {
        bail!("logits of {rows} rows and {atoms} atoms meet a target of {values} values");
    }
    if let Some(weights) = &weights
        && weights.len() != rows
    {
        bail!("logits of {rows} rows meet {} weights", weights.len());
    }
    if kernels == Kernels::Candle {
        return kl_by_candle(logits, target, weights);
    }
    scalar_op("c51-kl", logits, move |logits, gradient| {
        kl(logits, &target, weights.as_deref(), atoms, gradient)
    })
}

/// [`kl_loss`] by candle's own operations, for devices that this project has no kernels for.
fn kl_by_candle(logits: &Tensor, target: Vec<f32>, weights: Option<Vec<f32>>) -> Result<Tensor> {
    let (rows, atoms) = logits.dims2()?;
    let device = logits.device();
    let ln = |&p: &f32| if p > 0.0 { p.ln() } else { 0.0 };
    let ln_target = Tensor::from_vec(target.iter().map(ln).collect(), (rows, atoms), device)?;
    let target = Tensor::from_vec(target, (rows, atoms), device)?;
    let log_ratio = (ln_target - log_softmax(logits, D::Minus1)?)?;
    let mut entries = (target * log_ratio)?;
    if let Some(weights) = weights {
        entries = entries.broadcast_mul(&Tensor::from_vec(weights, (rows, 1), device)?)?;
    }
    entries.sum_all()?.affine(1.0 / rows as f64, 0.0)
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    const ATOMS: usize = 3;
    const LOGITS: [f32; 6] = [2.0, 0.1, -0.4, 1.5, 1.4, -2.0];
    const TARGET: [f32; 6] = [0.2, 0.5, 0.3, 0.0, 0.0, 1.0];

    /// `driml experiment stability` checks the loss and the gradient of the function itself.
    #[test]
    fn the_operations_give_the_function_and_its_slopes() -> Result<()> {
        for (scale, weights) in [(1.0, None), (1.0, Some(vec![0.25, 1.0])), (1e4, None)] {
            let logits = LOGITS.map(|logit| logit * scale);
            let mut slopes = [0f32; 6];
            let expected = kl(&logits, &TARGET, weights.as_deref(), ATOMS, &mut slopes);
            for kernels in [Kernels::FUSED, Kernels::Candle] {
                let logits = Var::from_slice(&logits, (2, ATOMS), &Device::Cpu)?;
                let loss = kl_loss(&logits, TARGET.to_vec(), weights.clone(), kernels)?;
                let grads = loss.affine(3.0, 0.0)?.backward()?;
                let found = grads.get(&logits).expect("a gradient").flatten_all()?;
                let (loss, found) = (loss.to_scalar::<f32>()?, found.to_vec1::<f32>()?);
                if kernels == Kernels::FUSED {
                    assert_eq!(
                        (loss, &found[..]),
                        (expected as f32, &slopes.map(|it| it * 3.0)[..])
                    );
                }
                let error = f64::from(loss) - expected;
                assert!(error.abs() <= 1e-6 * expected, "{kernels:?}: {error}");
                for (found, slope) in found.iter().zip(slopes) {
                    let error = (found / 3.0 - slope).abs();
                    assert!(error < 1e-6, "{kernels:?}: {found}, {slope}");
                }
            }
        }
        Ok(())
    }

    /// Without its weight the derivative is 5.5e-42, of which an f32 holds three digits.
    #[test]
    fn a_weight_does_not_magnify_what_rounding_lost() {
        let mut gradient = [0f32; 2];
        kl(&[0.0, -95.0], &[1.0, 0.0], Some(&[1e10]), 2, &mut gradient);
        let share = (-95f64).exp();
        let error = f64::from(gradient[1]) / (1e10 * share / (1.0 + share)) - 1.0;
        assert!(error.abs() < ENTRY_ERROR, "{error:e}");
    }
}
