//! The resolved settings of a run: one TOML file with a table for each component, checked as a whole.
//! No number is filled in here; `flags` does that.

use std::collections::BTreeMap;

use driml_envs::WorldConfig;
use driml_learner::{DeviceName, EstimatorKind};
use driml_machine::error::{Usage, usage};
use driml_model::{InputSize, ModelConfig};
use driml_protocol::{RunSpec, config::TransportConfig};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::{
    derived,
    overrides::{explain, leaves},
};

/// The processes that the launcher starts, and their resources.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalConfig {
    /// Number of actor processes.
    pub actors: u32,
    /// Threads of the learner.
    pub learner_threads: u32,
    /// The device on which the learner computes.
    pub learner_device: DeviceName,
    /// Whether the replay is kept on disk, in the run folder. Then a replay server that died restarts with its replay, and a resumed run
    /// continues with it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub durable: bool,
    /// Whether events for TensorBoard are written beside the metrics, about a kilobyte a second.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tensorboard: bool,
    /// Whether the weights of a finished run play episodes, beside a random policy. Runs in lockstep never do.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub play: bool,
    /// When checkpoints play episodes during the run; `None` if they do not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluation: Option<EvaluationConfig>,
}

/// Evaluation during a run: whole episodes with checkpoints.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Updates from one evaluation to the next, a multiple of `learner.checkpoint_period_updates`. If an evaluation takes longer than this
    /// period, some are skipped.
    pub every_updates: u64,
    /// Episodes of each evaluation, 1 to 1,000,000.
    pub episodes: u32,
}

/// The resolved settings of a run. They are read from TOML and sent as TOML; the code uses this form alone.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// The values on which all processes of the run agree.
    pub run: RunSpec,
    /// The world and its own settings.
    pub world: WorldConfig,
    /// The size to which frames are enlarged for the network.
    pub input: InputSize,
    /// The `[actor]` table.
    pub actor: driml_actor::Config,
    /// The `[replay]` table.
    pub replay: driml_replay_server::Config,
    /// The `[learner]` table.
    pub learner: driml_learner::Config,
    /// Sizes of the network.
    pub model: ModelConfig,
    /// How messages travel.
    pub transport: TransportConfig,
    /// The `[local]` table, which the launcher reads.
    pub local: LocalConfig,
    /// Notes on the memory, which are printed before the run starts.
    #[serde(skip)]
    pub notes: Vec<String>,
    /// The note on the accuracy that the preset gives up, which is printed too.
    #[serde(skip)]
    pub accuracy_note: Option<String>,
    /// The program and its version, which the run folder records.
    #[serde(skip)]
    pub program: String,
}

impl RunConfig {
    /// Bytes of one version of the weights as the learner publishes them.
    pub fn weights_bytes(&self) -> driml_model::Result<usize> {
        let published = self.model.without_dim();
        published.weights_bytes(self.learner.publish_dtype)
    }

    /// Returns the path of the first setting of world, run or loss that differs in `other`: a run keeps them. Time-outs of a world do not
    /// count, as they do not change the task.
    pub fn first_change_of_task(&self, other: &Self) -> Option<String> {
        let tables = [self, other].map(Self::to_table);
        let [before, after] = [0, 1].map(|at| BTreeMap::from_iter(leaves(&tables[at])));
        let differs = |path: &&String| before.get(*path) != after.get(*path);
        let is_kept = |path: &&String| !path.ends_with("_timeout_ms") && differs(path);
        let of_task = ["world.", "run.", "learner.update.auxiliary_loss"];
        of_task.into_iter().find_map(|table| {
            let mut paths = before.keys().chain(after.keys());
            let found = paths.find(|path| path.starts_with(table) && is_kept(path));
            found.cloned()
        })
    }

    /// Reads every table into its component's Config. The derived settings must be in `table`.
    pub(crate) fn read(table: Table) -> Result<Self, Usage> {
        let read = Value::Table(table).try_into();
        read.map_err(|e| usage!("in the settings: {}", explain(&e)))
    }

    /// Like [`Self::read`], after filling in the derived settings.
    pub(crate) fn derive(mut table: Table) -> Result<Self, Usage> {
        derived::fill_in_derived(&mut table)?;
        Self::read(table)
    }

    /// Reads resolved settings, as in a run folder's `config.toml`.
    pub fn parse(name: &str, text: &str) -> Result<Self, Usage> {
        let config = Self::read(derived::parse_file(name, text)?);
        let checked = config.and_then(Self::checked);
        checked.map_err(|e| usage!("{name}: {e}"))
    }

    /// Returns the TOML that every process reads, sorted by name.
    pub fn to_toml(&self) -> String {
        toml::to_string(&self.to_table()).expect("a table of plain values is TOML")
    }

    pub(crate) fn to_table(&self) -> Table {
        // As text, an f32 keeps the digits that were set; converted to an f64, it would have more.
        let text = toml::to_string(self).expect("a struct of plain values is TOML");
        text.parse().expect("it was just written")
    }

    /// Returns the same settings with frames recorded and sent whole, as in earlier versions. The computed values stay the same.
    pub fn with_whole_frames(&self) -> Result<Self, Usage> {
        let mut whole = self.clone();
        whole.input.frame = None;
        Self::derive(whole.to_table())?.checked()
    }

