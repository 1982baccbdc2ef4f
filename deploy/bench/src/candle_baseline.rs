//! The learner's update written with candle's own operations, for comparison: the same arithmetic, none of our kernels.
//! It does global-global DIM only, and takes the C51 projection, a thousandth of the work, from the learner.

use std::collections::HashMap;

use anyhow::ensure;
use candle_core::{D, DType, Device, Result, Tensor, Var};
use candle_nn::{
    AdamW, Optimizer, ParamsAdamW,
    ops::{log_softmax, softmax},
};
use driml_learner::{Agent, Batch, LearnerSettings, losses::projection::project};
use driml_model::{ModelConfig, Parameters};

/// Online and target network and the optimiser.
pub(super) struct CandleBaseline {
    model: ModelConfig,
    settings: LearnerSettings,
    online: HashMap<String, Tensor>,
    target: HashMap<String, Tensor>,
    /// The variables behind `online`.
    vars: Vec<Var>,
    adam: AdamW,
    /// The atoms [1, 1, N].
    support: Tensor,
}

impl CandleBaseline {
    /// A copy of a learner before its first update.
    ///
    /// # Errors
    /// A learner with other settings than this one knows.
    pub(super) fn new(learner: &Agent) -> anyhow::Result<Self> {
        let (model, settings) = (learner.model().clone(), learner.settings().clone());
        let [others @ .., _] = settings.lambda.values();
        let known = others == [0.0; 3] && !settings.double_dqn;
        ensure!(known, "only global-global DIM without double DQN is here");
        let copied = |parameters: &Parameters| -> Result<Vec<(String, Var)>> {
            let copy = |(name, var): (&str, &Var)| {
                Ok((
                    name.to_owned(),
                    Var::from_tensor(&var.as_detached_tensor().copy()?)?,
                ))
            };
            parameters.iter().map(copy).collect()
        };
        let tensors = |vars: &[(String, Var)]| {
            let tensor = |(name, var): &(String, Var)| (name.clone(), var.as_tensor().clone());
            vars.iter().map(tensor).collect::<HashMap<_, _>>()
        };
        let (online, target) = (copied(learner.online())?, copied(learner.target())?);
        let vars: Vec<_> = online.iter().map(|(_, var)| var.clone()).collect();
        let adam = AdamW::new(
            vars.clone(),
            ParamsAdamW {
                lr: settings.adam.lr,
                beta1: settings.adam.beta1,
                beta2: settings.adam.beta2,
                eps: settings.adam.eps,
                weight_decay: 0.0,
            },
        )?;
        let support = Tensor::new(model.atoms_support(), &Device::Cpu)?;
        Ok(Self {
            support: support.reshape((1, 1, model.atoms))?,
            online: tensors(&online),
            target: tensors(&target),
            vars,
            adam,
            model,
            settings,
        })
    }

    /// Learns from one batch, all of whose rows have a positive, and gives the total loss. The target network stays.
    ///
    /// # Errors
    /// A batch that does not fit.
    pub(super) fn update(&mut self, batch: &Batch<'_>) -> anyhow::Result<f32> {
        let (target, entropy) = self.projected(batch)?;
        let f4_t = self.f4(&self.online, batch.states_t)?;
        let logits = self.logits(&self.online, &f4_t)?;
        let taken = batch
            .action
            .iter()
            .map(|&a| u32::from(a))
            .collect::<Vec<_>>();
        let index = Tensor::from_vec(taken, (batch.rows, 1, 1), &Device::Cpu)?;
        let index = index
            .expand((batch.rows, 1, self.model.atoms))?
            .contiguous()?;
        let log_p = log_softmax(&logits.gather(&index, 1)?.squeeze(1)?, D::Minus1)?;
        let cross = (target * log_p)?
            .sum_all()?
            .affine(-1.0 / batch.rows as f64, 0.0)?;
        let kl = cross.affine(1.0, -entropy)?;

        let f4_k = self.f4(&self.online, batch.states_k)?;
        let psi = self.head(
            "dim.psi4",
            &Tensor::cat(&[&f4_t, &self.embedded(batch.action)?], 1)?,
        )?;
        let phi = self.head("dim.phi4", &f4_k)?;
        let clip = self.settings.tanh_clip;
        let scale = 1.0 / (self.model.rkhs as f64).sqrt() / clip;
        let scores = psi
            .matmul(&phi.t()?)?
            .affine(scale, 0.0)?
            .tanh()?
            .affine(clip, 0.0)?;
        let own = Tensor::eye(batch.rows, DType::F32, &Device::Cpu)?;
        let positives = (log_softmax(&scores, D::Minus1)? * own)?.sum_all()?;
        let weight = -self.settings.lambda.l4t4 / batch.rows as f64;
        let total = (kl + positives.affine(weight, 0.0)?)?;

        let mut gradients = total.backward()?;
        let mut squares = 0.0;
        for var in &self.vars {
            if let Some(gradient) = gradients.get(var) {
                squares += f64::from(gradient.sqr()?.sum_all()?.to_scalar::<f32>()?);
            }
        }
        let factor = self.settings.max_grad_norm / (squares.sqrt() + 1e-6);
        if factor < 1.0 {
            for var in &self.vars {
                if let Some(gradient) = gradients.remove(var) {
                    gradients.insert(var, gradient.affine(factor, 0.0)?);
                }
            }
        }
        self.adam.step(&gradients)?;
        Ok(total.to_scalar()?)
    }

