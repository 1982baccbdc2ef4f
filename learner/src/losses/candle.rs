//! The two losses as compositions of candle's own operations, for devices that this project has no kernels for.
//! Arguments and results are those of `c51::kl_loss` and `info_nce::info_nce_loss`, which check the shapes first.

use candle_core::{D, DType, Result, Tensor};
use candle_nn::ops::log_softmax;

use super::scores::ScoreClip;

pub(super) fn kl_loss(
    logits: &Tensor,
    target: Vec<f32>,
    weights: Option<Vec<f32>>,
) -> Result<Tensor> {
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

/// As [`super::info_nce::info_nce_loss`], but scores beyond about 8 times the clip have derivative 0, which is `1 - tanh^2` in f32.
pub(super) fn info_nce_loss(dots: &Tensor, valid: &[u8], clip: ScoreClip) -> Result<Tensor> {
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
