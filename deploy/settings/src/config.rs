//! The resolved settings of a run: one TOML with a table for each part, checked as a whole.
//! It fills in no number but those that follow from others and those that the machine decides.

use clap::{
    Args,
    builder::{PossibleValue, PossibleValuesParser, TypedValueParser},
};
use driml_actor::InputSize;
use driml_envs::{WorldConfig, WorldName};
use driml_learner::{DeviceName, EstimatorKind};
use driml_machine::{
    error::{Usage, usage},
    resources::{self, Machine},
    units::gib,
};
use driml_model::ModelConfig;
use driml_protocol::{Horizon, RunSpec, config::TransportConfig};
use driml_replay_server::{Compression, ReproducedBug};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use toml::{Table, Value};

use crate::{
    derived::{self, derive},
    overrides::Override,
    presets::{self, Preset},
    renamed,
};

/// What `driml local` does with the parts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalConfig {
    /// Actor processes.
    pub actors: u32,
    /// Threads of the learner.
    pub learner_threads: u32,
    /// What the learner computes on.
    pub learner_device: DeviceName,
}

/// The resolved settings of a run. TOML is what they come from and travel as; between, there is this form alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunConfig {
    /// What every part agrees on.
    pub run: RunSpec,
    /// The world.
    pub world: WorldConfig,
    /// The size to which frames are enlarged.
    pub input: InputSize,
    /// The actors' own.
    pub actor: driml_actor::Config,
    /// The replay server's own.
    pub replay: driml_replay_server::Config,
    /// The learner's own.
    pub learner: driml_learner::Config,
    /// The network.
    pub model: ModelConfig,
    /// How messages travel.
    pub transport: TransportConfig,
    /// The launcher's own.
    pub local: LocalConfig,
    /// What a person should know before the run starts.
    #[serde(skip)]
    pub notes: Vec<String>,
}

/// Where the settings come from before flags are applied.
#[derive(Clone, Debug)]
pub enum Source {
    /// Layers: preset, world, agent.
    Layers(&'static Preset, WorldName, &'static str),
    /// A file that driml wrote: its name and text.
    File(String, String),
}

/// Flags over the source; `--set` applies after the others.
#[derive(Clone, Debug, Default, Args)]
pub struct Flags {
    /// Actor processes [default: by cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub actors: Option<u32>,
    /// Replay servers among which the actors and the memory are spread [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub replay_shards: Option<u32>,
    /// Copies of the world in each actor [default: 16]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub envs: Option<u32>,
    /// Frames of the whole run; it ends when they are in and their updates done
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=i64::MAX as u64))]
    pub frames: Option<u64>,
    /// Seed of every generator of the run
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(0..=i64::MAX as u64))]
    pub seed: Option<u64>,
    /// Train with a known bug of the paper's published code, to see what it does
    #[arg(long, value_name = "BUG", value_parser = reproduced_bugs())]
    pub reproduce_bug: Option<ReproducedBug>,
    /// One setting by its dotted path, such as learner.update.adam.lr=1e-4; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
}

/// The bugs by their names, with what they are for `--help`.
fn reproduced_bugs() -> impl TypedValueParser<Value = ReproducedBug> {
    let named = |bug: ReproducedBug| {
        let about = match bug {
            ReproducedBug::BootstrapFromNextState => {
                "n-step returns that bootstrap from s_{t+1}, with the end of an episode seen at step t alone"
            }
        };
        PossibleValue::new(bug.name()).help(about)
    };
    PossibleValuesParser::new(ReproducedBug::ALL.map(named)).map(|name| {
        let known = ReproducedBug::ALL
            .into_iter()
            .find(|bug| bug.name() == name);
        known.expect("clap lets no other name pass")
    })
}

