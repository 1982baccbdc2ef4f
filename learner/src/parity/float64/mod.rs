//! An update's losses and gradients in float64, by candle's own operations: what the error of any setting is measured against, at
//! weights and rows for which there is no file. Its own tests hold it to the files.
//! It knows C51 alone and C51 with DIM, takes no step, and is slow: seconds for 64 rows of Procgen.

mod network;

use std::collections::BTreeMap;

use candle_core::{D, DType, Device, Tensor};
use candle_nn::ops::{log_softmax, softmax};

use self::network::{Levels, Net, support};
use crate::{
    agent::Agent,
    auxiliary::{Objective, dim::DIM},
    batch::Batch,
    error::UpdateError,
    losses::scores::Scores,
    noise::UpdateNoise,
    settings::LearnerSettings,
};

/// Losses, values and gradients of a batch in float64.
#[derive(Clone, Debug)]
pub struct Float64 {
    /// Mean KL divergence, in nats.
    pub c51_kl: f64,
    /// `c51_kl + sum of weight * loss`.
    pub total: f64,
    /// Online values of s_t [B, A].
    pub q_values_t: Vec<f64>,
    /// Greedy action in s_{t+n} [B].
    pub next_greedy_action: Vec<u8>,
    /// Gradients of the total by parameter, before clipping.
    pub gradients: BTreeMap<String, Vec<f64>>,
}

/// Computes the losses of `batch` at the parameters of `agent` in float64, with the noise of its next update.
///
/// # Errors
/// An agent with another auxiliary objective than DIM, a batch that does not fit or leaves states out.
pub fn float64(agent: &Agent, batch: &Batch<'_>) -> Result<Float64, UpdateError> {
    float64_with(agent, batch, &agent.noise())
}

/// Online values [B, A] of `states` [B, H, W, C] in float64, by the means of noisy layers.
///
/// # Errors
/// States that do not fit the network.
pub fn q_values(agent: &Agent, states: &[u8]) -> Result<Vec<f64>, UpdateError> {
    /// States at once: what is between the layers is in memory.
    const ROWS: usize = 64;
    let len = agent.model().frame_len();
    if !states.len().is_multiple_of(len) {
        let what = format!("{} bytes are no states of {len} bytes each", states.len());
        return Err(UpdateError::Batch(what));
    }
    let online = Net::of(agent.model(), agent.online())?;
    let mut values = Vec::with_capacity(states.len() / len * agent.model().num_actions);
    for some in states.chunks(ROWS * len) {
        let f4 = online.features(some)?.global.detach();
        values.extend(online.q_values(&online.logits(&f4, None)?)?);
    }
    Ok(values)
}

/// [`float64`] with this noise of noisy layers.
fn float64_with(
    agent: &Agent,
    batch: &Batch<'_>,
    noise: &UpdateNoise,
) -> Result<Float64, UpdateError> {
    agent.check(batch)?;
    let len = agent.model().frame_len();
    let whole = [batch.rows, batch.positive_valid.len()].map(|states| states * len);
    if [batch.states_n.len(), batch.states_k.len()] != whole {
        let what = "the float64 reference computes states that rows do not have too";
        return Err(UpdateError::Batch(what.to_owned()));
    }
    let settings = agent.settings();
    let objective = settings.objective;
    if objective != Objective::NONE && objective != Objective::of(&DIM) {
        return Err(UpdateError::Settings(format!(
            "there is no float64 reference of the objective {}, only of dim and none",
            objective.name()
        )));
    }
    let online = Net::of(agent.model(), agent.online())?;
    let target = Net::of(agent.model(), agent.target())?;
    Ok(evaluate(settings, [&online, &target], batch, noise)?)
}

