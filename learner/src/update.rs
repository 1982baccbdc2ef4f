//! One update: C51 plus the auxiliary objective, clipped, through Adam; then the target network's turn.
//! It does not fetch batches, publish weights or keep checkpoints, and knows no process but its own.

use std::{borrow::Cow, collections::HashMap};

use candle_core::{Device, Tensor};
use driml_model::{Compute, DimParts, Features, ModelConfig, Network, Parameters};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    auxiliary::{
        Auxiliary, Objective,
        cpc::{self, Cpc},
        curl::{Curl, CurlSettings, KeyEncoder},
        dim::{Dim, Lambda, PAIRS},
    },
    batch::Batch,
    gradients::{Gradients, clip_factor},
    loss::{
        c51::{kl_loss, softmax},
        projection::project,
    },
    optim::{Adam, AdamSettings},
    target,
};

/// Everything that one update depends on beside the network's sizes. No field has a default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearnerSettings {
    /// Choose the action in s_{t+n} by the online network instead of the target network.
    pub double_dqn: bool,
    /// The auxiliary objective.
    pub objective: Objective,
    /// Whether Psi is given a_t, in a world where there is something to decide.
    pub condition_on_action: bool,
    /// Weights of the auxiliary losses, by pair of levels; all 0 for an agent without any.
    pub lambda: Lambda,
    /// Bound c of the auxiliary scores' soft clip `c * tanh(x / c)`, above 0.
    pub tanh_clip: f64,
    /// Global 2-norm to which gradients are clipped, above 0.
    pub max_grad_norm: f64,
    /// The optimiser's numbers.
    pub adam: AdamSettings,
    /// The target network moves once in so many updates, at least 1.
    pub target_period_updates: u64,
    /// Share of the online network in a move of the target network, in (0, 1].
    pub target_tau: f64,
    /// CURL's key encoder; there for that objective and for no other.
    pub curl: Option<CurlSettings>,
}

impl LearnerSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// The first setting out of its range, with its value.
    pub fn validate(&self) -> Result<(), UpdateError> {
        let above_0 = |x: f64| x > 0.0 && x.is_finite();
        for (name, value, fine) in [
            ("tanh_clip", self.tanh_clip, above_0(self.tanh_clip)),
            (
                "max_grad_norm",
                self.max_grad_norm,
                above_0(self.max_grad_norm),
            ),
            (
                "target_tau",
                self.target_tau,
                above_0(self.target_tau) && self.target_tau <= 1.0,
            ),
            ("target_period_updates", 0.0, self.target_period_updates > 0),
        ] {
            if !fine {
                return Err(UpdateError::Settings(format!("{name} = {value}")));
            }
        }
        self.lambda.validate()?;
        self.objective
            .check(&self.lambda, self.condition_on_action, self.curl.as_ref())
            .map_err(UpdateError::Objective)?;
        if let Some(curl) = &self.curl {
            curl.validate()?;
        }
        self.adam.validate()
    }

    /// The auxiliary objective.
    pub fn auxiliary(&self) -> Auxiliary {
        let Self {
            lambda, tanh_clip, ..
        } = *self;
        let pairs = Dim { lambda, tanh_clip };
        match self.objective {
            Objective::None => Auxiliary::None,
            Objective::Dim => Auxiliary::Dim(pairs),
            Objective::Cpc => Auxiliary::Cpc(Cpc { pairs }),
            Objective::Curl => Auxiliary::Curl(Curl { tanh_clip }),
        }
    }

    /// The heads that the online network needs in a world of `num_actions` actions.
    pub fn dim_parts(&self, num_actions: usize) -> DimParts {
        let action = self.condition_on_action && num_actions > 1;
        self.objective.heads(&self.lambda, action)
    }
}