/// Resolves the settings of a run: source, flags, `--set`, what the machine decides, what follows from the rest.
///
/// # Errors
/// The first setting that is unknown, of the wrong type, out of range, or at odds with another.
pub fn resolve(source: &Source, flags: &Flags, machine: &Machine) -> Result<RunConfig, Usage> {
    let mut table = match source {
        Source::Layers(preset, world, agent) => {
            let mut table = presets::layers(preset, *world, presets::agent(agent)?)?;
            derived::name(&mut table, &world.to_string(), agent);
            table
        }
        Source::File(name, text) => {
            let mut read: Table = text
                .parse()
                .map_err(|e: toml::de::Error| usage!("{name} is not TOML: {}", e.message()))?;
            renamed::update(&mut read);
            derived::complete(&mut read);
            derived::check(&read).map_err(|e| usage!("{name}: {e}"))?;
            read
        }
    };
    let sized_by_machine = matches!(source, Source::Layers(..));
    if sized_by_machine {
        fill(&mut table, "local", "actors", machine.actors());
        fill(
            &mut table,
            "local",
            "learner_threads",
            machine.learner_threads(),
        );
        fill(&mut table, "local", "learner_device", "cpu");
        fill(&mut table, "actor", "envs", machine.envs());
        fill(&mut table, "actor", "world_threads", 0);
    }
    let by_flag = [
        ("local.actors", flags.actors.map(u64::from)),
        ("actor.envs", flags.envs.map(u64::from)),
        ("replay.transitions_max", flags.frames),
        ("replay.shards", flags.replay_shards.map(u64::from)),
        ("run.seed", flags.seed),
    ];
    for (path, value) in by_flag {
        if let Some(value) = value {
            Override::parse(&format!("{path}={value}"))?.apply(&mut table)?;
        }
    }
    set_reproduced_bug(&mut table, flags.reproduce_bug)?;
    let capacity_set = set(&mut table, &flags.sets)? || !sized_by_machine;
    let note = fit_memory(&mut table, capacity_set, machine)?;
    derive(&mut table)?;
    let mut config = RunConfig::from_table(&table).map_err(|e| match source {
        Source::File(name, _) if flags.sets.is_empty() => usage!("{name}: {e}"),
        _ => e,
    })?;
    config.notes.extend(note);
    Ok(config)
}

/// Sets the bug to train with; refuses settings that have one without the flag.
fn set_reproduced_bug(table: &mut Table, asked: Option<ReproducedBug>) -> Result<(), Usage> {
    let Some(replay) = table.get_mut("replay").and_then(Value::as_table_mut) else {
        return Ok(());
    };
    if let (Some(found), None) = (replay.get("reproduced_bug"), asked) {
        return Err(usage!(
            "replay.reproduced_bug = {found}: these settings train with a known bug; add --reproduce-bug {} if that is meant",
            found.as_str().unwrap_or("BUG")
        ));
    }
    if let Some(bug) = asked {
        let name = Value::try_from(bug).map_err(|e| usage!("--reproduce-bug as TOML: {e}"))?;
        replay.insert("reproduced_bug".into(), name);
    }
    Ok(())
}

/// Applies every `--set`; returns whether the replay's capacity was among them.
fn set(table: &mut Table, sets: &[String]) -> Result<bool, Usage> {
    let mut capacity_set = false;
    for text in sets {
        let one = Override::parse(text)?;
        renamed::refuse(&one.path)?;
        derived::refuse(&one.path)?;
        capacity_set |= one.path == "replay.capacity_transitions";
        let mut tried = table.clone();
        let new = one.apply(&mut tried)?;
        // A key that was not there may be an optional one. Its table's own type knows; if it does not, nobody does.
        if new {
            let mut derived = tried.clone();
            let read = derive(&mut derived).and_then(|()| parts_read(&derived));
            if read.is_err_and(|e| e.0.contains("unknown field")) {
                return Err(one.unknown(table));
            }
        }
        *table = tried;
    }
    Ok(capacity_set)
}

fn fill(table: &mut Table, name: &str, key: &str, value: impl Into<Value>) {
    let inner = table
        .entry(name)
        .or_insert_with(|| Value::Table(Table::new()));
    if let Some(inner) = inner.as_table_mut() {
        inner.entry(key).or_insert(value.into());
    }
}

/// Makes the replay as small as the memory, saying so, or refuses one that a person sized too large.
fn fit_memory(
    table: &mut Table,
    capacity_set: bool,
    machine: &Machine,
) -> Result<Option<String>, Usage> {
    let mut derived = table.clone();
    derive(&mut derived)?;
    let run: RunSpec = read(&derived, "run")?;
    let replay: driml_replay_server::Config = read(&derived, "replay")?;
    let local: LocalConfig = read(&derived, "local")?;
    let actors = resources::actors_bytes(local.actors, &run.world);
    if machine.beside_actors(actors) == 0 {
        return Err(usage!(
            "{} actors of {} take about {}, and {} are free: use fewer --actors, with more --envs each",
            local.actors,
            run.world,
            gib(actors),
            gib(machine.memory_bytes)
        ));
    }
    if replay.compression != Compression::None {
        return fit_compressed(table, &run, &replay, (machine, actors));
    }
    let bytes_each = replay_bytes_each(&run);
    let fits = |bytes: u64| bytes / bytes_each;
    let free = gib(machine.memory_bytes);
    let asked = replay.capacity_transitions;
    if capacity_set && asked > fits(machine.replay_bytes_max(actors)) {
        return Err(usage!(
            "replay.capacity_transitions = {asked} needs {}, and {free} are free: --set replay.capacity_transitions={}",
            gib(asked.saturating_mul(bytes_each)),
            fits(machine.replay_bytes(actors))
        ));
    }
    let capacity = fits(machine.replay_bytes(actors));
    if capacity_set || asked <= capacity {
        return Ok(None);
    }
    Override::parse(&format!("replay.capacity_transitions={capacity}"))?.apply(table)?;
    // A replay that holds the whole run anyway is as good as a larger one.
    let is_smaller_than_the_run = replay
        .transitions_max
        .is_none_or(|frames| frames > capacity);
    Ok(is_smaller_than_the_run.then(|| {
        format!(
            "the replay holds the newest {capacity} transitions instead of {asked}: {free} of memory are free, and it takes half, or what actors and learner leave"
        )
    }))
}

