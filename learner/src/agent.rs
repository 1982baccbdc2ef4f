//! One update: C51 plus the auxiliary loss, clipped, through Adam; then the target network's turn.
//! It does not fetch batches, publish weights or keep checkpoints, and knows no process but its own.

use std::collections::HashMap;

use candle_core::Tensor;
use driml_model::{Compute, DimHeads, Kernels, ModelConfig, Network, Parameters, StoredAs};
use driml_protocol::fail_point;
use rand_chacha::ChaCha8Rng;

use crate::{
    auxiliary::{
        key_encoder::KeyEncoder,
        loss::{AuxiliaryLoss, LossInputs, OnlineFeatures, WeightedLoss},
    },
    batch::Batch,
    bellman::{Bellman, BellmanTarget, distribution},
    error::UpdateError,
    evaluation::{Evaluation, UpdateReport},
    losses::c51::{kl_loss, row_kls},
    noise::UpdateNoise,
    optimiser::{
        adam::Adam,
        gradients::{Gradients, clip_factor},
        target,
    },
    settings::LearnerSettings,
    tensors::{finite, flat, states},
};

/// The parameters of all networks that a learner has.
#[derive(Debug)]
pub struct NetworkParameters {
    /// The network that learns.
    pub online: Parameters,
    /// C51's target network: torso and head.
    pub target: Parameters,
    /// CURL's key encoder: torso and Psi_4; there for that auxiliary loss and for no other.
    pub key: Option<Parameters>,
}

/// The learner: online and target network, CURL's key encoder, optimiser, count of updates.
#[derive(Debug)]
pub struct Agent {
    model: ModelConfig,
    settings: LearnerSettings,
    compute: Compute,
    deduplicate: bool,
    noise_seed: [u8; 32],
    auxiliary: Box<dyn AuxiliaryLoss>,
    pub(crate) online: Parameters,
    pub(crate) target: Parameters,
    online_network: Network,
    target_network: Network,
    key: Option<KeyEncoder>,
    /// Torso and head of the averaged network, if the settings ask for one.
    average: Option<Parameters>,
    pub(crate) adam: Adam,
    pub(crate) updates: u64,
}

impl Agent {
    /// A learner with initial weights drawn from `rng`, the same on every device; the slow networks are copies.
    ///
    /// # Errors
    /// Settings out of their ranges, or a model whose heads are not those that the auxiliary loss uses.
    pub fn new(
        model: ModelConfig,
        settings: LearnerSettings,
        compute: &Compute,
        rng: &mut ChaCha8Rng,
    ) -> Result<Self, UpdateError> {
        let online = Parameters::init(&model, rng, &compute.device)?;
        let key = settings.auxiliary()?.key_tau();
        let key = key.map(|_| KeyEncoder::copy_of(&online));
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
    /// As [`Agent::new`], and parameters that do not fit the model.
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
        let built = DimHeads {
            action: model.dim.embeds_action(),
            ..model.dim
        };
        let needed = settings.dim_heads(model.num_actions);
        if needed != built {
            return Err(UpdateError::Settings(format!(
                "the auxiliary_loss uses {needed:?}, the model builds {built:?}"
            )));
        }
        let kernels = compute.kernels;
        let auxiliary = settings.auxiliary()?;
        let (needed, built) = (auxiliary.layers(&model), &model.loss_layers);
        if needed != *built {
            return Err(UpdateError::Settings(format!(
                "the auxiliary_loss uses the layers {needed:?}, the model builds {built:?}"
            )));
        }
        let key = match (auxiliary.key_tau(), key) {
            (None, None) => None,
            (Some(tau), Some(key)) => Some(KeyEncoder::new(&model, tau, kernels, key)?),
            (wanted, _) => {
                let there = if wanted.is_some() { "missing" } else { "there" };
                let auxiliary_loss = settings.auxiliary_loss.name();
                return Err(UpdateError::State(format!(
                    "a key encoder is {there}, with auxiliary_loss = {auxiliary_loss}"
                )));
            }
        };
        let average = settings.average_tau.map(|_| online.without_dim());
        Ok(Self {
            average: average.transpose()?,
            online_network: Network::with_kernels(&model, &online, kernels)?,
            target_network: Network::with_kernels(&model.without_dim(), &target, kernels)?,
            key,
            adam: Adam::new(settings.adam, &online, kernels)?,
            compute: compute.clone(),
            deduplicate: false,
            noise_seed: [0; 32],
            auxiliary,
            updates: 0,
            model,
            settings,
            online,
            target,
        })
    }