/// Why an update, or the making of a learner, did not happen. But for [`UpdateError::Diverged`] parameters are then as they
/// were before.
#[derive(Debug, thiserror::Error)]
pub enum UpdateError {
    /// The batch is not one of this network's, or holds values that no world gives.
    #[error("this batch cannot be learned from: {0}")]
    Batch(String),
    /// A setting out of its range.
    #[error("{0}: that cannot work; start from a preset")]
    Settings(String),
    /// Settings of the auxiliary objective that are at odds with each other.
    #[error("{0}")]
    Objective(String),
    /// State that does not fit the network, as from another run's checkpoint.
    #[error("learner state does not fit: {0}")]
    State(String),
    /// The arithmetic left the finite numbers.
    #[error("{what} is not finite; the update is not taken")]
    NonFinite {
        /// The first quantity in which it showed.
        what: String,
    },
    /// The step itself left the finite numbers: this learner cannot go on, nor be published or saved.
    #[error(
        "the update took {name} beyond the finite numbers; the learner cannot go on from here: go on from the newest checkpoint with \
         a learner.update.adam.lr below {lr:e}"
    )]
    Diverged {
        /// The first parameter in which it showed.
        name: String,
        /// The learning rate.
        lr: f64,
    },
    /// The model refused.
    #[error(transparent)]
    Model(#[from] driml_model::ModelError),
    /// The tensor library refused.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// What one update did, for a person to watch.
#[derive(Clone, Debug, PartialEq)]
pub struct UpdateReport {
    /// Mean KL divergence of the prediction from the projected target, in nats.
    pub c51_kl: f32,
    /// Auxiliary losses in nats, in the order of [`PAIRS`]; `None` for pairs of weight 0.
    pub dim: [Option<f32>; 4],
    /// `c51_kl + sum of lambda * dim`.
    pub total: f32,
    /// Global 2-norm of the gradients before clipping.
    pub grad_norm: f64,
    /// Mean over rows of the taken action's value, in units of return.
    pub q_mean: f32,
}

/// The losses of a batch and all that led to them, before any step is taken.
#[derive(Debug)]
pub struct Evaluation {
    /// Mean KL divergence, in nats.
    pub c51_kl: f32,
    /// Auxiliary losses in nats, in the order of [`PAIRS`]; `None` for pairs of weight 0.
    pub dim: [Option<f32>; 4],
    /// `c51_kl + sum of lambda * dim`.
    pub total: f32,
    /// Online values of s_t [B, A].
    pub q_values_t: Vec<f32>,
    /// Greedy action in s_{t+n} [B].
    pub next_greedy_action: Vec<u8>,
    /// Projected target distributions [B, N].
    pub target_projection: Vec<f32>,
    /// Gradients of the total, before clipping.
    pub gradients: Gradients,
}

/// The parameters of all networks that a learner has.
#[derive(Debug)]
pub struct NetworkParameters {
    /// The network that learns.
    pub online: Parameters,
    /// C51's target network: torso and head.
    pub target: Parameters,
    /// CURL's key encoder: torso and Psi_4; there for that objective and for no other.
    pub key: Option<Parameters>,
}

/// The learner: online and target network, CURL's key encoder, optimiser, count of updates.
#[derive(Debug)]
pub struct Learner {
    model: ModelConfig,
    settings: LearnerSettings,
    compute: Compute,
    auxiliary: Auxiliary,
    pub(crate) online: Parameters,
    pub(crate) target: Parameters,
    online_network: Network,
    target_network: Network,
    key: Option<KeyEncoder>,
    pub(crate) adam: Adam,
    pub(crate) updates: u64,
}

impl Learner {
    /// A learner with initial weights drawn from `rng`, the same on every device; the slow networks are copies.
    ///
    /// # Errors
    /// Settings out of their ranges, or a model whose heads are not those that the objective uses.
    pub fn new(
        model: ModelConfig,
        settings: LearnerSettings,
        compute: &Compute,
        rng: &mut ChaCha8Rng,
    ) -> Result<Self, UpdateError> {
        let online = Parameters::init(&model, rng, &compute.device)?;
        let key = settings.curl.map(|_| KeyEncoder::copy_of(&online));
        let parameters = NetworkParameters {
            target: online.without_dim()?,
            key: key.transpose()?,
            online,
        };
        Self::from_parameters(model, settings, compute, parameters)
    }

    /// A learner with given weights, on the device of `compute`, before its first update.
    ///
    /// # Errors
    /// As [`Learner::new`], and parameters that do not fit the model.
    pub fn from_parameters(
        model: ModelConfig,
        settings: LearnerSettings,
        compute: &Compute,
        parameters: NetworkParameters,
    ) -> Result<Self, UpdateError> {
        settings.validate()?;
        let NetworkParameters {
            online,
            target,
            key,
        } = parameters;
        let built = DimParts {
            action: model.dim.embeds_action(),
            ..model.dim
        };
        let needed = settings.dim_parts(model.num_actions);
        if needed != built {
            return Err(UpdateError::Settings(format!(
                "the objective uses {needed:?}, the model builds {built:?}"
            )));
        }
        let operations = compute.operations;
        let key = match (settings.curl, key) {
            (None, None) => None,
            (Some(curl), Some(key)) => Some(KeyEncoder::new(&model, curl, operations, key)?),
            (wanted, _) => {
                let there = if wanted.is_some() { "missing" } else { "there" };
                let objective = settings.objective.name();
                return Err(UpdateError::State(format!(
                    "a key encoder is {there}, with objective = {objective}"
                )));
            }
        };
        Ok(Self {
            online_network: Network::with_operations(&model, &online, operations)?,
            target_network: Network::with_operations(&model.without_dim(), &target, operations)?,
            key,
            adam: Adam::new(settings.adam, &online, operations)?,
            compute: compute.clone(),
            auxiliary: settings.auxiliary(),
            updates: 0,
            model,
            settings,
            online,
            target,
        })
    }

    /// The network's sizes.
    pub const fn model(&self) -> &ModelConfig {
        &self.model
    }

    /// The settings.
    pub const fn settings(&self) -> &LearnerSettings {
        &self.settings
    }

    /// Updates taken since the run began, those before a restart included.
    pub const fn updates(&self) -> u64 {
        self.updates
    }

    /// The online network's parameters.
    pub const fn online(&self) -> &Parameters {
        &self.online
    }

    /// The target network's parameters.
    pub const fn target(&self) -> &Parameters {
        &self.target
    }

    /// The parameters of CURL's key encoder, if that is the objective.
    pub fn key(&self) -> Option<&Parameters> {
        self.key.as_ref().map(KeyEncoder::parameters)
    }

    /// What actors need, torso and head, as safetensors bytes.
    ///
    /// # Errors
    /// A weight that is not finite; a failing serialisation.
    pub fn weights(&self) -> Result<Vec<u8>, UpdateError> {
        Ok(self
            .online
            .to_safetensors(|name| !name.starts_with(target::AUXILIARY_PREFIX))?)
    }

    /// Learns from one batch.
    ///
    /// # Errors
    /// A batch that does not fit, or losses or gradients that are not finite: nothing has then changed. A step beyond the
    /// finite numbers, [`UpdateError::Diverged`]: the learner is then good for nothing, and can be neither published nor saved.
    pub fn update(&mut self, batch: &Batch<'_>) -> Result<UpdateReport, UpdateError> {
        let evaluation = self.evaluate(batch)?;
        let grad_norm = self.apply(&evaluation.gradients)?;
        let num_actions = self.model.num_actions;
        let taken = evaluation
            .q_values_t
            .chunks_exact(num_actions)
            .zip(batch.action);
        let q_sum: f32 = taken.map(|(q, &action)| q[usize::from(action)]).sum();
        Ok(UpdateReport {
            c51_kl: evaluation.c51_kl,
            dim: evaluation.dim,
            total: evaluation.total,
            grad_norm,
            q_mean: q_sum / batch.rows as f32,
        })
    }

    /// Checks that `batch` is one of this network's and objective's.
    ///
    /// # Errors
    /// [`UpdateError::Batch`] with what is wrong with it.
    pub(crate) fn check(&self, batch: &Batch<'_>) -> Result<(), UpdateError> {
        batch.validate(&self.model, &self.auxiliary)
    }

    /// Losses and gradients of one batch at the present parameters.
    ///
    /// # Errors
    /// A batch that does not fit, or losses that are not finite.
    pub fn evaluate(&self, batch: &Batch<'_>) -> Result<Evaluation, UpdateError> {
        self.check(batch)?;
        let (next_greedy_action, target_projection) = self.make_target(batch)?;

        let features_t = self
            .online_network
            .features(&self.frames(batch.rows, batch.states_t)?)?;
        let logits = self.online_network.logits(&features_t.f4)?;
        let q_values_t = self.online_network.q_values(&logits.detach())?;
        let kl = kl_loss(
            &logits,
            batch.action,
            target_projection.clone(),
            self.compute.operations,
        )?;
        let losses = self.auxiliary_losses(batch, &features_t)?;
        let mut total = kl.clone();
        for (loss, lambda) in losses.iter().zip(self.settings.lambda.values()) {
            if let Some(loss) = loss {
                total = (total + loss.affine(lambda, 0.0)?)?;
            }
        }
        // Before any number is read: reading waits for a GPU, which should have all its work by then.
        let gradients = Gradients::take(&self.online, total.backward()?)?;
        let c51_kl = finite("the C51 loss", &kl)?;
        let mut dim = [None; 4];
        for ((value, loss), pair) in dim.iter_mut().zip(&losses).zip(PAIRS) {
            if let Some(loss) = loss {
                *value = Some(finite(pair, loss)?);
            }
        }
        Ok(Evaluation {
            c51_kl,
            dim,
            total: finite("the total loss", &total)?,
            q_values_t: flat(&q_values_t)?,
            next_greedy_action,
            target_projection,
            gradients,
        })
    }

    /// The auxiliary losses, in the order of [`PAIRS`], before their weights; the torso sees what they need and no more.
    ///
    /// `features_t` are the online network's of the plain s_t, which serve again where the objective sees it plain.
    fn auxiliary_losses(
        &self,
        batch: &Batch<'_>,
        features_t: &Features,
    ) -> Result<[Option<Tensor>; 4], UpdateError> {
        if self.auxiliary == Auxiliary::None {
            return Ok([const { None }; 4]);
        }
        let online = &self.online_network;
        let seen = match batch.anchors {
            Some(anchors) => Some(online.features(&self.frames(batch.rows, anchors)?)?),
            None => None,
        };
        let anchors = seen.as_ref().unwrap_or(features_t);
        // The network looks at them on the CPU.
        let action = Tensor::from_slice(batch.action, batch.rows, &Device::Cpu)?;
        let valid = batch.positive_valid;
        match &self.auxiliary {
            Auxiliary::None => Ok([const { None }; 4]),
            Auxiliary::Dim(dim) => {
                let later = online.features(&self.frames(batch.rows, batch.states_k)?)?;
                dim.losses(online, anchors, &later, &action, valid)
            }
            Auxiliary::Cpc(cpc) => {
                let there = cpc::present(batch.states_k, valid);
                let count = valid.iter().filter(|&&valid| valid != 0).count();
                let later = match count {
                    0 => None,
                    _ => Some(online.features(&self.frames(count, there)?)?),
                };
                cpc.losses(online, anchors, later.as_ref(), &action, valid)
            }
            Auxiliary::Curl(curl) => {
                let encoder = self.key.as_ref();
                let encoder = encoder.expect("a learner with this objective is made with one");
                let keys = encoder.keys(&self.frames(batch.rows, batch.states_k)?)?;
                curl.losses(online, anchors, &keys, &action)
            }
        }
    }

    /// Clips `gradients` and takes one step with them; moves the slow networks whose turn it is.
    /// Returns their global norm before clipping.
    ///
    /// # Errors
    /// As [`Learner::update`].
    pub fn apply(&mut self, gradients: &Gradients) -> Result<f64, UpdateError> {
        let norm = gradients.norm(self.compute.operations)?;
        self.adam.step(
            &self.online,
            gradients,
            clip_factor(norm, self.settings.max_grad_norm),
        )?;
        self.updates += 1;
        if let Some(key) = &self.key {
            key.follow(&self.online)?;
        }
        if self
            .updates
            .is_multiple_of(self.settings.target_period_updates)
        {
            let (tau, operations) = (self.settings.target_tau, self.compute.operations);
            target::follow(&self.target, &self.online, tau, operations)?;
        }
        Ok(norm)
    }

    /// Greedy actions in s_{t+n} [B] and their distributions one Bellman step earlier [B, N], without a graph.
    fn make_target(&self, batch: &Batch<'_>) -> Result<(Vec<u8>, Vec<f32>), UpdateError> {
        let ModelConfig {
            num_actions,
            atoms,
            v_min,
            v_max,
            ..
        } = self.model;
        let states_n = self.frames(batch.rows, batch.states_n)?;
        let target_logits = distribution(&self.target_network, &states_n)?;
        let next_q_values = if self.settings.double_dqn {
            self.online_network
                .q_values(&distribution(&self.online_network, &states_n)?)?
        } else {
            self.target_network.q_values(&target_logits)?
        };
        let next_greedy: Vec<u8> = flat(&next_q_values)?
            .chunks_exact(num_actions)
            .map(greedy)
            .collect();

        let logits = flat(&target_logits)?;
        let mut probs = vec![0f32; batch.rows * atoms];
        for (row, (probs, &action)) in probs.chunks_exact_mut(atoms).zip(&next_greedy).enumerate() {
            let at = (row * num_actions + usize::from(action)) * atoms;
            softmax(&logits[at..at + atoms], probs);
        }
        if !probs.iter().all(|p| p.is_finite()) {
            return Err(UpdateError::NonFinite {
                what: "the target network's distribution".to_owned(),
            });
        }
        let mut projected = vec![0f32; probs.len()];
        project(
            &probs,
            batch.n_step_return,
            batch.bootstrap_discount,
            v_min,
            v_max,
            &mut projected,
        );
        Ok((next_greedy, projected))
    }

    fn frames<'a>(
        &self,
        rows: usize,
        frames: impl Into<Cow<'a, [u8]>>,
    ) -> Result<Tensor, UpdateError> {
        let ModelConfig {
            height,
            width,
            channels,
            ..
        } = self.model;
        let shape = (rows, height, width, channels);
        // Bytes travel to the device; they become numbers there.
        let device = &self.compute.device;
        Ok(match frames.into() {
            Cow::Borrowed(frames) => Tensor::from_slice(frames, shape, device)?,
            Cow::Owned(frames) => Tensor::from_vec(frames, shape, device)?,
        })
    }

    /// Puts back a state that [`Learner::online`], [`Learner::target`] and [`Adam`] had after `updates` updates.
    pub(crate) fn restore_progress(
        &mut self,
        updates: u64,
        adam_step: u64,
        moments: HashMap<String, Tensor>,
    ) -> Result<(), UpdateError> {
        self.adam
            .restore(adam_step, moments, &self.compute.device)?;
        self.updates = updates;
        Ok(())
    }
}

/// Logits [B, A, N] of `frames`, cut off from any graph.
fn distribution(network: &Network, frames: &Tensor) -> Result<Tensor, UpdateError> {
    Ok(network.logits(&network.features(frames)?.f4)?.detach())
}

fn flat(tensor: &Tensor) -> Result<Vec<f32>, UpdateError> {
    Ok(tensor.flatten_all()?.to_vec1()?)
}

/// Index of the first largest value.
fn greedy(values: &[f32]) -> u8 {
    let mut best = 0;
    for (i, value) in values.iter().enumerate() {
        if *value > values[best] {
            best = i;
        }
    }
    u8::try_from(best).expect("a model has at most 255 actions")
}

fn finite(what: &str, loss: &Tensor) -> Result<f32, UpdateError> {
    let value = loss.to_scalar::<f32>()?;
    if value.is_finite() {
        Ok(value)
    } else {
        Err(UpdateError::NonFinite {
            what: what.to_owned(),
        })
    }
}
