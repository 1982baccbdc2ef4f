//! The learner without network connections: takes a batch, returns a report, and exports weights and affinity on demand.
//! Both the learner process and lockstep mode run this code. It neither requests batches nor sends messages.

use std::path::Path;

use driml_model::Compute;
use driml_protocol::{AffinityUpdate, Batch as WireBatch, Weights, WeightsHeader};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    affinity::AffinityEstimator,
    agent::{Agent, UpdateReport},
    checkpoint::{self, CheckpointError, Extras, LearnerState},
    config::LearnerConfig,
    error::Result,
    importance::resample_evenly,
    prepare::{Columns, Preparation},
    run_counts::RunCounts,
};

/// The name under which the noisy layers' seed is derived from the run's seed.
const NOISE_SEED_NAME: &str = "noisy layers";
/// The share of targets beyond C51's atoms up to which no warning is due: only the best or the worst states are then affected.
const SHARE_BEYOND_MAX: f64 = 0.1;
/// The number of updates in a row after which a loss that is stuck is worth a warning.
const STUCK_UPDATES: u64 = 100;

/// A learner: its settings, its state, and the preparation of its batches.
pub struct Learner {
    config: LearnerConfig,
    state: LearnerState,
    preparation: Preparation,
    /// Share of the targets beyond C51's atoms, over about the last 100 updates; `None` after the warning.
    share_beyond: Option<f64>,
    /// The number of updates in a row with a loss that was stuck; [`STUCK_UPDATES`] after the warning.
    stuck_updates: u64,
}

/// Applies the settings that an agent's state does not contain.
fn apply_settings(agent: Agent, config: &LearnerConfig) -> Agent {
    agent
        .with_deduplication(config.learner.deduplicate_states)
        .with_noise_seed(config.spec.seed_for(NOISE_SEED_NAME, 0))
}

impl Learner {
    /// Creates a learner before its first update. All its random generators are derived from the run's seed.
    pub fn new(config: LearnerConfig, compute: &Compute) -> Result<Self> {
        let spec = &config.spec;
        let mut init = ChaCha8Rng::from_seed(spec.seed_for("weights", 0));
        let mut rng = ChaCha8Rng::from_seed(spec.seed_for("learner", 0));
        let (model, update) = (config.model.clone(), config.learner.update.clone());
        let agent = Agent::new(model, update, compute, &mut init)?;
        let affinity = &config.learner.affinity;
        let affinity = affinity.make_estimator(config.model.num_actions, &mut rng)?;
        Ok(Self {
            state: LearnerState {
                agent: apply_settings(agent, &config),
                affinity,
                rng,
                weights_version: 0,
                run_counts: RunCounts::default(),
            },
            preparation: Preparation::new(&config)?,
            share_beyond: Some(0.0),
            stuck_updates: 0,
            config,
        })
    }

    /// Restores the state of the newest checkpoint in `folder`; without checkpoints, nothing changes.
    pub fn resume(mut self, folder: &Path) -> Result<Self, CheckpointError> {
        let restored = checkpoint::load_latest(
            folder,
            &self.config.model,
            &self.config.learner.update,
            &self.agent().networks.compute,
            self.spec_hash(),
        )?;
        let Some(restored) = restored else {
            return Ok(self);
        };
        let [configured, saved] = [&self.state, &restored].map(|it| {
            let affinity = it.affinity.as_ref();
            affinity.map(AffinityEstimator::settings)
        });
        if configured != saved {
            return Err(CheckpointError::Mismatch(format!(
                "the checkpoint in {} has another estimator of the action affinity: resume with the settings it was made with, or choose another folder",
                folder.display()
            )));
        }
        self.state = LearnerState {
            agent: apply_settings(restored.agent, &self.config),
            ..restored
        };
        Ok(self)
    }

    /// The agent: networks, optimiser and count of updates.
    pub const fn agent(&self) -> &Agent {
        &self.state.agent
    }

    /// The hash of the run spec.
    pub fn spec_hash(&self) -> u64 {
        self.config.spec.hash()
    }

    /// The number of updates since the run began, including those before a restart.
    pub const fn updates(&self) -> u64 {
        self.state.agent.updates()
    }

    /// The run's other counts: transitions stored and rows learned, by shard.
    pub const fn run_counts(&self) -> &RunCounts {
        &self.state.run_counts
    }

    /// [`Learner::run_counts`] for the caller to update: [`Learner::update`] does not know which shards a batch comes from.
    pub const fn run_counts_mut(&mut self) -> &mut RunCounts {
        &mut self.state.run_counts
    }

