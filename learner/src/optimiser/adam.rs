//! Adam: one fused pass over parameters, gradients and moments, in place; elsewhere than on the CPU, candle's operations.
//! It has no weight decay, no schedule of the learning rate, and no default for any of its numbers.

use std::{
    collections::{BTreeMap, HashMap},
    ops::RangeInclusive,
};

use candle_core::{DType, Device, Tensor, Var};
use driml_model::{Kernels, Parameters};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::gradients::Gradients;
use crate::{error::UpdateError, ranges::check_range, tensors::change};

/// Elements a thread takes at a time.
const CHUNK: usize = 1 << 14;

/// Steps from one flushing of subnormal moments to the next: in every step it would cost a quarter of the step's time.
const FLUSH_PERIOD: u64 = 32;

const LR: RangeInclusive<f64> = 1e-30..=1e38;
/// Decays of a moment; beyond the largest `1 - beta` is off by more than 0.2% in f32.
const BETA: RangeInclusive<f64> = 0.0..=0.99999;
/// The least is 10,000 times the root of the least second moment that f32 holds.
const EPS: RangeInclusive<f64> = 1e-15..=1e30;

/// Largest error of a parameter against the same steps in f64, as a share of the way it went, beside [`step_floor`].
pub const STEP_ERROR: f64 = 0.004;

/// Largest error of a moment against f64 while gradients continue, as a share of the decayed mean of their sizes, or of their squares:
/// `beta` and each product and sum are rounded to f32, and 1 / (1 - beta) steps add up.
pub const fn moment_error(beta: f64) -> f64 {
    2e-7 / (1.0 - beta)
}

/// What each step may add to the error of a parameter beside [`STEP_ERROR`]: half of the last place of a parameter of size
/// `parameter`, and what `lr * m` loses below the normal numbers before it is divided.
pub fn step_floor(parameter: f64, eps: f64) -> f64 {
    let least = f64::from(f32::MIN_POSITIVE);
    parameter.abs().max(least) / 2f64.powi(24) + least / eps.min(1.0)
}

/// Adam's numbers. Source: Kingma and Ba 2015, algorithm 1.
///
/// A step is taken in f32, and the ranges are those in which it is what it would be in f64: the second moments that f32 does not
/// hold, below 1.2e-38, are of gradients below `1.1e-19 / sqrt(1 - beta2)`, beside which `eps` must be large. At its least
/// `eps` and `beta2` = 0.999 a step is within [`STEP_ERROR`], 0.4%. Gradients are within 1e15, the largest `max_grad_norm`: the square
/// of one above 1e19 is not finite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdamSettings {
    /// Learning rate, change of a parameter an update, from 1e-30 to 1e38.
    pub lr: f64,
    /// Decay of the first moment an update, in [0, 0.99999].
    pub beta1: f64,
    /// Decay of the second moment an update, in [0, 0.99999].
    pub beta2: f64,
    /// Added to the root of the second moment, outside the root, from 1e-15 to 1e30.
    pub eps: f64,
}

impl AdamSettings {
    /// Checks each number against its range.
    pub fn validate(&self) -> Result<(), UpdateError> {
        check_range("adam.lr", self.lr, LR)?;
        check_range("adam.beta1", self.beta1, BETA)?;
        check_range("adam.beta2", self.beta2, BETA)?;
        check_range("adam.eps", self.eps, EPS)
    }
}

/// Running moments of one parameter's gradient.
#[derive(Clone, Debug)]
enum Moments {
    /// In the parameter's layout, for the fused step.
    Fused {
        m: Vec<f32>,
        v: Vec<f32>,
    },
    Tensors {
        m: Tensor,
        v: Tensor,
    },
}

impl Moments {
    fn new(m: &Tensor, v: &Tensor, kernels: Kernels) -> candle_core::Result<Self> {
        Ok(match kernels {
            Kernels::Fused(_) => Self::Fused {
                m: m.flatten_all()?.to_vec1()?,
                v: v.flatten_all()?.to_vec1()?,
            },
            Kernels::Candle => Self::Tensors {
                m: m.clone(),
                v: v.clone(),
            },
        })
    }

    /// m and v on the CPU, in this shape.
    fn tensors(&self, shape: &[usize]) -> candle_core::Result<[Tensor; 2]> {
        Ok(match self {
            Self::Fused { m, v } => [
                Tensor::from_slice(m, shape, &Device::Cpu)?,
                Tensor::from_slice(v, shape, &Device::Cpu)?,
            ],
            Self::Tensors { m, v } => [m.to_device(&Device::Cpu)?, v.to_device(&Device::Cpu)?],
        })
    }
}

