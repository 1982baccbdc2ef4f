//! One update: computes the gradients of a batch, clips them, takes an Adam step and moves the target network.
//! It does not fetch batches, publish weights or save checkpoints, and communicates with no other process.

use driml_model::{
    Compute, DimHeads, Encoder, Kernels, ModelConfig, Network, Parameters, WeightDtype, is_dim,
};
use driml_protocol::{LearnerStatus, fail_point};
use rand_chacha::ChaCha8Rng;

use crate::{
    batch::Batch,
    error::{Result, UpdateError},
    losses_and_gradients::{Losses, LossesAndGradients, Networks, UpdateNoise, detached_logits},
    optimiser::{
        adam::Adam,
        gradients::{Gradients, clip_factor},
        target,
    },
    settings::UpdateSettings,
    tensors::{states_tensor, to_vec_f32},
};

/// The parameters of all networks of an agent.
#[derive(Debug)]
pub struct NetworkParameters {
    /// The network that learns.
    pub online: Parameters,
    /// C51's target network: torso and head.
    pub target: Parameters,
    /// The key encoder, torso and Psi_4; `None` unless the auxiliary loss has one, as CURL does.
    pub key_encoder: Option<Parameters>,
}

/// The results of one update, as in a row of metrics.
#[derive(Clone, Debug, PartialEq)]
pub struct UpdateReport {
    /// The losses before the update.
    pub losses: Losses,
    /// Global 2-norm of the gradients before clipping.
    pub grad_norm: f64,
    /// Mean over rows of the taken action's value, in units of return.
    pub q_mean: f32,
}

impl UpdateReport {
    /// Writes the results of the last of `updates` updates into `status`.
    pub fn write_status(&self, updates: u64, status: &mut LearnerStatus) {
        status.updates = updates;
        status.c51_kl = self.losses.c51_kl;
        let losses = self.losses.auxiliary.iter();
        status.losses = losses.map(|&(name, loss)| (name.into(), loss)).collect();
        status.total = self.losses.total;
        status.grad_norm = self.grad_norm;
        status.q_mean = self.q_mean;
    }
}

/// An agent: online and target network, key encoder, optimiser, count of updates.
#[derive(Debug)]
pub struct Agent {
    pub(crate) networks: Networks,
    target: Parameters,
    key_encoder: Option<Parameters>,
    /// Torso and head of the averaged network; `None` before the first update, and without `average_tau`.
    pub(crate) average: Option<Parameters>,
    noise_seed: [u8; 32],
    pub(crate) adam: Adam,
    pub(crate) updates: u64,
}

impl Agent {
    /// Creates an agent with initial weights drawn from `rng`, the same on every device. The target network and the key encoder are copies.
    ///
    /// # Errors
    /// Settings out of their ranges, or a model whose heads and layers are not those that the auxiliary loss uses.
    pub fn new(
        model: ModelConfig,
        settings: UpdateSettings,
        compute: &Compute,
        rng: &mut ChaCha8Rng,
    ) -> Result<Self> {
        let online = Parameters::init(&model, rng, &compute.device)?;
        let key = settings.make_auxiliary_loss()?.key_tau();
        let key = key.map(|_| online.copy_part(Encoder::has_parameter));
        let parameters = NetworkParameters {
            target: online.without_dim()?,
            key_encoder: key.transpose()?,
            online,
        };
        Self::from_parameters(model, settings, compute, parameters)
    }

