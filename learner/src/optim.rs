//! Adam with global-norm clipping: one fused pass over parameters, gradients and moments, in place.
//! It has no weight decay, no schedule of the learning rate, and no default for any of its numbers.

use std::{
    collections::{BTreeMap, HashMap},
    sync::Mutex,
};

use candle_core::{CpuStorage, Device, InplaceOp2, Layout, Tensor, backprop::GradStore, bail};
use driml_model::Parameters;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::update::UpdateError;

/// Elements a thread takes at a time.
const CHUNK: usize = 1 << 14;

/// Adam's numbers. Source: Kingma and Ba 2015, algorithm 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdamSettings {
    /// Learning rate, change of a parameter an update, above 0.
    pub lr: f64,
    /// Decay of the first moment an update, in [0, 1).
    pub beta1: f64,
    /// Decay of the second moment an update, in [0, 1).
    pub beta2: f64,
    /// Added to the root of the second moment, outside the root, above 0.
    pub eps: f64,
}

impl AdamSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// The first setting out of its range, with its value.
    pub fn validate(&self) -> Result<(), UpdateError> {
        let above_0 = |x: f64| x > 0.0 && x.is_finite();
        let decay = |x: f64| (0.0..1.0).contains(&x);
        for (name, value, fine) in [
            ("adam.lr", self.lr, above_0(self.lr)),
            ("adam.beta1", self.beta1, decay(self.beta1)),
            ("adam.beta2", self.beta2, decay(self.beta2)),
            ("adam.eps", self.eps, above_0(self.eps)),
        ] {
            if !fine {
                return Err(UpdateError::Settings(format!("{name} = {value}")));
            }
        }
        Ok(())
    }
}

/// Gradients of one loss, by parameter name. A parameter that the loss does not touch has none.
#[derive(Debug)]
pub struct Gradients {
    by_name: BTreeMap<String, Tensor>,
}

impl Gradients {
    /// Takes the gradients of `parameters` out of what a backward pass gave.
    ///
    /// # Errors
    /// A failing copy of a gradient that is not contiguous.
    pub fn take(parameters: &Parameters, mut store: GradStore) -> Result<Self, UpdateError> {
        let mut by_name = BTreeMap::new();
        for (name, var) in parameters.iter() {
            if let Some(gradient) = store.remove(var) {
                by_name.insert(name.to_owned(), gradient.contiguous()?);
            }
        }
        Ok(Self { by_name })
    }

    /// The gradient of a parameter, if the loss touches it.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.by_name.get(name)
    }

    /// Global 2-norm of all gradients together, accumulated in f64.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] with the first parameter whose gradient is infinite or NaN.
    pub fn norm(&self) -> Result<f64, UpdateError> {
        let mut total = 0.0;
        for (name, gradient) in &self.by_name {
            let (storage, layout) = gradient.storage_and_layout();
            let candle_core::Storage::Cpu(storage) = &*storage else {
                return Err(UpdateError::Settings(
                    "gradients must be on the CPU".to_owned(),
                ));
            };
            let squares: f64 = slice(storage, layout)?
                .par_chunks(CHUNK)
                .map(sum_of_squares)
                .collect::<Vec<_>>()
                .iter()
                .sum();
            if !squares.is_finite() {
                return Err(UpdateError::NonFinite {
                    what: format!("the gradient of {name}"),
                });
            }
            total += squares;
        }
        Ok(total.sqrt())
    }
}

/// Sum of squares in f64, in eight interleaved parts so that it runs at the speed of memory.
fn sum_of_squares(values: &[f32]) -> f64 {
    let mut parts = [0f64; 8];
    let chunks = values.chunks_exact(8);
    let rest: f64 = chunks
        .remainder()
        .iter()
        .map(|&x| f64::from(x) * f64::from(x))
        .sum();
    for chunk in chunks {
        for (part, &x) in parts.iter_mut().zip(chunk) {
            *part += f64::from(x) * f64::from(x);
        }
    }
    parts.iter().sum::<f64>() + rest
}

/// Factor on gradients of global norm `norm` so that their norm stays within `max_norm`.
///
/// `max_norm / (norm + 1e-6)` where that is below 1, else 1. Source: PyTorch's `clip_grad_norm_`.
pub fn clip_factor(norm: f64, max_norm: f64) -> f64 {
    (max_norm / (norm + 1e-6)).min(1.0)
}

/// Running moments of one parameter's gradient, in its layout.
#[derive(Clone, Debug, PartialEq)]
struct Moments {
    shape: Vec<usize>,
    m: Vec<f32>,
    v: Vec<f32>,
}

/// Adam's state: the step count and both moments of every parameter, by name.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam {
    settings: AdamSettings,
    step: u64,
    moments: BTreeMap<String, Moments>,
}

impl Adam {
    /// Moments of zero for each of `parameters`.
    pub fn new(settings: AdamSettings, parameters: &Parameters) -> Self {
        let zeros = |var: &Tensor| Moments {
            shape: var.dims().to_vec(),
            m: vec![0.0; var.elem_count()],
            v: vec![0.0; var.elem_count()],
        };
        let moments = parameters
            .iter()
            .map(|(name, var)| (name.to_owned(), zeros(var)))
            .collect();
        Self {
            settings,
            step: 0,
            moments,
        }
    }

