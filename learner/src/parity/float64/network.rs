//! The network in float64: torso, C51's head and DIM's, by candle's own operations.
//! It computes no loss.

use std::collections::BTreeMap;

use candle_core::{D, DType, Device, Tensor, Var};
use candle_nn::ops::softmax;
use driml_model::{HeadNoise, ModelConfig, Parameters};

/// max(x, 0), whose slope at 0 is 0, as in PyTorch and in our kernels. Candle's own has 1 there, which an input of exact zeros meets:
/// a place of a map where no channel is open, and initial biases, which are 0.
fn relu(x: &Tensor) -> candle_core::Result<Tensor> {
    let open = x.detach().gt(0.0)?.to_dtype(x.dtype())?;
    x * open
}

/// A network's parameters in float64.
pub(super) struct Net<'a> {
    pub(super) model: &'a ModelConfig,
    pub(super) vars: BTreeMap<String, Var>,
}

/// f3 [B, L, C] and f4 [B, hidden] of states.
pub(super) struct Levels {
    pub(super) local: Tensor,
    pub(super) global: Tensor,
}

impl<'a> Net<'a> {
    pub(super) fn of(model: &'a ModelConfig, parameters: &Parameters) -> candle_core::Result<Self> {
        let wide = |(name, var): (&str, &Var)| {
            let tensor = var.as_detached_tensor().to_device(&Device::Cpu)?;
            Ok((
                name.to_owned(),
                Var::from_tensor(&tensor.to_dtype(DType::F64)?)?,
            ))
        };
        let vars = parameters
            .iter()
            .map(wide)
            .collect::<candle_core::Result<_>>()?;
        Ok(Self { model, vars })
    }

    /// `x` W^T + b, or without b where the layer has none.
    fn linear(&self, name: &str, x: &Tensor) -> candle_core::Result<Tensor> {
        let weight = self.vars[&format!("{name}.weight")].t()?;
        let y = x.broadcast_matmul(&weight)?;
        match self.vars.get(&format!("{name}.bias")) {
            Some(bias) => y.broadcast_add(bias),
            None => Ok(y),
        }
    }

    pub(super) fn features(&self, frames: &[u8]) -> candle_core::Result<Levels> {
        let ModelConfig {
            height,
            width,
            channels,
            ..
        } = *self.model;
        let rows = frames.len() / self.model.frame_len();
        let frames = Tensor::from_slice(frames, (rows, height, width, channels), &Device::Cpu)?;
        let frames = frames.to_dtype(DType::F64)?.affine(1.0 / 255.0, 0.0)?;
        let mut maps = frames.permute((0, 3, 1, 2))?.contiguous()?;
        for (index, layer) in self.model.conv.iter().enumerate() {
            let name = format!("torso.conv{}", index + 1);
            let bias = self.vars[&format!("{name}.bias")].reshape((1, (), 1, 1))?;
            let weight = self.vars[&format!("{name}.weight")].as_tensor();
            let convolved = convolution(&maps, weight, layer.stride)?;
            maps = relu(&convolved.broadcast_add(&bias)?)?;
        }
        Ok(Levels {
            global: self.linear("torso.fc", &maps.flatten_from(1)?)?,
            local: maps.flatten_from(2)?.transpose(1, 2)?.contiguous()?,
        })
    }

    /// Logits [B, A, N], with the noise of noisy layers or with their means.
    pub(super) fn logits(
        &self,
        f4: &Tensor,
        noise: Option<&HeadNoise>,
    ) -> candle_core::Result<Tensor> {
        let (actions, atoms) = (self.model.num_actions, self.model.atoms);
        let active = relu(f4)?;
        let of_actions = |name: &str, number: usize| {
            let y = self.head_layer(
                name,
                &active,
                noise.map(|noise| noise.of_parameters(number)),
            );
            y?.reshape(((), actions, atoms))
        };
        if !self.model.head.dueling {
            return of_actions("head", 0);
        }
        let advantage = of_actions("head.advantage", 1)?;
        let noise = noise.map(|noise| noise.of_parameters(0));
        let value = self.head_layer("head.value", &active, noise)?;
        advantage
            .broadcast_sub(&advantage.mean_keepdim(1)?)?
            .broadcast_add(&value.unsqueeze(1)?)
    }

