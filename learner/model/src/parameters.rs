//! Named parameters: drawn from a seed, or read from and written to safetensors with every value checked.
//! This module knows nothing of weight versions, files on disk or the transfer between processes.

use std::collections::{BTreeMap, HashMap};

use candle_core::{DType, Device, Tensor, Var};
use rand_chacha::ChaCha8Rng;
use safetensors::tensor::{SafeTensors, TensorView};

use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::weight_dtype::{self, WeightDtype};

/// Parameters by name, as candle variables with PyTorch's names and shapes.
///
/// A clone shares the variables' storage; [`Parameters::copy_part`] does not.
#[derive(Clone, Debug)]
pub struct Parameters(BTreeMap<String, Var>);

impl Parameters {
    /// Initial parameters, drawn layer by layer in the order of [`ModelConfig::parameter_shapes`].
    ///
    /// Orthogonal with gain sqrt(2) and zero bias: torso, action embedding, Psi_3, Phi_3, and the skip matrices of
    /// Psi_4 and Phi_4. Weight and bias uniform on +-1/sqrt(fan_in): the C51 head, the other layers of Psi_4 and Phi_4,
    /// and loss layers. The means of noisy layers are drawn likewise, and every sigma is `noisy_sigma` / sqrt(fan_in).
    pub fn init(config: &ModelConfig, rng: &mut ChaCha8Rng, device: &Device) -> Result<Self> {
        config.validate()?;
        let mut vars = BTreeMap::new();
        for layer in config.layers() {
            let values = layer.draw_initial_values(rng);
            for ((name, shape), values) in layer.parameters().into_iter().zip(values) {
                vars.insert(name, Var::from_vec(values, shape, device)?);
            }
        }
        Ok(Self(vars))
    }

    /// Builds the parameters whose names pass `filter` from copies of `tensors`.
    ///
    /// # Errors
    /// [`ModelError::Parameter`] for the first parameter that is missing, unknown, not f32, of another shape or not
    /// finite; an invalid configuration.
    pub fn from_tensors(
        config: &ModelConfig,
        filter: impl Fn(&str) -> bool,
        tensors: HashMap<String, Tensor>,
        device: &Device,
    ) -> Result<Self> {
        let others = tensors.iter().filter(|(_, it)| it.dtype() != DType::F32);
        if let Some((name, tensor)) = others.min_by_key(|(name, _)| *name) {
            let why = format!("has type {:?}, wanted F32", tensor.dtype());
            return Err(ModelError::parameter(name, why));
        }
        let file = safetensors::serialize(&tensors, None)?;
        Self::load_safetensors(config, filter, &file, device)
    }

    /// Loads parameters from the bytes of a safetensors file that holds exactly those parameters of `config` whose
    /// names pass `filter`.
    ///
    /// # Errors
    /// Bytes that are not safetensors; otherwise as [`Parameters::from_tensors`].
    pub fn load_safetensors(
        config: &ModelConfig,
        filter: impl Fn(&str) -> bool,
        bytes: &[u8],
        device: &Device,
    ) -> Result<Self> {
        let mut vars = BTreeMap::new();
        for (name, (shape, values)) in decode(config, filter, bytes, |_| false)? {
            vars.insert(name, Var::from_vec(values, shape, device)?);
        }
        Ok(Self(vars))
    }

    /// Serialises the parameters whose names pass `filter` as a safetensors file. Equal parameters give equal bytes.
    ///
    /// # Errors
    /// A parameter that is not finite, because every reader rejects it; a failure to read a variable or to serialise.
    pub fn to_safetensors(&self, filter: impl Fn(&str) -> bool) -> Result<Vec<u8>> {
        self.to_safetensors_as(WeightDtype::F32, filter)
    }

    /// [`Parameters::to_safetensors`] with scalars of another type.
    ///
    /// # Errors
    /// As [`Parameters::to_safetensors`], or a parameter that is too large for the type.
    pub fn to_safetensors_as(
        &self,
        dtype: WeightDtype,
        filter: impl Fn(&str) -> bool,
    ) -> Result<Vec<u8>> {
        self.serialize_part(dtype, filter, None)
    }

    /// Serialises all parameters as a safetensors file with the metadata entry `key`: `value`, for readers that
    /// know only the file. There is one entry, because several would be written in a random order each time.
    pub fn to_described_safetensors(
        &self,
        dtype: WeightDtype,
        key: &str,
        value: &str,
    ) -> Result<Vec<u8>> {
        let entry = HashMap::from([(key.to_owned(), value.to_owned())]);
        self.serialize_part(dtype, |_| true, Some(entry))
    }