    /// Steps taken.
    pub const fn step_count(&self) -> u64 {
        self.step
    }

    /// Takes one step, in place, on gradients times `factor`.
    ///
    /// `m = beta1 m + (1 - beta1) g`, `v = beta2 v + (1 - beta2) g^2`,
    /// `p -= lr / (1 - beta1^t) * m / (sqrt(v) / sqrt(1 - beta2^t) + eps)`.
    /// A parameter without a gradient is left as it is, moments included.
    /// Source: PyTorch's `Adam` without weight decay.
    ///
    /// # Errors
    /// A gradient whose shape or type is not its parameter's.
    pub fn step(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        factor: f64,
    ) -> Result<(), UpdateError> {
        self.step += 1;
        let AdamSettings {
            lr,
            beta1,
            beta2,
            eps,
        } = self.settings;
        let t = i32::try_from(self.step).unwrap_or(i32::MAX);
        let rule = Rule {
            factor: factor as f32,
            beta1: beta1 as f32,
            rest1: (1.0 - beta1) as f32,
            beta2: beta2 as f32,
            rest2: (1.0 - beta2) as f32,
            step_size: (lr / (1.0 - beta1.powi(t))) as f32,
            root_scale: (1.0 / (1.0 - beta2.powi(t)).sqrt()) as f32,
            eps: eps as f32,
        };
        for (name, moments) in &mut self.moments {
            let (Some(var), Some(gradient)) = (parameters.get(name), gradients.get(name)) else {
                continue;
            };
            let op = Step {
                rule,
                moments: Mutex::new(moments),
            };
            var.inplace_op2(gradient, &op)?;
        }
        Ok(())
    }

    /// The moments as tensors: `m.<name>` and `v.<name>`, in the parameters' shapes.
    ///
    /// # Errors
    /// A failing allocation.
    pub fn to_tensors(&self) -> Result<HashMap<String, Tensor>, UpdateError> {
        let mut tensors = HashMap::new();
        for (name, Moments { shape, m, v }) in &self.moments {
            for (which, values) in [("m", m), ("v", v)] {
                let tensor = Tensor::from_slice(values, shape.as_slice(), &Device::Cpu)?;
                tensors.insert(format!("{which}.{name}"), tensor);
            }
        }
        Ok(tensors)
    }

    /// Puts back what [`Adam::to_tensors`] gave after `step` steps, bit for bit.
    ///
    /// # Errors
    /// A moment that is missing, of another shape, or of no parameter of this optimiser.
    pub fn restore(
        &mut self,
        step: u64,
        mut tensors: HashMap<String, Tensor>,
    ) -> Result<(), UpdateError> {
        let mut restored = self.moments.clone();
        for (name, moments) in &mut restored {
            let Moments { shape, m, v } = moments;
            for (which, values) in [("m", m), ("v", v)] {
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
                *values = tensor.flatten_all()?.to_vec1()?;
            }
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

/// One step's numbers, the same for every element.
#[derive(Clone, Copy)]
struct Rule {
    factor: f32,
    beta1: f32,
    rest1: f32,
    beta2: f32,
    rest2: f32,
    step_size: f32,
    root_scale: f32,
    eps: f32,
}

impl Rule {
    fn apply(&self, p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32]) {
        for (((p, &g), m), v) in p.iter_mut().zip(g).zip(m).zip(v) {
            let g = g * self.factor;
            *m = self.beta1 * *m + self.rest1 * g;
            *v = self.beta2 * *v + self.rest2 * g * g;
            *p -= self.step_size * *m / (v.sqrt() * self.root_scale + self.eps);
        }
    }
}

struct Step<'a> {
    rule: Rule,
    /// Uncontended: candle hands operations out by shared reference only.
    moments: Mutex<&'a mut Moments>,
}

impl InplaceOp2 for Step<'_> {
    fn name(&self) -> &'static str {
        "adam"
    }

    fn cpu_fwd(
        &self,
        parameter: &mut CpuStorage,
        l1: &Layout,
        gradient: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<()> {
        let parameter = slice_mut(parameter, l1)?;
        let gradient = slice(gradient, l2)?;
        let mut moments = self
            .moments
            .lock()
            .expect("nothing panics while it holds this lock");
        let Moments { m, v, .. } = &mut **moments;
        if parameter.len() != m.len() || gradient.len() != m.len() {
            bail!(
                "{} parameters, {} gradients, {} moments",
                parameter.len(),
                gradient.len(),
                m.len()
            );
        }
        parameter
            .par_chunks_mut(CHUNK)
            .zip(gradient.par_chunks(CHUNK))
            .zip(m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK)))
            .for_each(|((p, g), (m, v))| self.rule.apply(p, g, m, v));
        Ok(())
    }
}

/// The f32 values of a contiguous tensor on the CPU.
pub(crate) fn slice<'a>(
    storage: &'a CpuStorage,
    layout: &Layout,
) -> candle_core::Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("a tensor of shape {:?} is not contiguous", layout.shape()),
    }
}

/// [`slice`], to be written.
pub(crate) fn slice_mut<'a>(
    storage: &'a mut CpuStorage,
    layout: &Layout,
) -> candle_core::Result<&'a mut [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(values), Some((start, end))) => Ok(&mut values[start..end]),
        _ => bail!(
            "a tensor of shape {:?} is not contiguous f32",
            layout.shape()
        ),
    }
}
