//! The learner's settings, and the other tables of the run's settings that a learner reads.
//! No number has a default here: presets give all of them, with their sources.

use driml_model::{InputSize, ModelConfig, Precision, WeightDtype};
use driml_protocol::{
    RunSpec, Sampling,
    config::{ConfigError, Settings, TransportConfig, check, check_range},
};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    affinity::{
        AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity, LearnedSettings,
    },
    augment::AugmentSettings,
    auxiliary::positives::Positives,
    error::{Result, UpdateError},
    settings::UpdateSettings,
};

/// The `[learner]` table: batches, publication, checkpoints, and what an update does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Rows of one update, B.
    pub batch_size: u32,
    /// Number format of an update's matrix products. Weights, moments, losses and sums are f32 in either format.
    pub precision: Precision,
    /// Whether equal states of a batch are computed once. Only the CPU kernels do this.
    pub deduplicate_states: bool,
    /// Batches requested ahead of the one being learned from.
    pub batches_in_flight: u32,
    /// Number format of published weights.
    pub publish_dtype: WeightDtype,
    /// Updates from one version of the weights to the next.
    pub publish_period_updates: u64,
    /// Updates from one checkpoint to the next.
    pub checkpoint_period_updates: u64,
    /// Checkpoints kept; older ones are removed.
    pub checkpoints_kept: u32,
    /// How long the replay server may be unreachable, in milliseconds, before the learner saves a checkpoint and exits.
    pub unreachable_max_ms: u64,
    /// Losses, optimiser and target network.
    pub update: UpdateSettings,
    /// Augmentation of the states that the auxiliary loss sees; none if this table is absent.
    pub augment: Option<AugmentSettings>,
    /// How the action affinity A is estimated, if the horizon depends on it.
    pub affinity: AffinityConfig,
}

/// How A is estimated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EstimatorKind {
    /// No affinity is estimated; the horizon does not depend on it.
    None,
    /// By a small network (the paper).
    Learned,
    /// In closed form from counts.
    Exact,
}

/// Which actions A tells apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlphabetKind {
    /// All actions that the environment accepts.
    Raw,
    /// One of each group of actions with the same effect.
    Visible,
}

/// The `[learner.affinity]` table. The tables of estimators that are not chosen may be absent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AffinityConfig {
    /// How A is estimated.
    pub estimator: EstimatorKind,
    /// Which actions A tells apart.
    pub alphabet: Option<AlphabetKind>,
    /// For each raw action, the action of the same effect that represents it; required for the alphabet `visible`.
    pub visible: Option<Vec<u8>>,
    /// Settings of the learned estimate.
    pub learned: Option<LearnedSettings>,
    /// Settings of the exact estimate.
    pub exact: Option<ExactSettings>,
}

impl AffinityConfig {
    /// Creates the chosen estimator, with its weights drawn from `rng`; `None` for [`EstimatorKind::None`].
    pub fn make_estimator(
        &self,
        num_actions: usize,
        rng: &mut ChaCha8Rng,
    ) -> Result<Option<AffinityEstimator>, ConfigError> {
        let missing = |key: &str| {
            let why = "the chosen estimator needs it: start from a preset";
            ConfigError::new(&format!("learner.affinity.{key}"), "(missing)", why)
        };
        let name = format!("{:?}", self.estimator).to_lowercase();
        let bad = |e: UpdateError| ConfigError::new("learner.affinity.estimator", &name, e);
        // Tables that the chosen estimator does not use are checked too.
        let learned = self.learned.map_or(Ok(()), |it| it.check_valid());
        let exact = self.exact.map_or(Ok(()), |it| it.check_valid());
        learned.and(exact).map_err(bad)?;
        let visible = self.visible.as_deref().map(Alphabet::new);
        let visible = visible.transpose().map_err(bad)?;
        if self.estimator == EstimatorKind::None {
            return Ok(None);
        }
        let alphabet = match self.alphabet.ok_or_else(|| missing("alphabet"))? {
            AlphabetKind::Raw => Alphabet::raw(num_actions).map_err(bad)?,
            AlphabetKind::Visible => visible.ok_or_else(|| missing("visible"))?,
        };
        let found = alphabet.num_actions();
        check(
            found == num_actions,
            "learner.affinity.visible",
            format_args!("{found} actions"),
            format_args!("the world has {num_actions}"),
        )?;
        let estimator = match self.estimator {
            EstimatorKind::Exact => {
                let settings = self.exact.ok_or_else(|| missing("exact"))?;
                ExactAffinity::new(alphabet, settings).map(AffinityEstimator::Exact)
            }
            _ => {
                let settings = self.learned.ok_or_else(|| missing("learned"))?;
                LearnedAffinity::new(alphabet, settings, rng).map(AffinityEstimator::Learned)
            }
        };
        estimator.map(Some).map_err(bad)
    }
}