/// Adam's state: the step count and both moments of every parameter, by name.
#[derive(Clone, Debug)]
pub struct Adam {
    settings: AdamSettings,
    step: u64,
    kernels: Kernels,
    /// By name, with the parameter's shape.
    moments: BTreeMap<String, (Vec<usize>, Moments)>,
}

impl Adam {
    /// Moments of zero for each of `parameters`.
    ///
    /// # Errors
    /// Settings out of their ranges; the device has no memory left for the moments.
    pub fn new(
        settings: AdamSettings,
        parameters: &Parameters,
        kernels: Kernels,
    ) -> Result<Self, UpdateError> {
        settings.validate()?;
        let mut moments = BTreeMap::new();
        for (name, var) in parameters.iter() {
            let zeros = var.zeros_like()?;
            let both = Moments::new(&zeros, &zeros, kernels)?;
            moments.insert(name.to_owned(), (var.dims().to_vec(), both));
        }
        Ok(Self {
            settings,
            step: 0,
            kernels,
            moments,
        })
    }

    /// Steps taken so far, which the bias correction counts.
    pub const fn step_count(&self) -> u64 {
        self.step
    }

    /// Takes one step, in place, on gradients times `factor`.
    ///
    /// `m = beta1 m + (1 - beta1) g`, `v = beta2 v + (1 - beta2) g^2`,
    /// `p -= lr / (1 - beta1^t) * m / (sqrt(v) / sqrt(1 - beta2^t) + eps)`.
    /// A parameter without a gradient is unchanged, moments included.
    /// Source: PyTorch's `Adam` without weight decay.
    ///
    /// # Errors
    /// A gradient whose shape or type is not its parameter's; a step size beyond the finite numbers, before anything has
    /// changed; [`UpdateError::Diverged`] for a parameter or moment that the step took beyond them. The last is found out on the
    /// CPU alone, where it costs nothing; on other devices no such parameter passes [`Parameters::to_safetensors`].
    pub fn step(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        factor: f64,
    ) -> Result<(), UpdateError> {
        let step = self.step + 1;
        let lr = self.settings.lr;
        let rule = Rule::new(self.settings, step, factor);
        if !rule.step_size.is_finite() {
            let what = format!("a step of Adam with lr = {lr:e}");
            return Err(UpdateError::NonFinite(what));
        }
        self.step = step;
        for (name, (_, moments)) in &mut self.moments {
            let (Some(var), Some(gradient)) = (parameters.get(name), gradients.get(name)) else {
                continue;
            };
            match moments {
                Moments::Fused { m, v } => {
                    let mut all_finite = true;
                    change(var, gradient, |p, g| {
                        let chunks = p.par_chunks_mut(CHUNK).zip(g.par_chunks(CHUNK));
                        let moments = m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK));
                        let finite = chunks
                            .zip(moments)
                            .map(|((p, g), (m, v))| rule.apply(p, g, m, v));
                        all_finite = finite.reduce(|| true, |one, other| one & other);
                    })?;
                    if !all_finite {
                        let name = name.clone();
                        let update = self.step;
                        return Err(UpdateError::Diverged { name, update, lr });
                    }
                }
                Moments::Tensors { m, v } => rule.apply_to_tensors(var, gradient, m, v)?,
            }
        }
        Ok(())
    }

    /// The moments as tensors: `m.<name>` and `v.<name>`, in the parameters' shapes.
    ///
    /// # Errors
    /// A failing allocation, or a moment that is not finite.
    pub fn to_tensors(&self) -> Result<HashMap<String, Tensor>, UpdateError> {
        let mut tensors = HashMap::new();
        for (name, (shape, moments)) in &self.moments {
            for (which, tensor) in ["m", "v"].into_iter().zip(moments.tensors(shape)?) {
                let values = tensor.flatten_all()?.to_vec1::<f32>()?;
                if !values.iter().all(|value| value.is_finite()) {
                    return Err(UpdateError::State(format!(
                        "the moment {which}.{name} is not finite"
                    )));
                }
                tensors.insert(format!("{which}.{name}"), tensor);
            }
        }
        Ok(tensors)
    }

    /// Puts back what [`Adam::to_tensors`] gave after `step` steps, bit for bit, on `device`.
    ///
    /// # Errors
    /// A moment that is missing, of another shape or type, not finite, or of no parameter of this optimiser.
    pub fn restore(
        &mut self,
        step: u64,
        mut tensors: HashMap<String, Tensor>,
        device: &Device,
    ) -> Result<(), UpdateError> {
        let mut restored = self.moments.clone();
        for (name, (shape, moments)) in &mut restored {
            let mut take = |which: &str| {
                let name = format!("{which}.{name}");
                let Some(tensor) = tensors.remove(&name) else {
                    return Err(UpdateError::State(format!("the moment {name} is missing")));
                };
                if tensor.dims() != shape.as_slice() {
                    let found = tensor.dims();
                    return Err(UpdateError::State(format!(
                        "the moment {name} is {found:?}, not {shape:?}"
                    )));
                }
                let values = match tensor.dtype() {
                    DType::F32 => tensor.flatten_all()?.to_vec1::<f32>()?,
                    other => {
                        return Err(UpdateError::State(format!(
                            "the moment {name} has type {other:?}, not F32"
                        )));
                    }
                };
                // Of squares there is no negative mean.
                let least = if which == "v" { 0.0 } else { f32::MIN };
                if let Some(at) = values.iter().position(|v| !(least..=f32::MAX).contains(v)) {
                    let value = values[at];
                    return Err(UpdateError::State(format!(
                        "the moment {name} is {value} at index {at}"
                    )));
                }
                Ok(tensor.to_device(device)?)
            };
            *moments = Moments::new(&take("m")?, &take("v")?, self.kernels)?;
        }
        if let Some(name) = tensors.keys().min() {
            return Err(UpdateError::State(format!(
                "the moment {name} belongs to no parameter"
            )));
        }
        self.moments = restored;
        self.step = step;
        Ok(())
    }
}

