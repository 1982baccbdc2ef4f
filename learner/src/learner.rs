//! A learner's work without its network connections: batch in, report out, weights and affinity on demand.
//! The processes and the lockstep mode run this same code; it neither asks for batches nor sends anything.

use std::path::{Path, PathBuf};

use driml_model::Compute;
use driml_protocol::{AffinityUpdate, Batch as WireBatch, LearnerStatus, Weights, WeightsHeader};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    affinity::{AffinityError, AffinityEstimator},
    agent::Agent,
    checkpoint::{self, CheckpointError, Label, LearnerState},
    config::LearnerConfig,
    error::UpdateError,
    evaluation::UpdateReport,
    importance::drawn_evenly,
    prepare::{Columns, Preparation},
    progress::Progress,
};

/// What the seed of noisy layers' noise is drawn for.
const NOISE: &str = "noisy layers";

/// Why a learner could not be made, learn or be saved.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum LearnerError {
    #[error(transparent)]
    Update(#[from] UpdateError),
    #[error(transparent)]
    Affinity(#[from] AffinityError),
    #[error(transparent)]
    Config(#[from] driml_protocol::config::ConfigError),
    #[error(transparent)]
    Model(#[from] driml_model::ModelError),
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(
        "the checkpoint in {} estimated the action affinity otherwise: resume with the settings it was made with, or choose another folder",
        .0.display()
    )]
    OtherAffinity(PathBuf),
}

/// A learner's state, and what it learns by.
pub struct Learner {
    config: LearnerConfig,
    spec_hash: u64,
    state: LearnerState,
    preparation: Preparation,
}

/// What an agent has beside its state.
fn configured(agent: Agent, config: &LearnerConfig) -> Agent {
    agent
        .with_deduplication(config.learner.deduplicate_states)
        .with_noise_seed(config.spec.seed_for(NOISE, 0))
}

impl Learner {
    /// A learner at its start, all generators derived from the run's seed.
    pub fn new(config: LearnerConfig, compute: &Compute) -> Result<Self, LearnerError> {
        let spec = &config.spec;
        let mut init = ChaCha8Rng::from_seed(spec.seed_for("weights", 0));
        let mut rng = ChaCha8Rng::from_seed(spec.seed_for("learner", 0));
        let (model, update) = (config.model.clone(), config.learner.update.clone());
        let agent = Agent::new(model, update, compute, &mut init)?;
        let affinity = &config.learner.affinity;
        let affinity = affinity.estimator(config.model.num_actions, &mut rng)?;
        Ok(Self {
            spec_hash: spec.hash(),
            state: LearnerState {
                agent: configured(agent, &config),
                affinity,
                rng,
                weights_version: 0,
                progress: Progress::default(),
            },
            preparation: Preparation::new(&config)?,
            config,
        })
    }

    /// A learner restored from the newest checkpoint in `folder`; a new one if there is none.
    ///
    /// # Errors
    /// Settings that cannot work, or a checkpoint that is damaged, of another run or of other settings.
    pub fn resume(
        config: LearnerConfig,
        compute: &Compute,
        folder: &Path,
    ) -> Result<Self, LearnerError> {
        let mut this = Self::new(config, compute)?;
        let restored = checkpoint::load_latest(
            folder,
            &this.config.model,
            &this.config.learner.update,
            compute,
            this.spec_hash,
        )?;
        let Some(restored) = restored else {
            return Ok(this);
        };
        let [fresh, found] = [&this.state, &restored].map(|it| {
            let affinity = it.affinity.as_ref();
            affinity.map(AffinityEstimator::settings)
        });
        if fresh != found {
            return Err(LearnerError::OtherAffinity(folder.to_owned()));
        }
        this.state = LearnerState {
            agent: configured(restored.agent, &this.config),
            ..restored
        };
        Ok(this)
    }

    /// The networks, and how they learn.
    pub const fn agent(&self) -> &Agent {
        &self.state.agent
    }

    /// Hash of the run spec.
    pub const fn spec_hash(&self) -> u64 {
        self.spec_hash
    }

    /// Updates taken since the run began, those before a restart included.
    pub const fn updates(&self) -> u64 {
        self.state.agent.updates()
    }

    /// What the run has done beside its updates.
    pub const fn progress(&self) -> &Progress {
        &self.state.progress
    }

    /// The same, to add to: [`Learner::update`] does not know where a batch comes from.
    pub const fn progress_mut(&mut self) -> &mut Progress {
        &mut self.state.progress
    }

    /// Learns from one batch: the network and the affinity.
    ///
    /// # Errors
    /// A batch that does not fit, or arithmetic that left the finite numbers; nothing has changed then, except after
    /// [`UpdateError::Diverged`](crate::UpdateError::Diverged), when neither weights nor a checkpoint can be had any more.
    pub fn update(&mut self, batch: &WireBatch) -> Result<UpdateReport, LearnerError> {
        let beta = self.config.sampling.beta(self.updates());
        let columns = Columns::of(batch, beta);
        // Kept only if the update succeeds.
        let mut rng = self.state.rng.clone();
        let batch = self.preparation.prepare(&columns, &mut rng);
        // Before the affinity sees its actions.
        self.state.agent.check(&batch)?;
        let mut affinity = self.state.affinity.clone();
        if let Some(affinity) = &mut affinity {
            // Of rows drawn by priority it would be the affinity of surprising transitions.
            let pairs = match &columns.probabilities {
                None => batch.action_pairs(0..batch.rows),
                Some(it) => batch.action_pairs(drawn_evenly(it, &mut rng)),
            };
            affinity.observe(&pairs, &mut rng)?;
        }
        let report = self.state.agent.update(&batch)?;
        (self.state.rng, self.state.affinity) = (rng, affinity);
        Ok(report)
    }

    /// Writes into `status` what the last update gave.
    pub fn note(&self, report: &UpdateReport, status: &mut LearnerStatus) {
        status.updates = self.updates();
        status.c51_kl = report.c51_kl;
        let losses = report.losses.iter();
        status.losses = losses.map(|&(name, loss)| (name.into(), loss)).collect();
        status.total = report.total;
        status.grad_norm = report.grad_norm;
        status.q_mean = report.q_mean;
    }

    /// The next weights get a version above `version`: actors take what is newer than theirs, which may be those of a learner
    /// that died after its last checkpoint.
    pub fn publish_above(&mut self, version: u64) {
        self.state.weights_version = self.state.weights_version.max(version);
    }

    /// The affinity matrix after the last update, if this agent has one, as `learner` sends it.
    pub fn affinity_update(&self, learner: u64) -> Option<AffinityUpdate> {
        self.state.affinity.as_ref().map(|affinity| AffinityUpdate {
            learner,
            version: self.state.agent.updates(),
            num_actions: affinity.num_actions() as u32,
            matrix: affinity.matrix(),
        })
    }

    /// Whether the actors are due newer weights after this many updates.
    pub const fn publication_is_due(&self) -> bool {
        let period = self.config.learner.publish_period_updates;
        self.updates().is_multiple_of(period)
    }

    /// Whether a checkpoint is due after this many updates.
    pub const fn checkpoint_is_due(&self) -> bool {
        let period = self.config.learner.checkpoint_period_updates;
        self.updates() > 0 && self.updates().is_multiple_of(period)
    }

    /// The present weights as a new version.
    pub fn next_weights(&mut self) -> Result<Weights, LearnerError> {
        let dtype = self.config.learner.publish_dtype;
        let safetensors = self.agent().weights_as(dtype)?;
        self.state.weights_version += 1;
        let header = WeightsHeader::new(self.state.weights_version, self.updates(), &safetensors);
        Ok(Weights {
            header,
            safetensors,
        })
    }

    /// Writes a checkpoint into `folder`.
    ///
    /// # Errors
    /// The file system refused; older checkpoints are untouched.
    pub fn save(&self, folder: &Path) -> Result<(), LearnerError> {
        self.save_with(folder, None)
    }

    /// Writes a checkpoint into `folder` and, in it, what its caller keeps with it: [`checkpoint::companion`] reads that.
    pub fn save_with(&self, folder: &Path, companion: Option<&[u8]>) -> Result<(), LearnerError> {
        let LearnerConfig {
            spec, model, input, ..
        } = &self.config;
        let label = Label {
            run_spec_hash: self.spec_hash,
            description: &checkpoint::describe(spec, model, input),
            without_heads: &checkpoint::describe(spec, &model.without_dim(), input),
            companion,
        };
        let keep = self.config.learner.checkpoints_kept as usize;
        let path = checkpoint::save(folder, &self.state, label, keep)?;
        tracing::info!("saved {}", path.display());
        Ok(())
    }
}