    /// The same; `deduplicate` says whether equal states of a batch are computed once. Without this each is computed, and always on other
    /// devices than the CPU, whose arithmetic takes less time than the CPU's checksums.
    #[must_use]
    pub const fn with_deduplication(mut self, deduplicate: bool) -> Self {
        self.deduplicate = deduplicate && matches!(self.compute.kernels, Kernels::Fused(_));
        self
    }

    /// The same, with the noise of noisy layers drawn from this seed and the number of the update. Without this it is the seed 0.
    #[must_use]
    pub const fn with_noise_seed(mut self, noise_seed: [u8; 32]) -> Self {
        self.noise_seed = noise_seed;
        self
    }

    /// The online network's sizes, its auxiliary heads included.
    pub const fn model(&self) -> &ModelConfig {
        &self.model
    }

    /// The settings of its updates.
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

    /// The parameters of CURL's key encoder, if that is the auxiliary loss.
    pub fn key(&self) -> Option<&Parameters> {
        self.key.as_ref().map(KeyEncoder::parameters)
    }

    /// The averaged network's parameters, torso and head, if the settings ask for one: after each update they move
    /// `average_tau` of the way to the online network's. They start as a copy of it.
    pub const fn average(&self) -> Option<&Parameters> {
        self.average.as_ref()
    }

    /// Puts the averaged weights, if there are any, into torso and head of the online network, to play with. Says whether there were.
    pub fn take_average(&mut self) -> Result<bool, UpdateError> {
        for (name, var) in self.average.iter().flat_map(Parameters::iter) {
            if let Some(online) = self.online.get(name) {
                online.set(var)?;
            }
        }
        Ok(self.average.is_some())
    }

    /// What actors need, torso and head, as safetensors bytes.
    ///
    /// # Errors
    /// A weight that is not finite; a failing serialisation.
    pub fn weights(&self) -> Result<Vec<u8>, UpdateError> {
        self.weights_as(StoredAs::F32)
    }

    /// [`Agent::weights`] with scalars of another type.
    ///
    /// # Errors
    /// As there, and a weight that is too large for the type.
    pub fn weights_as(&self, stored: StoredAs) -> Result<Vec<u8>, UpdateError> {
        let acting = |name: &str| !name.starts_with(target::AUXILIARY_PREFIX);
        Ok(self.online.to_safetensors_as(stored, acting)?)
    }

    /// Learns from one batch.
    ///
    /// # Errors
    /// A batch that does not fit, or losses or gradients that are not finite: nothing has then changed. A step beyond the
    /// finite numbers, [`UpdateError::Diverged`]: the learner is then good for nothing, and can be neither published nor saved.
    pub fn update(&mut self, batch: &Batch<'_>) -> Result<UpdateReport, UpdateError> {
        fail_point::hold(self.updates());
        // On a thread of the pool: from outside, every product would wake the pool up and be woken by it.
        rayon::scope(|_| {
            let evaluation = self.evaluate(batch)?;
            let grad_norm = self.apply(&evaluation.gradients)?;
            let taken = evaluation.taken_logits.unsqueeze(1)?;
            let q_sum: f32 = flat(&self.online_network.q_values(&taken)?)?.iter().sum();
            Ok(UpdateReport {
                c51_kl: evaluation.c51_kl,
                row_kls: evaluation.row_kls,
                losses: evaluation.losses,
                total: evaluation.total,
                grad_norm,
                q_mean: q_sum / batch.rows as f32,
            })
        })
    }

    /// Checks that `batch` is one of this network's and auxiliary loss's.
    pub(crate) fn check(&self, batch: &Batch<'_>) -> Result<(), UpdateError> {
        batch.validate(&self.model, self.settings.auxiliary_loss.positives())
    }

    /// The noise of the next update's noisy layers.
    pub fn noise(&self) -> UpdateNoise {
        UpdateNoise::draw(&self.model, self.noise_seed, self.updates)
    }

    /// Losses and gradients of one batch at the present parameters, with the noise of the next update.
    ///
    /// # Errors
    /// A batch that does not fit, or losses that are not finite.
    pub fn evaluate(&self, batch: &Batch<'_>) -> Result<Evaluation, UpdateError> {
        self.evaluate_with(batch, &self.noise())
    }