/// One step's numbers, the same for every element: what [`Adam::step`] does to a stretch of a parameter.
#[derive(Clone, Copy, Debug)]
pub struct Rule {
    factor: f32,
    beta1: f32,
    rest1: f32,
    beta2: f32,
    rest2: f32,
    step_size: f32,
    root_scale: f32,
    eps: f32,
    /// Whether this step begins with flushing the moments.
    flushes: bool,
}

impl Rule {
    /// The numbers of step number `step`, counted from 1, on gradients times `factor`.
    pub fn new(settings: AdamSettings, step: u64, factor: f64) -> Self {
        let AdamSettings {
            lr,
            beta1,
            beta2,
            eps,
        } = settings;
        let t = i32::try_from(step).unwrap_or(i32::MAX);
        Self {
            factor: factor as f32,
            beta1: beta1 as f32,
            rest1: (1.0 - beta1) as f32,
            beta2: beta2 as f32,
            rest2: (1.0 - beta2) as f32,
            step_size: (lr / (1.0 - beta1.powi(t))) as f32,
            root_scale: (1.0 / (1.0 - beta2.powi(t)).sqrt()) as f32,
            eps: eps as f32,
            flushes: step.is_multiple_of(FLUSH_PERIOD),
        }
    }

    /// Takes the step on one stretch of parameters `p`, gradients `g` and moments `m` and `v`, all of one length; says whether its parameters and second moments are finite after it. (So are then the
    /// first moments, as a mean is no larger than the root of the mean square.)
    ///
    /// Once in 32 steps, moments below the normal numbers become 0. Those of a gradient that is gone would else stay
    /// there for good, as 0.9 times the smallest numbers rounds back to them, and make each later step several times as slow.
    #[allow(clippy::eq_op, reason = "x - x tells finite numbers from others")]
    pub fn apply(&self, p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32]) -> bool {
        if self.flushes {
            flush(m);
            flush(v);
        }
        // x - x is 0 for a finite x, else NaN. Collecting bits, unlike a test in the loop, costs nothing measurable.
        let mut not_finite = 0;
        for (((p, &g), m), v) in p.iter_mut().zip(g).zip(m).zip(v) {
            let g = g * self.factor;
            *m = self.beta1 * *m + self.rest1 * g;
            *v = self.beta2 * *v + self.rest2 * g * g;
            *p -= self.step_size * *m / (v.sqrt() * self.root_scale + self.eps);
            not_finite |= ((*p - *p) + (*v - *v)).to_bits();
        }
        not_finite == 0
    }

    fn apply_to_tensors(
        &self,
        p: &Var,
        g: &Tensor,
        m: &mut Tensor,
        v: &mut Tensor,
    ) -> candle_core::Result<()> {
        let by = |tensor: &Tensor, factor: f32| tensor.affine(factor.into(), 0.0);
        let g = by(g, self.factor)?;
        *m = (by(m, self.beta1)? + by(&g, self.rest1)?)?;
        *v = (by(v, self.beta2)? + by(&g.sqr()?, self.rest2)?)?;
        let root = v.sqrt()?.affine(self.root_scale.into(), self.eps.into())?;
        p.set(&(p.as_detached_tensor() - (by(m, self.step_size)? / root)?)?)
    }
}

/// Puts 0 in place of subnormal numbers; all others, NaN included, stay as they are.
fn flush(values: &mut [f32]) {
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
