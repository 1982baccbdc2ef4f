//! Adam: on the CPU, one fused pass over parameters, gradients and moments, in place; on other devices, candle's operations.
//! It has no weight decay, no schedule of the learning rate, and no default for any of its settings.

use std::{
    collections::{BTreeMap, HashMap},
    ops::RangeInclusive,
};

use candle_core::{DType, Device, Tensor, Var};
use driml_model::{Kernels, Parameters};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::gradients::Gradients;
use crate::{
    error::{Result, UpdateError},
    ranges::check_range,
    tensors::{modify_in_place, to_vec_f32},
};

/// Elements that a thread takes at a time.
const CHUNK: usize = 1 << 14;

/// Steps from one flush of subnormal moments to the next. A flush in every step would cost a quarter of the step's time.
const FLUSH_PERIOD: u64 = 32;

/// Range of `lr`. Within it, the first step's `lr / (1 - beta1)` is a finite f32 for every `beta1` in its range.
const LR_RANGE: RangeInclusive<f64> = 1e-30..=1e33;
/// Range of a moment's decay. Above it, `1 - beta` is off by more than 0.2% in f32.
const BETA_RANGE: RangeInclusive<f64> = 0.0..=0.99999;
/// Range of `eps`. Its start is 10,000 times the root of the least second moment that f32 holds.
const EPS_RANGE: RangeInclusive<f64> = 1e-15..=1e30;

/// Largest error of a parameter compared with the same steps in f64, relative to the distance it moved, in addition to [`step_floor`].
pub const STEP_ERROR: f64 = 0.004;

/// Largest error of a moment compared with f64 while gradients continue, relative to the decayed mean of their sizes or squares: `beta`
/// and each product and sum are rounded to f32, and the errors of 1 / (1 - beta) steps add up.
pub const fn moment_error(beta: f64) -> f64 {
    2e-7 / (1.0 - beta)
}

/// The error that each step may add to a parameter in addition to [`STEP_ERROR`]: half a unit in the last place of `parameter`, and the
/// loss of `lr * m` to underflow before its division.
pub fn step_floor(parameter: f64, eps: f64) -> f64 {
    let least = f64::from(f32::MIN_POSITIVE);
    parameter.abs().max(least) / 2f64.powi(24) + least / eps.min(1.0)
}

/// Adam's settings. Source: Kingma and Ba 2015, algorithm 1.
///
/// A step is computed in f32; within these ranges, it agrees with a step in f64. Second moments below 1.2e-38, which f32 does not hold,
/// come from gradients below `1.1e-19 / sqrt(1 - beta2)`: `eps` must be much larger. At the least `eps` and `beta2` = 0.999, a step is
/// within [`STEP_ERROR`], 0.4%. Gradients are at most 1e15, the largest `max_grad_norm`: the square of a gradient above 1e19 is not
/// finite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdamSettings {
    /// Learning rate, the change of a parameter per update, from 1e-30 to 1e33.
    pub lr: f64,
    /// Decay of the first moment per update, in [0, 0.99999].
    pub beta1: f64,
    /// Decay of the second moment per update, in [0, 0.99999].
    pub beta2: f64,
    /// Added to the root of the second moment, outside the root, from 1e-15 to 1e30.
    pub eps: f64,
}

impl AdamSettings {
    /// Checks each number against its range.
    pub fn validate(&self) -> Result<()> {
        check_range("adam.lr", self.lr, LR_RANGE)?;
        check_range("adam.beta1", self.beta1, BETA_RANGE)?;
        check_range("adam.beta2", self.beta2, BETA_RANGE)?;
        check_range("adam.eps", self.eps, EPS_RANGE)
    }
}

/// Adam's state: the step count and both moments of every parameter, by name.
#[derive(Debug)]
pub struct Adam {
    settings: AdamSettings,
    /// Steps taken so far, which the bias correction counts.
    pub(crate) step: u64,
    kernels: Kernels,
    /// The running mean of a parameter's gradient, and that of its square, in the parameter's shape and on its device.
    moments: BTreeMap<String, [Tensor; 2]>,
}

impl Adam {
    /// Creates Adam's state before the first step, with moments of zero for each of `parameters`.
    pub fn new(settings: AdamSettings, parameters: &Parameters, kernels: Kernels) -> Result<Self> {
        settings.validate()?;
        let mut moments = BTreeMap::new();
        for (name, var) in parameters.iter() {
            moments.insert(name.to_owned(), [var.zeros_like()?, var.zeros_like()?]);
        }
        Ok(Self {
            settings,
            step: 0,
            kernels,
            moments,
        })
    }

