//! The errors that an update may have compared with float64, by the precision of its products.
//! It compares nothing.

use driml_model::{Kernels, Precision, TorsoName};

/// The largest errors at which the quantities of an update pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tolerances {
    /// Values of s_t, as a share of the support's width.
    pub(super) q_values: f64,
    /// Share of rows with another greedy action in s_{t+n}: of two values that are nearly the same, either may be larger.
    pub(super) next_action_rows: f64,
    /// Each probability of the projected target distributions, in rows with the same greedy action.
    pub(super) projection: f64,
    pub(super) loss: f64,
    /// Losses, relative, if scores saturate.
    pub(super) saturated_loss: f64,
    pub(super) loss_min: f64,
    /// Gradients, as a share of the tensor's own 2-norm; `gradient_of_global` is added.
    pub(super) gradient: f64,
    /// Gradients, as a share of the global 2-norm.
    pub(super) gradient_of_global: f64,
    /// The global 2-norm, as a share of itself.
    pub(super) norm: f64,
    /// 1 - cosine of a gradient whose 2-norm is at least a tenth of the global one; `None` if not checked.
    pub(super) angle: Option<f64>,
    /// Parameters after the step, absolute.
    pub(super) updated: f64,
    /// Parameters after the step, in learning rates.
    pub(super) updated_rates: f64,
}

impl Tolerances {
    /// Derived from f32's unit roundoff, 6e-8, and the lengths of the sums. Largest errors on the open cases: values 6.3e-8 of the
    /// width, probabilities 4.3e-8, losses 5.7e-7, updated parameters 1.4e-7.
    const F32: Self = Self {
        q_values: 1e-5,
        next_action_rows: 0.0,
        projection: 5e-6,
        loss: 1e-5,
        saturated_loss: 1e-4,
        loss_min: 1e-6,
        gradient: 1e-4,
        gradient_of_global: 1e-6,
        norm: 1e-4,
        angle: None,
        updated: 4e-6,
        updated_rates: 0.0,
    };

    /// Derived from bf16's unit roundoff, 2^-8 = 4e-3: half of it for means over many products (values, probabilities), a few for losses,
    /// and for gradients the share of ReLUs that open or close. Largest errors on the open cases: values 1.0e-3 of the width,
    /// probabilities 5.7e-4, losses 4.5e-3, the gradients' norm 2.6e-2, 1 - cosine 1.4e-2. Adam's first step is one learning rate up or
    /// down for any size of the gradient, so that a gradient near 0 with another sign moves a parameter by two learning rates.
    const BF16: Self = Self {
        q_values: 2e-3,
        next_action_rows: 0.05,
        projection: 2e-3,
        loss: 1e-2,
        saturated_loss: 2e-2,
        loss_min: 2e-3,
        gradient: 0.15,
        gradient_of_global: 0.03,
        norm: 0.05,
        angle: Some(0.03),
        updated: 4e-6,
        updated_rates: 2.0,
    };

    /// The tolerance of a loss with this expected value.
    pub(super) fn loss_tolerance(&self, expected: f64, is_saturated: bool) -> f64 {
        let relative = if is_saturated {
            self.saturated_loss
        } else {
            self.loss
        };
        (relative * expected.abs()).max(self.loss_min)
    }

    pub(super) fn new(kernels: Kernels, torso: TorsoName) -> Self {
        match (kernels, torso) {
            (Kernels::Fused(Precision::Bf16), TorsoName::Nature) => Self::BF16,
            // In a residual torso 15 convolutions round instead of 3, and independent rounding errors grow as the root of their number.
            (Kernels::Fused(Precision::Bf16), TorsoName::Impala | TorsoName::Impoola) => Self {
                q_values: 5f64.sqrt() * Self::BF16.q_values,
                projection: 5f64.sqrt() * Self::BF16.projection,
                gradient: 5f64.sqrt() * Self::BF16.gradient,
                // 1 - cosine grows as the square of the error.
                angle: Self::BF16.angle.map(|angle| 5.0 * angle),
                ..Self::BF16
            },
            (Kernels::Fused(Precision::F32) | Kernels::Candle, _) => Self::F32,
        }
    }
}