    fn serialize_part(
        &self,
        dtype: WeightDtype,
        filter: impl Fn(&str) -> bool,
        metadata: Option<HashMap<String, String>>,
    ) -> Result<Vec<u8>> {
        let mut tensors = Vec::new();
        for (name, var) in self.iter().filter(|(name, _)| filter(name)) {
            let values = var.flatten_all()?.to_vec1::<f32>()?;
            check_finite(name, &values)?;
            let bytes = dtype.encode(&values).map_err(|at| {
                let why = format!(
                    "is {} at index {at}, too large for {dtype}: learner.publish_dtype = \"f32\" or \"bf16\" publishes it",
                    values[at]
                );
                ModelError::parameter(name, why)
            })?;
            tensors.push((name, var.dims().to_vec(), bytes));
        }
        let mut views = Vec::with_capacity(tensors.len());
        for (name, shape, bytes) in &tensors {
            let view = TensorView::new(dtype.safetensors_dtype(), shape.clone(), bytes)?;
            views.push((*name, view));
        }
        Ok(safetensors::serialize(views, metadata)?)
    }

    /// Returns the parameter of this name, for example `torso.conv1.weight`.
    pub fn get(&self, name: &str) -> Option<&Var> {
        self.0.get(name)
    }

    /// Iterates over all parameters in the order of their names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.0.iter().map(|(name, var)| (name.as_str(), var))
    }

    /// Returns a deep copy without DIM heads and loss layers, as [`ModelConfig::without_dim`] describes, for a target network.
    pub fn without_dim(&self) -> Result<Self> {
        self.copy_part(|name| !is_dim(name))
    }

    /// Returns a deep copy, which shares no storage, of the parameters whose names pass `filter`.
    pub fn copy_part(&self, filter: impl Fn(&str) -> bool) -> Result<Self> {
        let mut vars = BTreeMap::new();
        for (name, var) in self.iter().filter(|(name, _)| filter(name)) {
            let copy = Var::from_tensor(&var.as_detached_tensor().copy()?)?;
            vars.insert(name.to_owned(), copy);
        }
        Ok(Self(vars))
    }

    /// Returns the variable `layer.part` as a tensor that shares its storage and gradient.
    pub(crate) fn tensor(&self, layer: &str, part: &str) -> Result<Tensor> {
        let name = format!("{layer}.{part}");
        let var = self
            .get(&name)
            .ok_or_else(|| ModelError::parameter(&name, "is missing"))?;
        Ok(var.as_tensor().clone())
    }
}

/// A tensor's shape and its values, row-major.
type ShapeAndValues = (Vec<usize>, Vec<f32>);

/// Whether the parameter belongs to a DIM head or a loss layer.
pub fn is_dim(name: &str) -> bool {
    name.starts_with("dim.")
}

/// Decodes the shapes and values of the parameters of `config` that pass `filter` from a safetensors file. The
/// file may also hold names that pass `ignore`.
pub(crate) fn decode(
    config: &ModelConfig,
    filter: impl Fn(&str) -> bool,
    bytes: &[u8],
    ignore: impl Fn(&str) -> bool,
) -> Result<BTreeMap<String, ShapeAndValues>> {
    config.validate()?;
    let file = SafeTensors::deserialize(bytes)?;
    let mut found: BTreeMap<&str, TensorView<'_>> = file.iter().collect();
    let mut parameters = BTreeMap::new();
    let shapes = config.parameter_shapes();
    for (name, shape) in shapes.into_iter().filter(|(name, _)| filter(name)) {
        let view = found
            .remove(name.as_str())
            .ok_or_else(|| ModelError::parameter(&name, "is missing"))?;
        if view.shape() != shape {
            let why = format!("has shape {:?}, wanted {shape:?}", view.shape());
            return Err(ModelError::parameter(&name, why));
        }
        let values = weight_dtype::decode(view.dtype(), view.data()).ok_or_else(|| {
            let why = format!("has type {:?}, wanted F32, F16 or BF16", view.dtype());
            ModelError::parameter(&name, why)
        })?;
        check_finite(&name, &values)?;
        parameters.insert(name, (shape, values));
    }
    match found.keys().find(|name| !ignore(name)) {
        Some(name) => Err(ModelError::parameter(name, "is not part of this network")),
        None => Ok(parameters),
    }
}

fn check_finite(name: &str, values: &[f32]) -> Result<()> {
    let Some(index) = values.iter().position(|value| !value.is_finite()) else {
        return Ok(());
    };
    let why = format!("is {} at index {index}", values[index]);
    Err(ModelError::parameter(name, why))
}