/// Bounds the bytes of a compressed replay, as nobody knows beforehand how well its frames compress.
///
/// Half the free memory is taken, or what a person allowed; nothing is bounded where even frames that do not compress fit.
fn fit_compressed(
    table: &mut Table,
    run: &RunSpec,
    replay: &driml_replay_server::Config,
    (machine, actors): (&Machine, u64),
) -> Result<Option<String>, Usage> {
    let free = gib(machine.memory_bytes);
    let asked = replay.capacity_transitions;
    let fields = asked.saturating_mul(COMPRESSED_FIELDS_BYTES);
    let frames = asked.saturating_mul(run.frame_bytes() as u64);
    let bytes = machine.replay_bytes(actors).saturating_sub(fields);
    if fields > machine.replay_bytes(actors) / 2 {
        return Err(usage!(
            "replay.capacity_transitions = {asked} needs {} beside the frames, and {free} are free: --set replay.capacity_transitions={}",
            gib(fields),
            machine.replay_bytes(actors) / 2 / COMPRESSED_FIELDS_BYTES
        ));
    }
    match replay.compressed_bytes_max {
        Some(max) if max.min(frames) > machine.replay_bytes_max(actors) => Err(usage!(
            "replay.compressed_bytes_max = {max} is {}, and {free} are free: --set replay.compressed_bytes_max={bytes}",
            gib(max)
        )),
        Some(_) => Ok(None),
        None if frames <= bytes => Ok(None),
        None => {
            Override::parse(&format!("replay.compressed_bytes_max={bytes}"))?.apply(table)?;
            let run_frames = replay.transitions_max.unwrap_or(u64::MAX);
            let is_smaller_than_the_run =
                run_frames.saturating_mul(run.frame_bytes() as u64) > bytes;
            Ok(is_smaller_than_the_run.then(|| {
                format!(
                    "compressed frames may take {}, as {free} of memory are free; if they compress badly, the replay holds fewer than {asked} transitions",
                    gib(bytes)
                )
            }))
        }
    }
}

/// Bytes that one transition takes in the replay: its frame and its small fields.
pub const fn replay_bytes_each(run: &RunSpec) -> u64 {
    run.frame_bytes() as u64 + 32
}

/// Bytes that one transition takes at most in a compressed replay, beside its frame: its small fields, and its share of the
/// list of blocks if each holds one frame.
pub const COMPRESSED_FIELDS_BYTES: u64 = 128;

fn read<T: DeserializeOwned>(table: &Table, name: &'static str) -> Result<T, Usage> {
    let value = table
        .get(name)
        .ok_or_else(|| usage!("the settings have no [{name}] table"))?;
    value
        .clone()
        .try_into()
        .map_err(|e: toml::de::Error| usage!("in the settings' [{name}] table: {}", e.message()))
}

/// Reads every table as its part will.
fn parts_read(table: &Table) -> Result<RunConfig, Usage> {
    let tables = [
        "run",
        "world",
        "input",
        "actor",
        "replay",
        "learner",
        "model",
        "transport",
        "local",
    ];
    if let Some(other) = table.keys().find(|key| !tables.contains(&key.as_str())) {
        return Err(usage!(
            "the settings have an unknown field {other:?}; their tables are {}",
            tables.join(", ")
        ));
    }
    Ok(RunConfig {
        run: read(table, "run")?,
        world: read(table, "world")?,
        input: read(table, "input")?,
        actor: read(table, "actor")?,
        replay: read(table, "replay")?,
        learner: read(table, "learner")?,
        model: read(table, "model")?,
        transport: read(table, "transport")?,
        local: read(table, "local")?,
        notes: Vec::new(),
    })
}

impl RunConfig {
    fn from_table(table: &Table) -> Result<Self, Usage> {
        let mut config = parts_read(table)?;
        config.validate()?;
        config.notes = presets::notes(&config.run.agent, &config.run.world);
        if config.replay.reproduced_bug.is_some() {
            let note =
                "the targets have a known bug of the paper's published code (--reproduce-bug)";
            config.notes.push(note.into());
        }
        Ok(config)
    }

