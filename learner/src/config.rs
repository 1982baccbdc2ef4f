//! The learner's settings, and what it takes from the run's other tables.
//! It fills in no number: presets do, with their sources.

use driml_model::{InputSize, ModelConfig, Precision, StoredAs};
use driml_protocol::{
    RunSpec, Sampling,
    config::{ConfigError, Settings, TransportConfig, check},
};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    affinity::{
        AffinityError, AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity,
        LearnedSettings,
    },
    augment::AugmentSettings,
    auxiliary::positives::Positives,
    error::UpdateError,
    settings::UpdateSettings,
};

/// The `[learner]` table: batches, publication, checkpoints, and what an update does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Rows of one update, B.
    pub batch_size: u32,
    /// In which numbers an update's products are computed; weights, moments, losses and sums are f32 in either.
    pub precision: Precision,
    /// Whether equal states of a batch are computed once.
    pub deduplicate_states: bool,
    /// Batches asked for ahead of the one being learned from.
    pub batches_in_flight: u32,
    /// What the scalars of published weights are.
    pub publish_dtype: StoredAs,
    /// Updates from one version of the weights to the next.
    pub publish_period_updates: u64,
    /// Updates from one checkpoint to the next.
    pub checkpoint_period_updates: u64,
    /// Checkpoints kept; older ones are removed.
    pub checkpoints_kept: u32,
    /// How long the replay server may be out of reach, milliseconds, before the learner saves and gives up.
    pub unreachable_max_ms: u64,
    /// Losses, optimiser and target network.
    pub update: UpdateSettings,
    /// What is done to the states that the auxiliary loss sees; nothing if it is not there.
    pub augment: Option<AugmentSettings>,
    /// How the action affinity A is estimated, if the horizon follows it.
    pub affinity: AffinityConfig,
}

/// How A is estimated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EstimatorKind {
    /// No affinity is estimated; the horizon does not follow it.
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
    /// All that the world takes.
    Raw,
    /// Those that differ in what they do.
    Visible,
}

/// The `[learner.affinity]` table; an estimator that is not chosen needs no numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AffinityConfig {
    /// How A is estimated.
    pub estimator: EstimatorKind,
    /// Which actions A tells apart.
    pub alphabet: Option<AlphabetKind>,
    /// For each raw action the one that it amounts to; needed for the alphabet `visible`.
    pub visible: Option<Vec<u8>>,
    /// Numbers of the learned estimate.
    pub learned: Option<LearnedSettings>,
    /// Numbers of the exact estimate.
    pub exact: Option<ExactSettings>,
}

impl AffinityConfig {
    /// The estimator that the settings ask for, with its weights drawn from `rng`.
    ///
    /// # Errors
    /// A number or table that is missing or out of range.
    pub fn estimator(
        &self,
        num_actions: usize,
        rng: &mut ChaCha8Rng,
    ) -> Result<Option<AffinityEstimator>, ConfigError> {
        let missing = |key: &str| {
            let why = "the chosen estimator needs it: start from a preset";
            ConfigError::of(&format!("learner.affinity.{key}"), "(missing)", why)
        };
        let name = format!("{:?}", self.estimator);
        let bad = |e: AffinityError| ConfigError::of("learner.affinity", &name, e);
        // What the chosen estimator does not use is checked all the same.
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
            format!("{found} actions"),
            || format!("the world has {num_actions}"),
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
    /// Checks every field's range but those of `update`, which checks itself.
    ///
    /// # Errors
    /// The first field that cannot work, and why.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let within = |key: &str, value: u64, most: u64| {
            let (key, is_fine) = (format!("learner.{key}"), (1..=most).contains(&value));
            check(is_fine, &key, value, || match most {
                u64::MAX => "it must be at least 1".into(),
                most => format!("it must lie between 1 and {most}"),
            })
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
            (Positives::OtherView, None) => Err(ConfigError::of(
                "learner.augment",
                "(missing)",
                format!(
                    "{} compares two augmentations of a state: take the agent {name}, or set all of learner.augment",
                    name.to_uppercase()
                ),
            )),
            (Positives::None, Some(_)) => Err(ConfigError::of(
                "learner.augment",
                "(there)",
                "nothing but an auxiliary loss sees augmented states, and this agent has none",
            )),
            _ => Ok(()),
        }
    }
}

/// Why a run's settings are none that a learner can work with.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum LearnerConfigError {
    /// Not TOML, a table that is missing or does not fit, or a value of `[run]` or `[learner]` that cannot work.
    #[error(transparent)]
    Tables(#[from] ConfigError),
    #[error(transparent)]
    Model(#[from] driml_model::ModelError),
    #[error(transparent)]
    Update(#[from] UpdateError),
    #[error(
        "the [model] table's sizes do not follow from [run] and [input]: write the settings anew with `driml train`"
    )]
    Sizes,
}

/// Everything a learner needs to know of a run.
#[derive(Clone, Debug)]
pub struct LearnerConfig {
    /// What all processes agree on.
    pub spec: RunSpec,
    /// The network's sizes: the `[model]` table.
    pub model: ModelConfig,
    /// The size at which the network sees a frame: the `[input]` table.
    pub input: InputSize,
    /// The learner's own numbers: the `[learner]` table.
    pub learner: Config,
    /// How messages travel: the `[transport]` table.
    pub transport: TransportConfig,
    /// By which rule rows are drawn: `sampling` of the `[replay]` table.
    pub sampling: Sampling,
}

/// What a learner reads of the `[replay]` table.
#[derive(Deserialize)]
struct ReplayTable {
    #[serde(default)]
    sampling: Sampling,
}

impl LearnerConfig {
    /// Reads the tables from a run's resolved settings.
    ///
    /// # Errors
    /// A table that is missing or does not fit, or values that cannot work.
    pub fn from_toml(text: &str) -> Result<Self, LearnerConfigError> {
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
        let sent = (
            this.spec.frame_height as usize,
            this.spec.frame_width as usize,
        );
        let states = (this.spec.frame_channels * this.spec.frame_stack) as usize;
        let whole = ModelConfig {
            height,
            width,
            ..this.model.clone()
        };
        // What is cut of the input is nothing that a layer reads.
        let follows = this.model.input_channels == states
            && this.model.num_actions == this.spec.num_actions as usize
            && this.model.local_shape() == whole.local_shape()
            && this.input.enlarge(sent, &this.model).is_ok();
        if !follows {
            return Err(LearnerConfigError::Sizes);
        }
        Ok(this)
    }
}