    /// Creates an agent with the given weights, which are on the device of `compute`, before its first update.
    ///
    /// # Errors
    /// As [`Agent::new`], and parameters that do not fit the model.
    pub fn from_parameters(
        model: ModelConfig,
        settings: UpdateSettings,
        compute: &Compute,
        parameters: NetworkParameters,
    ) -> Result<Self> {
        settings.validate()?;
        let (online, target) = (parameters.online, parameters.target);
        let key_encoder = parameters.key_encoder;
        let built = DimHeads {
            action: model.dim.embeds_action(),
            ..model.dim
        };
        let auxiliary = settings.make_auxiliary_loss()?;
        // A model of a single action may have its embedding, or leave it out.
        let has_choice = model.num_actions > 1 || built.action;
        let needed = auxiliary.heads(settings.condition_on_action && has_choice);
        if needed != built {
            return Err(UpdateError::Settings(format!(
                "the auxiliary_loss uses {needed:?}, the model builds {built:?}"
            )));
        }
        let kernels = compute.kernels;
        let (needed, built) = (auxiliary.layers(&model), &model.loss_layers);
        if needed != *built {
            return Err(UpdateError::Settings(format!(
                "the auxiliary_loss uses the layers {needed:?}, the model builds {built:?}"
            )));
        }
        let encoder = match (auxiliary.key_tau(), &key_encoder) {
            (None, None) => None,
            (Some(_), Some(key)) => Some(Encoder::new(&model, key, kernels)?),
            (wanted, _) => {
                let presence = if wanted.is_some() { "missing" } else { "there" };
                let auxiliary_loss = settings.auxiliary_loss.name();
                return Err(UpdateError::State(format!(
                    "a key encoder is {presence}, with auxiliary_loss = {auxiliary_loss}"
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
                key_encoder: encoder,
                model,
                settings,
            },
            target,
            key_encoder,
        })
    }

    /// Sets whether equal states of a batch are computed once; the default is no. This works with the CPU's fused kernels only: a GPU
    /// computes a state in less time than the CPU needs for its checksum.
    #[must_use]
    pub const fn with_deduplication(mut self, deduplicate: bool) -> Self {
        let kernels = self.networks.compute.kernels;
        self.networks.deduplicate = deduplicate && matches!(kernels, Kernels::Fused(_));
        self
    }

    /// Sets the seed of the noisy layers' noise, which is a function of the seed and the number of the update. The default seed is 0.
    #[must_use]
    pub const fn with_noise_seed(mut self, noise_seed: [u8; 32]) -> Self {
        self.noise_seed = noise_seed;
        self
    }

    /// The online network's sizes, its auxiliary heads included.
    pub const fn model(&self) -> &ModelConfig {
        &self.networks.model
    }

    /// The settings of an update.
    pub const fn settings(&self) -> &UpdateSettings {
        &self.networks.settings
    }

    /// The number of updates since the run began, including those before a restart.
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

    /// The parameters of the key encoder, if the auxiliary loss has one.
    pub const fn key_encoder(&self) -> Option<&Parameters> {
        self.key_encoder.as_ref()
    }

    /// The averaged network's parameters, torso and head; `None` before the first update, and without `average_tau`. They start as a copy
    /// of the online parameters. Each later update t of the run moves them `max(average_tau, 1 / t)` of the way to the online parameters.
    pub const fn average(&self) -> Option<&Parameters> {
        self.average.as_ref()
    }

    /// Copies the averaged weights, if any, into torso and head of the online network, for evaluation. Returns whether there were any.
    pub fn copy_average_to_online(&mut self) -> Result<bool> {
        for (name, var) in self.average.iter().flat_map(Parameters::iter) {
            if let Some(online) = self.online().get(name) {
                online.set(var)?;
            }
        }
        Ok(self.average.is_some())
    }

    /// The weights that actors need, torso and head, as safetensors bytes with scalars of type `stored`.
    pub fn weights(&self, stored: WeightDtype) -> Result<Vec<u8>> {
        let online = self.online();
        Ok(online.to_safetensors_as(stored, |name| !is_dim(name))?)
    }

    /// Learns from one batch.
    ///
    /// # Errors
    /// A batch that does not fit, or losses or gradients that are not finite: nothing has then changed. [`UpdateError::Diverged`] if the
    /// step makes a parameter or moment infinite or NaN: the agent can then neither learn nor be published or saved.
    pub fn update(&mut self, batch: &Batch<'_>) -> Result<UpdateReport> {
        fail_point::hold(self.updates());
        // Runs on a thread of the pool: from another thread, each matrix product would cost a switch to the pool and back.
        rayon::scope(|_| {
            let computed = self.gradients(batch)?;
            let grad_norm = self.apply(&computed.gradients)?;
            let taken = computed.taken_logits.unsqueeze(1)?;
            let q_values = to_vec_f32(&self.networks.online.q_values(&taken)?)?;
            Ok(UpdateReport {
                losses: computed.losses,
                grad_norm,
                q_mean: q_values.iter().sum::<f32>() / batch.rows as f32,
            })
        })
    }

    /// Checks that `batch` fits this network and this auxiliary loss.
    pub(crate) fn check_batch(&self, batch: &Batch<'_>) -> Result<()> {
        batch.validate(self.model(), self.settings().auxiliary_loss.positives())
    }

    /// The noise of the next update's noisy layers.
    pub fn noise(&self) -> UpdateNoise {
        UpdateNoise::draw(self.model(), self.noise_seed, self.updates)
    }

    /// Losses and gradients of one batch at the current parameters, with the noise of the next update.
    pub fn gradients(&self, batch: &Batch<'_>) -> Result<LossesAndGradients> {
        self.gradients_with(batch, &self.noise())
    }

    /// [`Agent::gradients`] with the given noise of the noisy layers.
    ///
    /// # Errors
    /// A batch that does not fit, losses that are not finite, noise for a head without noisy layers.
    pub fn gradients_with(
        &self,
        batch: &Batch<'_>,
        noise: &UpdateNoise,
    ) -> Result<LossesAndGradients> {
        self.check_batch(batch)?;
        self.networks.gradients(batch, noise)
    }

    /// Q-values [B, A] of the online network in the batch's s_t, by a separate forward pass: an update computes only the values of the
    /// taken actions. Noisy layers use their means.
    pub fn q_values_t(&self, batch: &Batch<'_>) -> Result<Vec<f32>> {
        let networks = &self.networks;
        let states = states_tensor(self.model(), batch.states_t, &networks.compute.device)?;
        let logits = detached_logits(&networks.online, &states, None)?;
        Ok(to_vec_f32(&networks.online.q_values(&logits)?)?)
    }

    /// Clips `gradients`, takes one Adam step and moves the slow networks that are due.
    /// Returns the global norm of the gradients before clipping.
    pub fn apply(&mut self, gradients: &Gradients) -> Result<f64> {
        let (settings, online) = (&self.networks.settings, &self.networks.parameters);
        let kernels = self.networks.compute.kernels;
        let norm = gradients.norm(kernels)?;
        let factor = clip_factor(norm, settings.max_grad_norm);
        self.adam.step(online, gradients, factor)?;
        self.updates += 1;
        if let (Some(key), Some(tau)) = (&self.key_encoder, self.networks.auxiliary.key_tau()) {
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
}