    /// Takes one step, in place, on gradients times `factor`.
    ///
    /// `m = beta1 m + (1 - beta1) g`, `v = beta2 v + (1 - beta2) g^2`,
    /// `p -= lr / (1 - beta1^t) * m / (sqrt(v) / sqrt(1 - beta2^t) + eps)`.
    /// A parameter without a gradient is unchanged, moments included.
    /// Source: PyTorch's `Adam` without weight decay.
    ///
    /// # Errors
    /// A gradient whose shape or type is not its parameter's; [`UpdateError::Diverged`] for a parameter or moment that is not finite after
    /// the step. Only the CPU's fused kernels check that, as it costs nothing there; on other devices, [`Parameters::to_safetensors`]
    /// rejects such a parameter.
    pub fn step(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        factor: f64,
    ) -> Result<()> {
        self.step += 1;
        let coefficients = StepCoefficients::new(self.settings, self.step, factor);
        for (name, moments) in &mut self.moments {
            let (Some(var), Some(gradient)) = (parameters.get(name), gradients.get(name)) else {
                continue;
            };
            match self.kernels {
                Kernels::Fused(_) => {
                    if !coefficients.apply_in_place(var, gradient, moments)? {
                        let name = name.clone();
                        let (update, lr) = (self.step, self.settings.lr);
                        return Err(UpdateError::Diverged { name, update, lr });
                    }
                }
                Kernels::Candle => coefficients.apply_to_tensors(var, gradient, moments)?,
            }
        }
        Ok(())
    }

    /// The moments as tensors: `m.<name>` and `v.<name>`, in the parameters' shapes.
    pub fn to_tensors(&self) -> Result<HashMap<String, Tensor>> {
        let mut tensors = HashMap::new();
        for (name, moments) in &self.moments {
            for (which, moment) in ["m", "v"].into_iter().zip(moments) {
                let name = format!("{which}.{name}");
                let values = to_vec_f32(moment)?;
                if !values.iter().all(|value| value.is_finite()) {
                    let why = format!("the moment {name} is not finite");
                    return Err(UpdateError::State(why));
                }
                let copied = Tensor::from_vec(values, moment.shape(), &Device::Cpu)?;
                tensors.insert(name, copied);
            }
        }
        Ok(tensors)
    }

    /// Restores the moments from [`Adam::to_tensors`], bit for bit, and the count of steps.
    pub fn restore(&mut self, step: u64, mut tensors: HashMap<String, Tensor>) -> Result<()> {
        let error = |name: &str, why: &str| UpdateError::State(format!("the moment {name} {why}"));
        let mut take = |which: &str, name: &str, ours: &Tensor| -> Result<_> {
            let name = format!("{which}.{name}");
            let error = |why: &str| error(&name, why);
            let tensor = tensors.remove(&name).ok_or_else(|| error("is missing"))?;
            let (found, shape) = (tensor.dims(), ours.dims());
            if found != shape {
                return Err(error(&format!("is {found:?}, not {shape:?}")));
            }
            if tensor.dtype() != DType::F32 {
                return Err(error(&format!("has type {:?}, not F32", tensor.dtype())));
            }
            let values = to_vec_f32(&tensor)?;
            // A mean of squares is never negative.
            let least = if which == "v" { 0.0 } else { f32::MIN };
            if let Some(at) = values.iter().position(|v| !(least..=f32::MAX).contains(v)) {
                return Err(error(&format!("is {} at index {at}", values[at])));
            }
            Ok(Tensor::from_vec(values, shape, ours.device())?)
        };
        let mut restored = BTreeMap::new();
        for (name, [m, v]) in &self.moments {
            restored.insert(name.clone(), [take("m", name, m)?, take("v", name, v)?]);
        }
        if let Some(name) = tensors.keys().min() {
            return Err(error(name, "belongs to no parameter"));
        }
        self.moments = restored;
        self.step = step;
        Ok(())
    }
}