    /// The names of the run's actions, in the order of the action numbers.
    pub fn action_names(&self) -> Vec<String> {
        let actions = self.world.actions(self.actor.actions).into_iter();
        let names = self.world.action_names();
        let name = |action: u8| names[usize::from(action)].to_owned();
        actions.map(name).collect()
    }

    /// Transitions of the whole run.
    pub fn frames(&self) -> u64 {
        self.replay.transitions_max.unwrap_or(u64::MAX)
    }

    /// The fewest frames with which a new run has a batch.
    pub fn frames_min(&self) -> u64 {
        let first_batch = f64::from(self.learner.batch_size) / self.replay.replay_ratio;
        let warmup = self.replay.warmup_transitions;
        warmup.saturating_add(first_batch.ceil() as u64)
    }

    /// Updates of the whole run: those made before it was resumed with other settings, and those that the rest of its transitions allow at
    /// the replay ratio.
    pub fn updates(&self) -> u64 {
        let start = self.replay.ratio_start();
        let frames = self.frames().saturating_sub(start.transitions);
        let rows = frames as f64 * self.replay.replay_ratio;
        let updates = (rows / f64::from(self.learner.batch_size)) as u64;
        start.updates.saturating_add(updates)
    }

    /// Returns these settings if they pass the checks of each component and those that span two tables.
    pub(crate) fn checked(self) -> Result<Self, Usage> {
        fn check<T>(result: Result<T, impl std::fmt::Display>) -> Result<T, Usage> {
            result.map_err(|e| Usage(e.to_string()))
        }
        check(self.run.validate())?;
        check(self.world.validate())?;
        let name = self.world.name().to_string();
        if name != self.run.world {
            return Err(usage!(
                "run.world = {:?}, but the table [world] is of {name:?}: correct one of the two",
                self.run.world
            ));
        }
        check(self.actor.validate())?;
        if self.replay.transitions_max.is_none() {
            return Err(usage!(
                "replay.transitions_max is missing: say with --frames how long the run is"
            ));
        }
        let (replay, learner, local) = (&self.replay, &self.learner, &self.local);
        let (frames, warmup) = (self.frames(), replay.warmup_transitions);
        if frames <= warmup {
            let least = self.frames_min();
            let room = (frames + warmup).checked_sub(least);
            let shorter = room.map(|room| room.min(frames / 10));
            let set = shorter.map(|it| format!(", or --set replay.warmup_transitions={it}"));
            return Err(usage!(
                "a run of {} ends within the warm-up of {warmup}: ask for at least --frames {least}{}",
                driml_machine::units::count(frames, "frame"),
                set.unwrap_or_default()
            ));
        }
        check(replay.validate(&self.run, learner.batch_size))?;
        check(learner.validate())?;
        let update = learner.update.validate();
        update.map_err(|e| usage!("learner.update cannot work: {e}"))?;
        check(self.model.validate())?;
        let (actors, threads) = (local.actors, local.learner_threads);
        if !(1..=256).contains(&actors) {
            return Err(usage!("local.actors = {actors}: a run has 1 to 256 actors"));
        }
        if !(1..=1024).contains(&threads) {
            return Err(usage!(
                "local.learner_threads = {threads}: a learner has 1 to 1024 threads"
            ));
        }
        if let Some(it) = local.evaluation {
            let (every_updates, episodes) = (it.every_updates, it.episodes);
            let period = learner.checkpoint_period_updates;
            if every_updates == 0 || !every_updates.is_multiple_of(period) {
                return Err(usage!(
                    "local.evaluation.every_updates = {every_updates}: checkpoints are played, and \
                     learner.checkpoint_period_updates = {period}: take a multiple of that, or --set it"
                ));
            }
            if !(1..=1_000_000).contains(&episodes) {
                return Err(usage!(
                    "local.evaluation.episodes = {episodes}: an evaluation has 1 to 1,000,000 episodes"
                ));
            }
        }
        check(local.learner_device.check_precision(learner.precision))?;
        self.check_auxiliary_loss()?;
        let rng = &mut ChaCha8Rng::seed_from_u64(0);
        check(learner.affinity.make_estimator(self.model.num_actions, rng))?;
        let needs_affinity = self.run.horizon.reads_affinity();
        let learns_affinity = learner.affinity.estimator != EstimatorKind::None;
        match (needs_affinity, learns_affinity) {
            (true, false) => Err(usage!(
                "run.horizon needs the action affinity, but learner.affinity.estimator is none: --set learner.affinity.estimator=learned"
            )),
            (false, true) => Err(usage!(
                "learner.affinity.estimator keeps an affinity that run.horizon does not use: --set learner.affinity.estimator=none"
            )),
            _ => Ok(self),
        }
    }

    /// Checks that the replay serves as many positives as the auxiliary loss needs and no more.
    fn check_auxiliary_loss(&self) -> Result<(), Usage> {
        let auxiliary_loss = self.learner.update.auxiliary_loss;
        let needed = auxiliary_loss.positives().served();
        let served = self.run.horizon.positives();
        if needed.counts.contains(&served) {
            return Ok(());
        }
        let later = match served {
            0 => "no later state".into(),
            1 => "one later state".into(),
            states => format!("{states} later states"),
        };
        Err(usage!(
            "run.horizon serves {} a row, but learner.update.auxiliary_loss = {} looks at {}: --set 'run.horizon={}', or take another --agent",
            later,
            auxiliary_loss.name(),
            needed.words,
            needed.example_horizon
        ))
    }
}