fn evaluate(
    settings: &LearnerSettings,
    [online, target]: [&Net<'_>; 2],
    batch: &Batch<'_>,
    noise: &UpdateNoise,
) -> candle_core::Result<Float64> {
    let (next_greedy_action, projected) = projection(settings, [online, target], batch, noise)?;
    let now = online.features(batch.states_t)?;
    let logits = online.logits(&now.global, noise.online.as_ref())?;
    let kl = kl(&logits, batch, &projected)?;
    let mut total = kl.clone();
    for (loss, weight) in dim_losses(settings, online, &now, batch)? {
        total = (total + loss.affine(weight, 0.0)?)?;
    }
    let by_var = total.backward()?;
    let mut gradients = BTreeMap::new();
    for (name, var) in &online.vars {
        let gradient = match by_var.get(var) {
            Some(gradient) => gradient.flatten_all()?.to_vec1()?,
            None => vec![0.0; var.elem_count()],
        };
        gradients.insert(name.clone(), gradient);
    }
    Ok(Float64 {
        c51_kl: kl.to_scalar()?,
        total: total.to_scalar()?,
        q_values_t: online.q_values(&online.logits(&now.global, None)?)?,
        next_greedy_action,
        gradients,
    })
}

/// Greedy actions in s_{t+n} and their distributions one Bellman step earlier [B * N].
fn projection(
    settings: &LearnerSettings,
    [online, target]: [&Net<'_>; 2],
    batch: &Batch<'_>,
    noise: &UpdateNoise,
) -> candle_core::Result<(Vec<u8>, Vec<f64>)> {
    let model = target.model;
    let f4 = target.features(batch.states_n)?.global;
    let logits = target.logits(&f4, noise.target.as_ref())?.detach();
    let values = match settings.double_dqn {
        true => {
            let f4 = online.features(batch.states_n)?.global;
            online.q_values(&online.logits(&f4, noise.choice.as_ref())?)?
        }
        false => target.q_values(&logits)?,
    };
    let greedy = |values: &[f64]| {
        let better = |best: usize, at: usize| if values[at] > values[best] { at } else { best };
        (0..values.len()).fold(0, better) as u8
    };
    let greedy: Vec<u8> = values.chunks_exact(model.num_actions).map(greedy).collect();
    let probs: Vec<f64> = softmax(&logits, D::Minus1)?.flatten_all()?.to_vec1()?;
    let support = support(model);
    let (low, high) = (support[0], support[model.atoms - 1]);
    let last = (model.atoms - 1) as f64;
    let mut projected = vec![0.0; batch.rows * model.atoms];
    for (row, out) in projected.chunks_exact_mut(model.atoms).enumerate() {
        let at = (row * model.num_actions + usize::from(greedy[row])) * model.atoms;
        let reward = f64::from(batch.n_step_return[row]);
        let discount = f64::from(batch.bootstrap_discount[row]);
        for (atom, p) in support.iter().zip(&probs[at..]) {
            let moved = (reward + discount * atom).clamp(low, high);
            let b = ((moved - low) / (high - low) * last).clamp(0.0, last);
            let (index, above) = (b.floor() as usize, b - b.floor());
            out[index] += p * (1.0 - above);
            if above > 0.0 {
                out[index + 1] += p * above;
            }
        }
    }
    Ok((greedy, projected))
}

/// Mean KL divergence of the taken actions' distributions from `projected` [B * N], of weighted rows times their weights.
fn kl(logits: &Tensor, batch: &Batch<'_>, projected: &[f64]) -> candle_core::Result<Tensor> {
    let (rows, _, atoms) = logits.dims3()?;
    let taken: Vec<u32> = batch.action.iter().map(|&action| action.into()).collect();
    let taken = Tensor::from_vec(taken, (rows, 1, 1), &Device::Cpu)?;
    let taken = taken.broadcast_as((rows, 1, atoms))?.contiguous()?;
    let log_p = log_softmax(&logits.gather(&taken, 1)?.squeeze(1)?, D::Minus1)?;
    let weight = |row: usize| batch.importance_weight.map_or(1.0, |it| it[row].into());
    let target: Vec<f64> = (0..)
        .zip(projected)
        .map(|(at, t)| weight(at / atoms) * t)
        .collect();
    let entropy: f64 = target
        .iter()
        .zip(projected)
        .filter(|&(_, &t)| t > 0.0)
        .map(|(weighted, t)| weighted * t.ln())
        .sum();
    let target = Tensor::from_vec(target, (rows, atoms), &Device::Cpu)?;
    let cross = (target * log_p)?.sum_all()?;
    cross.affine(-1.0 / rows as f64, entropy / rows as f64)
}

/// The losses of DIM's pairs with their weights; none without DIM.
fn dim_losses(
    settings: &LearnerSettings,
    online: &Net<'_>,
    now: &Levels,
    batch: &Batch<'_>,
) -> candle_core::Result<Vec<(Tensor, f64)>> {
    if settings.objective == Objective::NONE {
        return Ok(Vec::new());
    }
    let anchors = match batch.anchors {
        Some(anchors) => &online.features(anchors)?,
        None => now,
    };
    let later = online.features(batch.states_k)?;
    let scores = Scores::new(online.model.rkhs, settings.tanh_clip);
    let wanted = settings.lambda.wanted();
    let mut losses = Vec::new();
    // In the order of the lambdas: 3t3, 3t4, 4t3, 4t4.
    let levels = [(3, 3), (3, 4), (4, 3), (4, 4)];
    for ((from, to), (weight, wanted)) in levels
        .into_iter()
        .zip(settings.lambda.values().into_iter().zip(wanted))
    {
        if !wanted {
            continue;
        }
        let anchor = if from == 3 {
            &anchors.local
        } else {
            &anchors.global
        };
        let psi = online.psi(&format!("dim.psi{from}"), anchor, batch.action)?;
        let candidate = if to == 3 { &later.local } else { &later.global };
        let phi = online.head(&format!("dim.phi{to}"), candidate)?;
        losses.push((info_nce(&psi, &phi, batch.positive_valid, scores)?, weight));
    }
    Ok(losses)
}

/// InfoNCE of vectors [B, L, R] or [B, R], of which one location meets every location of the other.
fn info_nce(
    psi: &Tensor,
    phi: &Tensor,
    valid: &[u8],
    scores: Scores,
) -> candle_core::Result<Tensor> {
    let rows: Vec<u32> = (0u32..)
        .zip(valid)
        .filter(|(_, valid)| **valid != 0)
        .map(|it| it.0)
        .collect();
    let count = rows.len();
    if count == 0 {
        return Tensor::zeros((), DType::F64, &Device::Cpu);
    }
    let rows = Tensor::from_vec(rows, count, &Device::Cpu)?;
    // [L, B, R], L = 1 for global vectors.
    let located = |vectors: &Tensor| -> candle_core::Result<Tensor> {
        let vectors = vectors.index_select(&rows, 0)?;
        match vectors.rank() {
            3 => vectors.transpose(0, 1)?.contiguous(),
            _ => vectors.unsqueeze(0),
        }
    };
    let (psi, phi) = (located(psi)?, located(phi)?);
    let locations = psi.dim(0)?.max(phi.dim(0)?);
    let dots = psi.broadcast_matmul(&phi.transpose(1, 2)?.contiguous()?)?;
    let clip = scores.tanh_clip;
    let clipped = dots
        .affine(scores.scale / clip, 0.0)?
        .tanh()?
        .affine(clip, 0.0)?;
    let own = Tensor::eye(count, DType::F64, &Device::Cpu)?;
    let positives = log_softmax(&clipped, D::Minus1)?
        .broadcast_mul(&own)?
        .sum_all()?;
    positives.affine(-1.0 / (locations * count) as f64, 0.0)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use driml_model::Compute;

    use super::{
        super::{agent_of, case::Case, deviation::ErrorOfUpdate},
        *,
    };

    /// float64 by PyTorch and by candle differ in the order of their sums alone.
    const TOLERANCE: f64 = 1e-9;

    #[test]
    fn it_is_what_pytorch_computes_in_float64() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/parity");
        let mut seen = 0;
        for name in [
            "all_four",
            "c51_only",
            "dueling",
            "double_dqn_clipped",
            "global_global",
            "noisy",
            "noisy_dueling",
            "masked_positives",
            "no_action",
            "weighted_rows",
        ] {
            let bytes = std::fs::read(folder.join(format!("{name}.safetensors"))).unwrap();
            let case = Case::parse(&bytes).unwrap();
            let (agent, _) = agent_of(&case, &Compute::CPU).unwrap();
            let noise = case.noise(agent.model()).unwrap();
            let found = float64_with(&agent, &case.batch(), &noise).unwrap();
            let near = |what: &str, got: &[f64], shape: &[usize], scale: f64| {
                let expected = case.expected(what, shape).unwrap();
                for (got, expected) in got.iter().zip(&expected) {
                    let error = (got - expected).abs();
                    assert!(
                        error <= TOLERANCE * scale,
                        "{name} {what}: {got} and {expected}"
                    );
                }
            };
            let norm = case.expected("grad_norm", &[1]).unwrap()[0];
            near("loss.c51_kl", &[found.c51_kl], &[1], found.c51_kl);
            near("loss.total", &[found.total], &[1], found.total);
            near(
                "q_values_t",
                &found.q_values_t,
                &[case.rows, agent.model().num_actions],
                1.0,
            );
            let next: Vec<f64> = found
                .next_greedy_action
                .iter()
                .map(|&it| it.into())
                .collect();
            near("next_action", &next, &[case.rows], 1.0);
            for (name, tensor) in case.online() {
                if let Some(gradient) = found.gradients.get(name) {
                    near(&format!("grad.{name}"), gradient, tensor.dims(), norm);
                    seen += 1;
                }
            }
            // The learner's own f32 is right to a few of its last places.
            let drawn = float64(&agent, &case.batch()).unwrap();
            let error = ErrorOfUpdate::of(&agent, &case.batch(), &drawn).unwrap();
            assert!(
                error.loss < 1e-5 && error.gradient < 1e-4 && error.q_max < 1e-4,
                "{name}: {error:?}"
            );
            assert_eq!(
                (error.same_action, error.same_next_action),
                (1.0, 1.0),
                "{name}"
            );
        }
        assert!(seen > 60, "{seen} gradients");
    }
}