    /// A layer of C51's head, with noise of its weight and its bias where they are noisy.
    fn head_layer(
        &self,
        name: &str,
        x: &Tensor,
        noise: Option<(Vec<f64>, Vec<f64>)>,
    ) -> candle_core::Result<Tensor> {
        if self.model.head.noisy_sigma.is_none() {
            return self.linear(name, x);
        }
        let part = |part: &str| self.vars[&format!("{name}.{part}")].as_tensor();
        let (mut weight, mut bias) = (part("weight_mu").clone(), part("bias_mu").clone());
        if let Some((of_weight, of_bias)) = noise {
            let scaled = |part: &Tensor, noise: Vec<f64>| {
                let noise = Tensor::from_vec(noise, part.dims(), &Device::Cpu)?;
                part * noise
            };
            weight = (weight + scaled(part("weight_sigma"), of_weight)?)?;
            bias = (bias + scaled(part("bias_sigma"), of_bias)?)?;
        }
        x.broadcast_matmul(&weight.t()?)?.broadcast_add(&bias)
    }

    /// Values [B, A] of `logits` [B, A, N].
    pub(super) fn q_values(&self, logits: &Tensor) -> candle_core::Result<Vec<f64>> {
        let support = support(self.model);
        let atoms = Tensor::from_slice(&support, (1, 1, support.len()), &Device::Cpu)?;
        let values = softmax(&logits.detach(), D::Minus1)?.broadcast_mul(&atoms)?;
        values.sum(D::Minus1)?.flatten_all()?.to_vec1()
    }

    /// A DIM head: out(relu(hidden(x))) + skip(x).
    pub(super) fn head(&self, name: &str, x: &Tensor) -> candle_core::Result<Tensor> {
        let hidden = relu(&self.linear(&format!("{name}.hidden"), x)?)?;
        self.linear(&format!("{name}.out"), &hidden)? + self.linear(&format!("{name}.skip"), x)?
    }

    /// A head of (s_t, a_t), on `features` [B, f] or [B, L, f].
    pub(super) fn psi(
        &self,
        name: &str,
        features: &Tensor,
        action: &[u8],
    ) -> candle_core::Result<Tensor> {
        if !self.vars.contains_key("dim.action.out.weight") {
            return self.head(name, features);
        }
        let actions = self.model.num_actions;
        let mut one_hot = vec![0f64; action.len() * actions];
        for (row, &action) in one_hot.chunks_exact_mut(actions).zip(action) {
            row[usize::from(action)] = 1.0;
        }
        let one_hot = Tensor::from_vec(one_hot, (action.len(), actions), &Device::Cpu)?;
        let embedded = self.head("dim.action", &one_hot)?;
        let joined = match features.dims3() {
            Ok((rows, locations, _)) => {
                let wide = embedded.dim(1)?;
                embedded
                    .unsqueeze(1)?
                    .broadcast_as((rows, locations, wide))?
                    .contiguous()?
            }
            Err(_) => embedded,
        };
        self.head(name, &Tensor::cat(&[features, &joined], D::Minus1)?)
    }
}