/// The coefficients of one step of [`Adam::step`], which are the same for every element of every parameter.
#[derive(Clone, Copy, Debug)]
pub struct StepCoefficients {
    factor: f32,
    beta1: f32,
    one_minus_beta1: f32,
    beta2: f32,
    one_minus_beta2: f32,
    step_size: f32,
    root_scale: f32,
    eps: f32,
    /// Whether this step begins with flushing the moments.
    flushes_moments: bool,
}

impl StepCoefficients {
    /// Computes the coefficients of step number `step`, counted from 1, for gradients times `factor`.
    pub fn new(settings: AdamSettings, step: u64, factor: f64) -> Self {
        let (beta1, beta2) = (settings.beta1, settings.beta2);
        let t = i32::try_from(step).unwrap_or(i32::MAX);
        Self {
            factor: factor as f32,
            beta1: beta1 as f32,
            one_minus_beta1: (1.0 - beta1) as f32,
            beta2: beta2 as f32,
            one_minus_beta2: (1.0 - beta2) as f32,
            step_size: (settings.lr / (1.0 - beta1.powi(t))) as f32,
            root_scale: (1.0 / (1.0 - beta2.powi(t)).sqrt()) as f32,
            eps: settings.eps as f32,
            flushes_moments: step.is_multiple_of(FLUSH_PERIOD),
        }
    }

    /// Takes the step on slices of parameters `p`, gradients `g` and moments `m` and `v`, all of one length. Returns whether parameters
    /// and second moments are finite after it; if so, the first moments are too, as a mean is at most the root of the mean square.
    ///
    /// Once in 32 steps, subnormal moments become 0. Otherwise, the moments of a gradient that has become 0 would stay subnormal forever,
    /// as 0.9 times the smallest numbers rounds back to them, and would make each later step several times as slow.
    #[allow(clippy::eq_op, reason = "x - x tells finite numbers from others")]
    pub fn apply(&self, p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32]) -> bool {
        if self.flushes_moments {
            flush_subnormals(m);
            flush_subnormals(v);
        }
        // x - x is 0 for a finite x, else NaN. Collecting bits, unlike a test in the loop, costs nothing measurable.
        let mut not_finite = 0;
        for (((p, &g), m), v) in p.iter_mut().zip(g).zip(m).zip(v) {
            let g = g * self.factor;
            *m = self.beta1 * *m + self.one_minus_beta1 * g;
            *v = self.beta2 * *v + self.one_minus_beta2 * g * g;
            *p -= self.step_size * *m / (v.sqrt() * self.root_scale + self.eps);
            not_finite |= ((*p - *p) + (*v - *v)).to_bits();
        }
        not_finite == 0
    }

    /// [`StepCoefficients::apply`] on tensors on the CPU, in parallel.
    fn apply_in_place(&self, p: &Tensor, g: &Tensor, [m, v]: &[Tensor; 2]) -> Result<bool> {
        let mut all_finite = true;
        // Nested, as an operation changes one tensor.
        modify_in_place(m, g, |m, _| {
            modify_in_place(v, g, |v, _| {
                modify_in_place(p, g, |p, g| {
                    let chunks = p.par_chunks_mut(CHUNK).zip(g.par_chunks(CHUNK));
                    let moments = m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK));
                    let chunks = chunks.zip(moments);
                    let finite = chunks.map(|((p, g), (m, v))| self.apply(p, g, m, v));
                    all_finite = finite.reduce(|| true, |one, other| one & other);
                    Ok(())
                })
            })
        })?;
        Ok(all_finite)
    }

    fn apply_to_tensors(&self, p: &Var, g: &Tensor, [m, v]: &mut [Tensor; 2]) -> Result<()> {
        let by = |tensor: &Tensor, factor: f32| tensor.affine(factor.into(), 0.0);
        let g = by(g, self.factor)?;
        *m = (by(m, self.beta1)? + by(&g, self.one_minus_beta1)?)?;
        *v = (by(v, self.beta2)? + by(&g.sqr()?, self.one_minus_beta2)?)?;
        let root = v.sqrt()?.affine(self.root_scale.into(), self.eps.into())?;
        Ok(p.set(&(p.as_detached_tensor() - (by(m, self.step_size)? / root)?)?)?)
    }
}

/// Replaces subnormal numbers by 0; all others, including NaN, are unchanged.
fn flush_subnormals(values: &mut [f32]) {
    for value in values {
        *value = if value.abs() < f32::MIN_POSITIVE {
            0.0
        } else {
            *value
        };
    }
}

#[cfg(test)]
mod tests;