    /// [`Agent::evaluate`] with this noise of noisy layers.
    ///
    /// # Errors
    /// As there, and noise for a head without noisy layers.
    pub fn evaluate_with(
        &self,
        batch: &Batch<'_>,
        noise: &UpdateNoise,
    ) -> Result<Evaluation, UpdateError> {
        self.check(batch)?;
        // Neither needs the other: what one does on a single thread falls into the other's products.
        let (target, features) = rayon::join(
            || self.bellman().target(batch, noise),
            || {
                OnlineFeatures::new(
                    &self.online_network,
                    &self.model,
                    &*self.auxiliary,
                    batch,
                    self.deduplicate,
                    &self.compute.device,
                )
            },
        );
        let BellmanTarget {
            next_greedy_action,
            projection: target_projection,
        } = target?;
        let features = features?;
        let taken_logits = self.online_network.taken_logits(
            &features.now.f4,
            batch.action,
            noise.online.as_ref(),
        )?;
        let kl = kl_loss(
            &taken_logits,
            target_projection.clone(),
            batch.importance_weight.map(<[f32]>::to_vec),
            self.compute.kernels,
        )?;
        let auxiliary = self.auxiliary.losses(&LossInputs {
            online: &self.online_network,
            model: &self.model,
            batch,
            features: &features,
            key: self.key.as_ref(),
            device: &self.compute.device,
        })?;
        let mut total = kl.clone();
        for WeightedLoss { loss, weight, .. } in &auxiliary {
            total = (total + loss.affine(*weight, 0.0)?)?;
        }
        // Before any number is read: reading waits for a GPU, which should have all its work by then.
        let gradients = Gradients::of(&self.online, &total)?;
        let c51_kl = finite("the C51 loss", &kl)?;
        let mut losses = Vec::with_capacity(auxiliary.len());
        for WeightedLoss { name, loss, .. } in &auxiliary {
            losses.push((*name, finite(name, loss)?));
        }
        let taken_logits = taken_logits.detach();
        let row_kls = match batch.importance_weight {
            None => Vec::new(),
            Some(_) => {
                let kls = row_kls(&flat(&taken_logits)?, &target_projection, self.model.atoms);
                kls.into_iter().map(|kl| kl as f32).collect()
            }
        };
        Ok(Evaluation {
            c51_kl,
            row_kls,
            losses,
            total: finite("the total loss", &total)?,
            taken_logits,
            next_greedy_action,
            target_projection,
            gradients,
        })
    }

    /// Online values [B, A] of the batch's s_t, by a pass of their own: an update needs those of the actions taken alone. Without noise:
    /// of noisy layers the means serve.
    pub fn q_values_t(&self, batch: &Batch<'_>) -> Result<Vec<f32>, UpdateError> {
        let states = states(&self.model, batch.states_t, &self.compute.device)?;
        let logits = distribution(&self.online_network, &states, None)?;
        Ok(flat(&self.online_network.q_values(&logits)?)?)
    }

    /// Clips `gradients` and takes one step with them; moves the slow networks whose turn it is.
    /// Returns their global norm before clipping.
    pub fn apply(&mut self, gradients: &Gradients) -> Result<f64, UpdateError> {
        let norm = gradients.norm(self.compute.kernels)?;
        self.adam.step(
            &self.online,
            gradients,
            clip_factor(norm, self.settings.max_grad_norm),
        )?;
        self.updates += 1;
        if let Some(key) = &self.key {
            key.follow(&self.online)?;
        }
        if let (Some(average), Some(tau)) = (&self.average, self.settings.average_tau) {
            target::follow(average, &self.online, tau, self.compute.kernels)?;
        }
        if self
            .updates
            .is_multiple_of(self.settings.target_period_updates)
        {
            let (tau, kernels) = (self.settings.target_tau, self.compute.kernels);
            target::follow(&self.target, &self.online, tau, kernels)?;
        }
        Ok(norm)
    }

    pub(crate) fn restore_average(&mut self, average: Parameters) {
        self.average = Some(average);
    }

    const fn bellman(&self) -> Bellman<'_> {
        Bellman {
            model: &self.model,
            compute: &self.compute,
            online: &self.online_network,
            target: &self.target_network,
            double_dqn: self.settings.double_dqn,
            deduplicate: self.deduplicate,
        }
    }

    /// Puts back a state that [`Agent::online`], [`Agent::target`] and [`Adam`] had after `updates` updates.
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