    /// f4 [B, hidden] before its ReLU, of `frames` [B, H, W, C] bytes.
    fn f4(&self, net: &HashMap<String, Tensor>, frames: &[u8]) -> Result<Tensor> {
        let (height, width, channels) = (self.model.height, self.model.width, self.model.channels);
        let rows = frames.len() / self.model.frame_len();
        let frames = Tensor::from_slice(frames, (rows, height, width, channels), &Device::Cpu)?;
        let frames = frames.to_dtype(DType::F32)?.affine(1.0 / 255.0, 0.0)?;
        let mut maps = frames.permute((0, 3, 1, 2))?.contiguous()?;
        for (index, layer) in self.model.conv.iter().enumerate() {
            let name = format!("torso.conv{}", index + 1);
            let bias = net[&format!("{name}.bias")].reshape((1, (), 1, 1))?;
            let weight = &net[&format!("{name}.weight")];
            maps = maps
                .conv2d(weight, 0, layer.stride, 1, 1)?
                .broadcast_add(&bias)?
                .relu()?;
        }
        linear(net, "torso.fc", &maps.flatten_from(1)?)
    }

    /// Logits [B, A, N].
    fn logits(&self, net: &HashMap<String, Tensor>, f4: &Tensor) -> Result<Tensor> {
        let (actions, atoms) = (self.model.num_actions, self.model.atoms);
        linear(net, "head", &f4.relu()?)?.reshape(((), actions, atoms))
    }

    /// A DIM head: out(relu(hidden(x))) + skip(x).
    fn head(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let hidden = linear(&self.online, &format!("{name}.hidden"), x)?.relu()?;
        linear(&self.online, &format!("{name}.out"), &hidden)?
            + linear(&self.online, &format!("{name}.skip"), x)?
    }

    /// Embeddings of `action` [B].
    fn embedded(&self, action: &[u8]) -> Result<Tensor> {
        let mut one_hot = vec![0f32; action.len() * self.model.num_actions];
        for (row, &action) in one_hot.chunks_exact_mut(self.model.num_actions).zip(action) {
            row[usize::from(action)] = 1.0;
        }
        let shape = (action.len(), self.model.num_actions);
        self.head(
            "dim.action",
            &Tensor::from_vec(one_hot, shape, &Device::Cpu)?,
        )
    }

    /// The projected target distributions [B, N] and their mean entropy: the part of the KL without a gradient.
    fn projected(&self, batch: &Batch<'_>) -> Result<(Tensor, f64)> {
        let (rows, atoms) = (batch.rows, self.model.atoms);
        let f4_n = self.f4(&self.target, batch.states_n)?;
        let probs = softmax(&self.logits(&self.target, &f4_n)?, D::Minus1)?.detach();
        let values = probs.broadcast_mul(&self.support)?.sum(D::Minus1)?;
        let best = values.argmax(1)?.reshape((rows, 1, 1))?;
        let best = best.expand((rows, 1, atoms))?.contiguous()?;
        let probs: Vec<f32> = probs
            .contiguous()?
            .gather(&best, 1)?
            .flatten_all()?
            .to_vec1()?;
        let mut projected = vec![0f32; probs.len()];
        let (returns, discounts) = (batch.n_step_return, batch.bootstrap_discount);
        let (v_min, v_max) = (self.model.v_min, self.model.v_max);
        project(&probs, returns, discounts, v_min, v_max, &mut projected);
        let t_ln_t = |&t: &f32| {
            if t > 0.0 {
                f64::from(t) * f64::from(t).ln()
            } else {
                0.0
            }
        };
        let entropy = -projected.iter().map(t_ln_t).sum::<f64>() / rows as f64;
        Ok((
            Tensor::from_vec(projected, (rows, atoms), &Device::Cpu)?,
            entropy,
        ))
    }
}

/// `x` W^T + b, or without b where the layer has none.
fn linear(net: &HashMap<String, Tensor>, name: &str, x: &Tensor) -> Result<Tensor> {
    let y = x.matmul(&net[&format!("{name}.weight")].t()?)?;
    match net.get(&format!("{name}.bias")) {
        Some(bias) => y.broadcast_add(bias),
        None => Ok(y),
    }
}

#[cfg(test)]
mod tests {
    use driml_learner::{Agent, Compute};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{learner::SyntheticBatch, settings};

    #[test]
    fn it_learns_what_the_learner_learns() {
        let small = [
            "learner.batch_size=8",
            "model.hidden=32",
            "model.rkhs=32",
            "model.action_embed=8",
        ];
        let config = settings::of_run(settings::WORLD, "driml-ada", "paper", &small).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let made_up = SyntheticBatch::draw(&config, &mut rng);
        let update = config.learner.update.clone();
        let mut learner = Agent::new(config.model, update, &Compute::CPU, &mut rng).unwrap();
        let mut stock = CandleBaseline::new(&learner).unwrap();
        for _ in 0..3 {
            let ours = learner.update(&made_up.batch()).unwrap().total;
            let stock = stock.update(&made_up.batch()).unwrap();
            assert!(
                (ours - stock).abs() < 1e-3 * ours.abs(),
                "{ours} and {stock}"
            );
        }
    }
}