    /// Reads resolved settings, as in a run folder's `config.toml`.
    ///
    /// # Errors
    /// As [`resolve`].
    pub fn parse(name: &str, text: &str) -> Result<Self, Usage> {
        let mut table: Table = text
            .parse()
            .map_err(|e: toml::de::Error| usage!("{name} is not TOML: {}", e.message()))?;
        renamed::update(&mut table);
        derived::complete(&mut table);
        derived::check(&table)
            .and_then(|()| Self::from_table(&table))
            .map_err(|e| usage!("{name}: {e}"))
    }

    /// The settings as every part reads them, sorted by name.
    pub fn to_toml(&self) -> String {
        let text = toml::to_string(self).expect("a struct of plain values is TOML");
        // As text, a number of 32 bits has the digits that a person wrote; as a value of 64 it would have more.
        let sorted: Table = text.parse().expect("it was just written");
        toml::to_string(&sorted).expect("a table of plain values is TOML")
    }

    /// Transitions of the whole run.
    pub fn frames(&self) -> u64 {
        self.replay.transitions_max.unwrap_or(u64::MAX)
    }

    /// Updates that belong to all transitions, at the replay ratio.
    pub fn updates(&self) -> u64 {
        let after = self.frames().saturating_sub(self.replay.warmup_transitions);
        (after as f64 * self.replay.replay_ratio / f64::from(self.learner.batch_size)).floor()
            as u64
    }

    /// Checks what each part checks of its own table, then what spans two tables.
    fn validate(&self) -> Result<(), Usage> {
        let said = |e: &dyn std::fmt::Display| Usage(e.to_string());
        self.run.validate().map_err(|e| said(&e))?;
        self.world.validate().map_err(|e| said(&e))?;
        self.actor.validate().map_err(|e| said(&e))?;
        if self.replay.transitions_max.is_none() {
            return Err(usage!(
                "replay.transitions_max is missing: say with --frames how long the run is"
            ));
        }
        if self.frames() <= self.replay.warmup_transitions {
            return Err(usage!(
                "{} frames are no more than the warm-up of {}: ask for more --frames, or --set replay.warmup_transitions={}",
                self.frames(),
                self.replay.warmup_transitions,
                self.frames() / 10
            ));
        }
        self.replay
            .validate(&self.run, self.learner.batch_size)
            .map_err(|e| said(&e))?;
        self.learner.validate().map_err(|e| said(&e))?;
        self.learner
            .update
            .validate()
            .map_err(|e| usage!("learner.update cannot work: {e}"))?;
        self.model.validate().map_err(|e| said(&e))?;
        if !(1..=256).contains(&self.local.actors) {
            return Err(usage!(
                "local.actors = {}: a run has 1 to 256 actors",
                self.local.actors
            ));
        }
        if !(1..=1024).contains(&self.local.learner_threads) {
            return Err(usage!(
                "local.learner_threads = {}: a learner has 1 to 1024 threads",
                self.local.learner_threads
            ));
        }
        self.check_objective()?;
        let learns_affinity = self.learner.affinity.estimator != EstimatorKind::None;
        let affinity = self
            .learner
            .affinity
            .estimator(self.model.num_actions, &mut ChaCha8Rng::seed_from_u64(0));
        affinity.map_err(|e| said(&e))?;
        match (
            matches!(self.run.horizon, Horizon::Nhg { .. }),
            learns_affinity,
        ) {
            (true, false) => Err(usage!(
                "run.horizon follows the action affinity, which nobody estimates: --set learner.affinity.estimator=learned"
            )),
            (false, true) => Err(usage!(
                "learner.affinity.estimator keeps an affinity that run.horizon does not use: --set learner.affinity.estimator=none"
            )),
            _ => Ok(()),
        }?;
        Ok(())
    }

    /// The replay serves what the auxiliary objective needs and no more.
    fn check_objective(&self) -> Result<(), Usage> {
        let objective = self.learner.update.objective;
        let positives = objective.positives();
        let served = self.run.horizon.positives();
        if positives.served().contains(&served) {
            return Ok(());
        }
        let later = match served {
            0 => "no later state".into(),
            1 => "one later state".into(),
            states => format!("{states} later states"),
        };
        Err(usage!(
            "run.horizon serves {} a row, but learner.update.objective = {} looks at {}: --set 'run.horizon={}', or take another --agent",
            later,
            objective.name(),
            positives.served_words(),
            positives.horizon()
        ))
    }
}

#[cfg(test)]
mod tests;