impl Config {
    /// Checks the ranges of all fields except `update`, which has its own [`UpdateSettings::validate`].
    pub fn validate(&self) -> Result<(), ConfigError> {
        let within = |key: &str, value: u64, most: u64| {
            let why = match most {
                u64::MAX => "it must be at least 1".into(),
                most => format!("it must lie between 1 and {most}"),
            };
            check_range(&format!("learner.{key}"), value, 1..=most, why)
        };
        let (publish, checkpoint) = (self.publish_period_updates, self.checkpoint_period_updates);
        within("batch_size", self.batch_size.into(), 65_536)?;
        within("batches_in_flight", self.batches_in_flight.into(), 64)?;
        within("publish_period_updates", publish, u64::MAX)?;
        within("checkpoint_period_updates", checkpoint, u64::MAX)?;
        within("checkpoints_kept", self.checkpoints_kept.into(), 1_000_000)?;
        within("unreachable_max_ms", self.unreachable_max_ms, 86_400_000)?;
        if let Some(augment) = &self.augment {
            augment.validate()?;
        }
        let name = self.update.auxiliary_loss.name();
        match (self.update.auxiliary_loss.positives(), self.augment) {
            (Positives::OtherView, None) => Err(ConfigError::new(
                "learner.augment",
                "(missing)",
                format!(
                    "{} compares two augmentations of a state: take the agent {name}, or set all of learner.augment",
                    name.to_uppercase()
                ),
            )),
            (Positives::None, Some(_)) => Err(ConfigError::new(
                "learner.augment",
                "(there)",
                "nothing but an auxiliary loss sees augmented states, and this agent has none",
            )),
            _ => Ok(()),
        }
    }
}

/// The settings of a run that its learner needs.
#[derive(Clone, Debug)]
pub struct LearnerConfig {
    /// The settings that all processes share: the `[run]` table.
    pub spec: RunSpec,
    /// The network's sizes: the `[model]` table.
    pub model: ModelConfig,
    /// The size at which the network sees a frame: the `[input]` table.
    pub input: InputSize,
    /// The learner's own settings: the `[learner]` table.
    pub learner: Config,
    /// How messages travel: the `[transport]` table.
    pub transport: TransportConfig,
    /// The rule by which rows are drawn: `sampling` of the `[replay]` table.
    pub sampling: Sampling,
}

/// The fields of the `[replay]` table that a learner reads.
#[derive(Deserialize)]
struct ReplayTable {
    #[serde(default)]
    sampling: Sampling,
}

impl LearnerConfig {
    /// Reads the tables from a run's resolved settings.
    pub fn from_toml(text: &str) -> Result<Self> {
        let settings = Settings::parse(text)?;
        let this = Self {
            spec: settings.table("run")?,
            model: settings.table("model")?,
            input: settings.table("input")?,
            learner: settings.table("learner")?,
            transport: settings.table("transport")?,
            sampling: settings.table::<ReplayTable>("replay")?.sampling,
        };
        this.spec.validate()?;
        this.model.validate()?;
        this.learner.validate()?;
        this.learner.update.validate()?;
        let (height, width) = this.input.whole_input();
        let frame_size = this.spec.frame_size();
        let states = (this.spec.frame_channels * this.spec.frame_stack) as usize;
        let whole = ModelConfig {
            height,
            width,
            ..this.model.clone()
        };
        // The model's input may lack the border pixels that no layer reads, so that both inputs give the same local shape.
        let sizes_follow = this.model.input_channels == states
            && this.model.num_actions == this.spec.num_actions as usize
            && this.model.f3_shape() == whole.f3_shape()
            && this.input.resizer(frame_size, &this.model).is_ok();
        if !sizes_follow {
            return Err(UpdateError::ModelSizes);
        }
        Ok(this)
    }
}
