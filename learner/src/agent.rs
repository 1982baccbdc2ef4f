//! One update: the gradients of a batch, clipped, through Adam; then the target network's turn.
//! It does not fetch batches, publish weights or keep checkpoints, and knows no process but its own.

use std::collections::HashMap;

use candle_core::Tensor;
use driml_model::{
    Compute, DimHeads, Encoder, Kernels, ModelConfig, Network, Parameters, StoredAs, is_dim,
};
use driml_protocol::fail_point;
use rand_chacha::ChaCha8Rng;

use crate::{
    batch::Batch,
    error::UpdateError,
    evaluation::{Evaluation, Networks, UpdateReport, distribution},
    noise::UpdateNoise,
    optimiser::{
        adam::Adam,
        gradients::{Gradients, clip_factor},
        target,
    },
    settings::UpdateSettings,
    tensors::{flat, states},
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
    networks: Networks,
    target: Parameters,
    key: Option<Parameters>,
    /// Torso and head of the averaged network; there after the first update, if the settings ask for one.
    average: Option<Parameters>,
    noise_seed: [u8; 32],
    pub(crate) adam: Adam,
    updates: u64,
}

impl Agent {
    /// A learner with initial weights drawn from `rng`, the same on every device; the slow networks are copies.
    ///
    /// # Errors
    /// Settings out of their ranges, or a model whose heads are not those that the auxiliary loss uses.
    pub fn new(
        model: ModelConfig,
        settings: UpdateSettings,
        compute: &Compute,
        rng: &mut ChaCha8Rng,
    ) -> Result<Self, UpdateError> {
        let online = Parameters::init(&model, rng, &compute.device)?;
        let key = settings.auxiliary()?.key_tau();
        let key = key.map(|_| online.copy_part(Encoder::has));
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
        settings: UpdateSettings,
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
        let encoder = match (auxiliary.key_tau(), &key) {
            (None, None) => None,
            (Some(_), Some(key)) => Some(Encoder::new(&model, key, kernels)?),
            (wanted, _) => {
                let there = if wanted.is_some() { "missing" } else { "there" };
                let auxiliary_loss = settings.auxiliary_loss.name();
                return Err(UpdateError::State(format!(
                    "a key encoder is {there}, with auxiliary_loss = {auxiliary_loss}"
                )));
            }
        };
        Ok(Self {
            average: None,
            noise_seed: [0; 32],
            adam: Adam::new(settings.adam, &online, kernels)?,
            updates: 0,
            networks: Networks {
                online: Network::new(&model, &online, kernels)?,
                target: Network::new(&model.without_dim(), &target, kernels)?,
                compute: compute.clone(),
                deduplicate: false,
                auxiliary,
                parameters: online,
                key: encoder,
                model,
                settings,
            },
            target,
            key,
        })
    }

    /// The same; `deduplicate` says whether equal states of a batch are computed once. Without this each is computed, and always on other
    /// devices than the CPU, whose arithmetic takes less time than the CPU's checksums.
    #[must_use]
    pub const fn with_deduplication(mut self, deduplicate: bool) -> Self {
        let kernels = self.networks.compute.kernels;
        self.networks.deduplicate = deduplicate && matches!(kernels, Kernels::Fused(_));
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
        &self.networks.model
    }

    /// The settings of its updates.
    pub const fn settings(&self) -> &UpdateSettings {
        &self.networks.settings
    }

    /// Updates taken since the run began, those before a restart included.
    pub const fn updates(&self) -> u64 {
        self.updates
    }

    /// The online network's parameters.
    pub const fn online(&self) -> &Parameters {
        &self.networks.parameters
    }

    /// The target network's parameters.
    pub const fn target(&self) -> &Parameters {
        &self.target
    }

    /// The parameters of CURL's key encoder, if that is the auxiliary loss.
    pub const fn key(&self) -> Option<&Parameters> {
        self.key.as_ref()
    }

    /// The averaged network's parameters, torso and head, if the settings ask for one and an update was taken. They begin as a copy of
    /// the online network's; after each later update, number t of the run, they move `max(average_tau, 1 / t)` of the way to those.
    pub const fn average(&self) -> Option<&Parameters> {
        self.average.as_ref()
    }

    /// Puts the averaged weights, if there are any, into torso and head of the online network, to play with. Says whether there were.
    pub fn take_average(&mut self) -> Result<bool, UpdateError> {
        for (name, var) in self.average.iter().flat_map(Parameters::iter) {
            if let Some(online) = self.online().get(name) {
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
        Ok(self
            .online()
            .to_safetensors_as(stored, |name| !is_dim(name))?)
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
            let q_sum: f32 = flat(&self.networks.online.q_values(&taken)?)?.iter().sum();
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
        batch.validate(self.model(), self.settings().auxiliary_loss.positives())
    }

    /// The noise of the next update's noisy layers.
    pub fn noise(&self) -> UpdateNoise {
        UpdateNoise::draw(self.model(), self.noise_seed, self.updates)
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
        self.networks.evaluate(batch, noise)
    }

    /// Online values [B, A] of the batch's s_t, by a pass of their own: an update needs those of the actions taken alone. Without noise:
    /// of noisy layers the means serve.
    pub fn q_values_t(&self, batch: &Batch<'_>) -> Result<Vec<f32>, UpdateError> {
        let networks = &self.networks;
        let states = states(self.model(), batch.states_t, &networks.compute.device)?;
        let logits = distribution(&networks.online, &states, None)?;
        Ok(flat(&networks.online.q_values(&logits)?)?)
    }

    /// Clips `gradients` and takes one step with them; moves the slow networks whose turn it is.
    /// Returns their global norm before clipping.
    pub fn apply(&mut self, gradients: &Gradients) -> Result<f64, UpdateError> {
        let Networks {
            settings,
            compute,
            parameters: online,
            auxiliary,
            ..
        } = &self.networks;
        let kernels = compute.kernels;
        let norm = gradients.norm(kernels)?;
        let factor = clip_factor(norm, settings.max_grad_norm);
        self.adam.step(online, gradients, factor)?;
        self.updates += 1;
        if let (Some(key), Some(tau)) = (&self.key, auxiliary.key_tau()) {
            target::follow(key, online, tau, kernels)?;
        }
        match (&self.average, settings.average_tau) {
            (Some(average), Some(tau)) => {
                let rate = tau.max(1.0 / self.updates as f64);
                target::follow(average, online, rate, kernels)?;
            }
            (None, Some(_)) => self.average = Some(online.without_dim()?),
            (_, None) => {}
        }
        if self.updates.is_multiple_of(settings.target_period_updates) {
            target::follow(&self.target, online, settings.target_tau, kernels)?;
        }
        Ok(norm)
    }

    pub(crate) fn restore_average(&mut self, average: Parameters) {
        self.average = Some(average);
    }

    /// Puts back a state that [`Agent::online`], [`Agent::target`] and [`Adam`] had after `updates` updates.
    pub(crate) fn restore_progress(
        &mut self,
        updates: u64,
        adam_step: u64,
        moments: HashMap<String, Tensor>,
    ) -> Result<(), UpdateError> {
        let device = &self.networks.compute.device;
        self.adam.restore(adam_step, moments, device)?;
        self.updates = updates;
        Ok(())
    }
}