/// Maps [B, C, H, W] with `weight` [O, C, k, k] to [B, O, h, w], as a product with patches: the backward pass of candle's own
/// convolution fails where a stride leaves over more rows than columns.
fn convolution(maps: &Tensor, weight: &Tensor, stride: usize) -> candle_core::Result<Tensor> {
    let (batch, inputs, height, width) = maps.dims4()?;
    let (outputs, _, kernel, _) = weight.dims4()?;
    let out = |side: usize| (side - kernel) / stride + 1;
    let (rows, cols) = (out(height), out(width));
    let places = |from: usize, count: usize| {
        let places: Vec<u32> = (0..count).map(|at| (from + at * stride) as u32).collect();
        Tensor::from_vec(places, count, &Device::Cpu)
    };
    let mut patches = Vec::with_capacity(kernel * kernel);
    for y in 0..kernel {
        let lines = maps.index_select(&places(y, rows)?, 2)?;
        for x in 0..kernel {
            patches.push(lines.index_select(&places(x, cols)?, 3)?);
        }
    }
    let size = kernel * kernel * inputs;
    let patches = Tensor::cat(&patches, 1)?.permute((0, 2, 3, 1))?;
    let patches = patches.reshape((batch * rows * cols, size))?;
    let weight = weight.permute((0, 2, 3, 1))?.reshape((outputs, size))?;
    let convolved = patches
        .matmul(&weight.t()?)?
        .reshape((batch, rows, cols, outputs))?;
    convolved.permute((0, 3, 1, 2))?.contiguous()
}

/// The atoms, in units of return.
pub(super) fn support(model: &ModelConfig) -> Vec<f64> {
    let (low, high) = (f64::from(model.v_min), f64::from(model.v_max));
    let spacing = (high - low) / (model.atoms - 1) as f64;
    (0..model.atoms).map(|i| low + i as f64 * spacing).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slope_of_relu_at_zero_is_zero() {
        let x = Var::new(&[-1.0, -0.0, 0.0, 1e-300, 2.0], &Device::Cpu).unwrap();
        let y = relu(&x).unwrap();
        assert_eq!(y.to_vec1::<f64>().unwrap(), [0.0, 0.0, 0.0, 1e-300, 2.0]);
        let gradients = y.sum_all().unwrap().backward().unwrap();
        let slopes: Vec<f64> = gradients.get(&x).unwrap().to_vec1().unwrap();
        assert_eq!(slopes, [0.0, 0.0, 0.0, 1.0, 1.0]);
    }

    /// Sizes at which a stride leaves over more rows than columns, as on Ms. PacMan at 42 x 38.
    #[test]
    fn a_convolution_may_leave_over_what_it_likes() {
        use candle_core::IndexOp;

        let (maps, weight) = (
            (0..2 * 11 * 9).collect::<Vec<u32>>(),
            (0..3 * 2 * 16).collect::<Vec<u32>>(),
        );
        let tensor = |values: Vec<u32>, shape: [usize; 4]| {
            let tensor = Tensor::from_vec(values, &shape[..], &Device::Cpu).unwrap();
            tensor.to_dtype(DType::F64).unwrap().sin().unwrap()
        };
        let (maps, weight) = (tensor(maps, [1, 2, 11, 9]), tensor(weight, [3, 2, 4, 4]));
        let found = convolution(&maps, &weight, 2).unwrap();
        assert_eq!(found.dims(), [1, 3, 4, 3]);
        let at = |tensor: &Tensor, [a, b, c, d]: [usize; 4]| -> f64 {
            tensor.i((a, b, c, d)).unwrap().to_scalar().unwrap()
        };
        for (o, y, x) in [(0, 0, 0), (1, 3, 2), (2, 1, 2)] {
            let mut sum = 0.0;
            for (c, ky, kx) in (0..32).map(|i| (i / 16, i / 4 % 4, i % 4)) {
                sum += at(&maps, [0, c, 2 * y + ky, 2 * x + kx]) * at(&weight, [o, c, ky, kx]);
            }
            assert!((at(&found, [0, o, y, x]) - sum).abs() < 1e-12);
        }
        let variable = Var::from_tensor(&maps).unwrap();
        let sum = convolution(&variable, &weight, 2)
            .unwrap()
            .sum_all()
            .unwrap();
        assert!(sum.backward().unwrap().get(&variable).is_some());
    }
}