    /// Updates the network and the affinity estimate from one batch.
    ///
    /// # Errors
    /// A batch that does not fit, or a result that is not finite. Nothing has changed then, except after
    /// [`UpdateError::Diverged`](crate::UpdateError::Diverged): the learner can then neither publish nor save.
    pub fn update(&mut self, batch: &WireBatch) -> Result<UpdateReport> {
        let beta = self.config.sampling.beta(self.updates());
        let columns = Columns::new(batch, beta);
        // A copy, which replaces the generator only if the update succeeds.
        let mut rng = self.state.rng.clone();
        let batch = self.preparation.prepare(&columns, &mut rng);
        // The affinity estimate must not see the actions of an invalid batch.
        self.state.agent.check_batch(&batch)?;
        let mut affinity = self.state.affinity.clone();
        if let Some(affinity) = &mut affinity {
            // Without the resampling, rows drawn by priority would give the affinity of surprising transitions.
            let pairs = match &columns.probabilities {
                None => batch.action_pairs(0..batch.rows),
                Some(it) => batch.action_pairs(resample_evenly(it, &mut rng)),
            };
            affinity.observe(&pairs, &mut rng)?;
        }
        let report = self.state.agent.update(&batch)?;
        (self.state.rng, self.state.affinity) = (rng, affinity);
        self.warn_of_clipping(report.losses.share_beyond);
        self.warn_of_stuck_loss(report.losses.stuck_loss);
        Ok(report)
    }

    /// Warns once if C51 clips many of the newest targets. `share` is that of the last batch.
    fn warn_of_clipping(&mut self, share: f64) {
        let mean = self.share_beyond.map(|mean| mean + (share - mean) / 100.0);
        self.share_beyond = mean.filter(|it| *it <= SHARE_BEYOND_MAX);
        if let (Some(mean), None) = (mean, self.share_beyond) {
            let (v_min, v_max) = (self.config.model.v_min, self.config.model.v_max);
            tracing::warn!(
                "{:.0}% of the newest targets lie beyond model.v_min = {v_min} or model.v_max = {v_max}, where C51 clips them and \
                 no longer tells actions apart: start a new run with a wider range, such as --set model.v_min={} --set model.v_max={}",
                100.0 * mean,
                4.0 * v_min,
                4.0 * v_max
            );
        }
    }

    /// Warns once of an auxiliary loss, `stuck`, that has taught nothing for many updates.
    fn warn_of_stuck_loss(&mut self, stuck: Option<&str>) {
        if self.stuck_updates == STUCK_UPDATES {
            return;
        }
        self.stuck_updates = stuck.map_or(0, |_| self.stuck_updates + 1);
        if let (Some(name), STUCK_UPDATES) = (stuck, self.stuck_updates) {
            let clip = self.config.learner.update.tanh_clip;
            tracing::warn!(
                "the loss {name} stays at chance: its scores lie beyond the bound learner.update.tanh_clip = {clip}, where their gradient \
                 vanishes: start a new run with a larger bound, such as --set learner.update.tanh_clip={}",
                50.0 * clip
            );
        }
    }

    /// Makes the next weights' version larger than `version`. Actors accept only weights newer than theirs, which may be those of a
    /// learner that crashed after its last checkpoint.
    pub fn raise_weights_version(&mut self, version: u64) {
        self.state.weights_version = self.state.weights_version.max(version);
    }

    /// The affinity matrix after the last update, as a message from `learner`; `None` if the run estimates no affinity.
    pub fn affinity_update(&self, learner: u64) -> Option<AffinityUpdate> {
        self.state.affinity.as_ref().map(|affinity| AffinityUpdate {
            learner,
            version: self.state.agent.updates(),
            matrix: affinity.matrix(),
        })
    }

    /// Whether it is time to publish weights, after the current number of updates.
    pub const fn publication_is_due(&self) -> bool {
        let period = self.config.learner.publish_period_updates;
        self.updates().is_multiple_of(period)
    }

    /// Whether it is time to save a checkpoint, after the current number of updates.
    pub const fn checkpoint_is_due(&self) -> bool {
        let period = self.config.learner.checkpoint_period_updates;
        self.updates() > 0 && self.updates().is_multiple_of(period)
    }

    /// Exports the current weights under a new version number.
    pub fn export_weights(&mut self) -> Result<Weights> {
        let dtype = self.config.learner.publish_dtype;
        let safetensors = self.agent().weights(dtype)?;
        self.state.weights_version += 1;
        let header = WeightsHeader::new(self.state.weights_version, self.updates(), &safetensors);
        Ok(Weights {
            header,
            safetensors,
        })
    }

    /// Writes a checkpoint into `folder`, together with the bytes of the caller's `companion`, if any, which
    /// [`checkpoint::read_companion`] reads.
    pub fn save(&self, folder: &Path, companion: Option<&[u8]>) -> Result<(), CheckpointError> {
        let extras = Extras {
            spec: &self.config.spec,
            input: &self.config.input,
            companion,
        };
        let keep = self.config.learner.checkpoints_kept as usize;
        let path = checkpoint::save(folder, &self.state, extras, keep)?;
        tracing::info!("saved {}", path.display());
        Ok(())
    }
}
