//! The resolved settings of a run: one TOML with a table for each part, checked as a whole.
//! It fills in no number but those that follow from others and those that the machine decides.

use driml_envs::{WorldConfig, WorldName};
use driml_learner::EstimatorKind;
use driml_model::ModelConfig;
use driml_protocol::{Horizon, RunSpec};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use toml::{Table, Value};

use crate::{
    derived::{self, derive},
    error::{Usage, usage},
    machine::Machine,
    overrides::Override,
    presets::{self, Preset},
};

/// What `driml local` does with the parts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct LocalConfig {
    /// Actor processes.
    pub(crate) actors: u32,
    /// Threads of the learner.
    pub(crate) learner_threads: u32,
}

/// The resolved settings of a run.
#[derive(Clone, Debug)]
pub(crate) struct RunConfig {
    table: Table,
    /// What every part agrees on.
    pub(crate) run: RunSpec,
    /// The world.
    pub(crate) world: WorldConfig,
    /// The actors' own.
    pub(crate) actor: driml_actor::Config,
    /// The replay server's own.
    pub(crate) replay: driml_replay_server::Config,
    /// The learner's own.
    pub(crate) learner: driml_learner::Config,
    /// The network.
    pub(crate) model: ModelConfig,
    /// The launcher's own.
    pub(crate) local: LocalConfig,
    /// What a person should know before the run starts.
    pub(crate) notes: Vec<String>,
}

/// Where the settings come from before flags are applied.
#[derive(Clone, Debug)]
pub(crate) enum Source {
    /// Layers: preset, world, agent.
    Layers(&'static Preset, WorldName, &'static str),
    /// A file that driml wrote: its name and text.
    File(String, String),
}

/// Flags over the source, in the order in which they apply.
#[derive(Clone, Debug, Default)]
pub(crate) struct Flags {
    pub(crate) actors: Option<u32>,
    pub(crate) envs: Option<u32>,
    pub(crate) frames: Option<u64>,
    pub(crate) seed: Option<u64>,
    pub(crate) sets: Vec<String>,
}

/// Resolves the settings of a run: source, flags, `--set`, what the machine decides, what follows from the rest.
///
/// # Errors
/// The first setting that is unknown, of the wrong type, out of range, or at odds with another.
pub(crate) fn resolve(
    source: &Source,
    flags: &Flags,
    machine: &Machine,
) -> Result<RunConfig, Usage> {
    let mut table = match source {
        Source::Layers(preset, world, agent) => {
            let mut table = presets::layers(preset, *world, presets::agent(agent)?)?;
            derived::name(&mut table, &world.to_string(), agent);
            table
        }
        Source::File(name, text) => {
            let read: Table = text
                .parse()
                .map_err(|e: toml::de::Error| usage!("{name} is not TOML: {}", e.message()))?;
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
        fill(&mut table, "actor", "envs", machine.envs());
        fill(&mut table, "actor", "world_threads", 0);
    }
    let by_flag = [
        ("local.actors", flags.actors.map(u64::from)),
        ("actor.envs", flags.envs.map(u64::from)),
        ("replay.transitions_max", flags.frames),
        ("run.seed", flags.seed),
    ];
    for (path, value) in by_flag {
        if let Some(value) = value {
            Override::parse(&format!("{path}={value}"))?.apply(&mut table)?;
        }
    }
    let capacity_set = set(&mut table, &flags.sets)? || !sized_by_machine;
    let note = fit_memory(&mut table, capacity_set, machine)?;
    derive(&mut table)?;
    let mut config = RunConfig::from_table(table).map_err(|e| match source {
        Source::File(name, _) if flags.sets.is_empty() => usage!("{name}: {e}"),
        _ => e,
    })?;
    config.notes.extend(note);
    Ok(config)
}

/// Applies every `--set`; returns whether the replay's capacity was among them.
fn set(table: &mut Table, sets: &[String]) -> Result<bool, Usage> {
    let mut capacity_set = false;
    for text in sets {
        let one = Override::parse(text)?;
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

fn fill(table: &mut Table, name: &str, key: &str, value: u32) {
    let inner = table
        .entry(name)
        .or_insert_with(|| Value::Table(Table::new()));
    if let Some(inner) = inner.as_table_mut() {
        inner.entry(key).or_insert(Value::Integer(value.into()));
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
    let bytes_each = replay_bytes_each(&run);
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let fits = |bytes: u64| bytes / bytes_each;
    let free = gib(machine.memory_bytes);
    let asked = replay.capacity_transitions;
    if capacity_set && asked > fits(machine.replay_bytes_max()) {
        return Err(usage!(
            "replay.capacity_transitions = {asked} needs {:.1} GiB, and {free:.1} GiB are free: --set replay.capacity_transitions={}",
            gib(asked.saturating_mul(bytes_each)),
            fits(machine.replay_bytes())
        ));
    }
    let capacity = fits(machine.replay_bytes());
    if capacity_set || asked <= capacity {
        return Ok(None);
    }
    Override::parse(&format!("replay.capacity_transitions={capacity}"))?.apply(table)?;
    // A replay that holds the whole run anyway is as good as a larger one.
    let matters = replay
        .transitions_max
        .is_none_or(|frames| frames > capacity);
    Ok(matters.then(|| {
        format!(
            "the replay holds the newest {capacity} transitions instead of {asked}: {free:.1} GiB of memory are free, and half is taken"
        )
    }))
}

/// Bytes that one transition takes in the replay: its frame and its small fields.
pub(crate) const fn replay_bytes_each(run: &RunSpec) -> u64 {
    run.frame_bytes() as u64 + 32
}

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
        "run", "world", "input", "actor", "replay", "learner", "model", "local",
    ];
    if let Some(other) = table.keys().find(|key| !tables.contains(&key.as_str())) {
        return Err(usage!(
            "the settings have an unknown field {other:?}; their tables are {}",
            tables.join(", ")
        ));
    }
    let _: driml_actor::InputSize = read(table, "input")?;
    Ok(RunConfig {
        run: read(table, "run")?,
        world: read(table, "world")?,
        actor: read(table, "actor")?,
        replay: read(table, "replay")?,
        learner: read(table, "learner")?,
        model: read(table, "model")?,
        local: read(table, "local")?,
        table: table.clone(),
        notes: Vec::new(),
    })
}

impl RunConfig {
    fn from_table(table: Table) -> Result<Self, Usage> {
        let mut config = parts_read(&table)?;
        config.validate()?;
        config.notes = presets::notes(&config.run.agent, &config.run.world);
        Ok(config)
    }

    /// Reads resolved settings, as in a run folder's `config.toml`.
    ///
    /// # Errors
    /// As [`resolve`].
    pub(crate) fn parse(name: &str, text: &str) -> Result<Self, Usage> {
        let table: Table = text
            .parse()
            .map_err(|e: toml::de::Error| usage!("{name} is not TOML: {}", e.message()))?;
        derived::check(&table)
            .and_then(|()| Self::from_table(table))
            .map_err(|e| usage!("{name}: {e}"))
    }

    /// The settings as every part reads them.
    pub(crate) fn to_toml(&self) -> String {
        toml::to_string(&self.table).expect("a table of plain values is TOML")
    }

    /// Transitions of the whole run.
    pub(crate) fn frames(&self) -> u64 {
        self.replay.transitions_max.unwrap_or(u64::MAX)
    }

    /// Updates that belong to all transitions, at the replay ratio.
    pub(crate) fn updates(&self) -> u64 {
        let after = self.frames().saturating_sub(self.replay.warmup_transitions);
        (after as f64 * self.replay.replay_ratio / f64::from(self.learner.batch_rows)).floor()
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
            .validate(&self.run, self.learner.batch_rows)
            .map_err(|e| said(&e))?;
        self.learner.validate().map_err(|e| said(&e))?;
        self.learner.update.validate().map_err(|e| said(&e))?;
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
        let wanted = self.learner.update.lambda.wanted().contains(&true);
        match (self.run.horizon, wanted) {
            (Horizon::None, true) => Err(usage!(
                "learner.update.lambda asks for DIM, but run.horizon draws no positive: set all four lambdas to 0, or --set 'run.horizon={{rule=\"fixed\",k=1}}'"
            )),
            (Horizon::None, false) | (_, true) => Ok(()),
            (_, false) => Err(usage!(
                "run.horizon draws positives, but all of learner.update.lambda are 0: --set 'run.horizon={{rule=\"none\"}}', or set a lambda above 0"
            )),
        }?;
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
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;
    use crate::presets::{AGENTS, PRESETS};

    const MACHINE: Machine = Machine {
        cores: 2,
        memory_bytes: 16 << 30,
    };

    fn source(preset: &str, world: &str, agent: &str) -> Source {
        let agent = presets::agent(agent).unwrap();
        Source::Layers(
            presets::preset(preset).unwrap(),
            world.parse().unwrap(),
            agent.name,
        )
    }

    fn sets(sets: &[&str]) -> Flags {
        Flags {
            sets: sets.iter().map(|&set| set.into()).collect(),
            ..Flags::default()
        }
    }

    fn with(world: &str, agent: &str, set: &[&str]) -> Result<RunConfig, String> {
        resolve(&source("paper", world, agent), &sets(set), &MACHINE).map_err(|e| e.to_string())
    }

    #[test]
    fn every_preset_in_every_world_for_every_agent_resolves_and_reads_back() {
        let mut resolved = 0;
        for preset in &PRESETS {
            for world in WorldName::all() {
                for agent in &AGENTS {
                    let source = Source::Layers(preset, world, agent.name);
                    let config = match resolve(&source, &Flags::default(), &MACHINE) {
                        Err(e) if e.0.contains("take --preset paper") => continue,
                        other => other.unwrap_or_else(|e| {
                            panic!("{} {world} {}: {e}", preset.name, agent.name)
                        }),
                    };
                    let text = config.to_toml();
                    let file = Source::File("config.toml".into(), text.clone());
                    let again = resolve(&file, &Flags::default(), &MACHINE).unwrap();
                    assert_eq!(again.run.hash(), config.run.hash());
                    assert_eq!(again.to_toml(), text);
                    assert_eq!(
                        RunConfig::parse("config.toml", &text).unwrap().to_toml(),
                        text
                    );
                    driml_actor::ActorSettings::from_toml(&text).unwrap();
                    resolved += 1;
                }
            }
        }
        // Two presets are for all 19 worlds, two for Procgen's 16 games.
        assert_eq!(resolved, (2 * 19 + 2 * 16) * 4);
    }

    #[test]
    fn the_default_run_is_the_papers() {
        let config = with("procgen:bigfish", "driml-ada", &[]).unwrap();
        expect![[r#"
            [actor]
            ack_timeout_ms = 10000
            chunks_in_flight_max = 4
            envs = 16
            epsilon_decay_frames = 100000
            epsilon_end = 0.01
            epsilon_start = 0.1
            steps_per_chunk = 16
            unreachable_max_ms = 60000
            world_threads = 0
        "#]]
        .assert_eq(&format!(
            "[actor]\n{}",
            config.table["actor"].as_table().unwrap()
        ));
        assert_eq!(config.model.dim.psi4, config.model.dim.phi4);
        assert_eq!(
            (config.model.dim.psi3, config.model.dim.action),
            (false, true)
        );
        // 199_000 transitions after the warm-up at 8 rows each, in batches of 256.
        assert_eq!(config.updates(), 6_218);
    }

    #[test]
    fn what_nobody_uses_is_not_there() {
        let config = with("mspacman", "c51", &[]).unwrap();
        assert_eq!(config.run.horizon, Horizon::None);
        assert_eq!(config.model.dim, driml_model::DimParts::NONE);
        assert_eq!(config.learner.affinity.learned, None);
        // Nothing to tell apart in a world with a single action.
        assert!(!with("ising", "driml-fix", &[]).unwrap().model.dim.action);
    }

    #[test]
    fn settings_that_cannot_work_are_answered_with_what_to_do() {
        let said = |agent: &str, set: &str| with("procgen:bigfish", agent, &[set]).unwrap_err();
        expect![[r#"there is no setting "learner.update.adam.learning_rate"; [learner.update.adam] has beta1, beta2, eps, lr"#]].assert_eq(&said("driml-ada", "learner.update.adam.learning_rate=1"));
        expect![[r#"there is no setting "learner.adam.lr" (did you mean "learner.update.adam.lr"?); [learner] has affinity, batch_rows, batches_in_flight, checkpoint_period_updates, checkpoints_kept, publish_period_updates, update"#]].assert_eq(&said("driml-ada", "learner.adam.lr=1e-4"));
        expect![[r#"there is no setting "world.num_level" (did you mean "world.num_levels"?); [world] has center_agent, distribution_mode, num_levels, paint_vel_info, restrict_themes, start_level, use_backgrounds, use_sequential_levels"#]].assert_eq(&said("driml-ada", "world.num_level=5"));
        expect!["model.height cannot be set by hand: it follows from input.height"]
            .assert_eq(&said("driml-ada", "model.height=84"));
        expect!["model.dim cannot be set by hand: it follows from learner.update.lambda"]
            .assert_eq(&said("driml-ada", "model.dim.psi3=true"));
        expect!["run.gamma = 1.5 cannot work: a discount lies between 0 and 1"]
            .assert_eq(&said("driml-ada", "run.gamma=1.5"));
        expect!["run.horizon = 0 cannot work: k lies between 1 and 1000"]
            .assert_eq(&said("driml-ada", "run.horizon={rule=\"fixed\",k=0}"));
        expect!["in the settings' [run] table: unknown variant `always`, expected one of `none`, `fixed`, `uniform`, `nhg`"].assert_eq(&said("driml-ada", "run.horizon.rule=always"));
        expect![[r#"run.horizon draws positives, but all of learner.update.lambda are 0: --set 'run.horizon={rule="none"}', or set a lambda above 0"#]].assert_eq(&said("driml-ada", "learner.update.lambda.4t4=0"));
        expect![[r#"learner.update.lambda asks for DIM, but run.horizon draws no positive: set all four lambdas to 0, or --set 'run.horizon={rule="fixed",k=1}'"#]].assert_eq(&said("c51", "learner.update.lambda.4t4=1"));
        expect!["run.horizon follows the action affinity, which nobody estimates: --set learner.affinity.estimator=learned"].assert_eq(&said("driml-ada", "learner.affinity.estimator=none"));
        expect!["learner.affinity.alphabet = (missing) cannot work: the chosen estimator needs it: start from a preset"].assert_eq(&said("driml-fix", "learner.affinity.estimator=exact"));
        expect![
            "replay.replay_ratio = 0 cannot work: rows per transition must be a number above 0"
        ]
        .assert_eq(&said("driml-ada", "replay.replay_ratio=0"));
        expect!["500 frames are no more than the warm-up of 1000: ask for more --frames, or --set replay.warmup_transitions=50"].assert_eq(&said("driml-ada", "replay.transitions_max=500"));
        expect!["in the settings' [world] table: invalid value: integer `-1`, expected u32"]
            .assert_eq(&said("driml-ada", "world.num_levels=-1"));
        expect!["bad learner setting: adam.lr is 0"]
            .assert_eq(&said("driml-ada", "learner.update.adam.lr=0"));
        expect!["replay.capacity_transitions = 100000000000 needs 1147389.4 GiB, and 16.0 GiB are free: --set replay.capacity_transitions=697234"].assert_eq(&said(
            "driml-ada",
            "replay.capacity_transitions=100000000000",
        ));
    }

    #[test]
    fn optional_settings_can_be_set_though_no_preset_has_them() {
        let ising = "world.ising={temperature=0.4,sweeps_per_step=1}";
        let config = with("mspacman", "c51", &[ising]).unwrap();
        assert!(matches!(config.world, WorldConfig::MsPacman(world) if world.ising.is_some()));
        let map = with(
            "procgen:maze",
            "driml-ada",
            &["learner.affinity.alphabet=visible"],
        )
        .unwrap();
        assert_eq!(map.learner.affinity.visible.unwrap()[..3], [1, 1, 1]);
    }

    #[test]
    fn a_file_at_odds_with_itself_is_refused() {
        let text = with("mspacman", "c51", &[]).unwrap().to_toml();
        let said = |text: String| {
            resolve(
                &Source::File("x.toml".into(), text),
                &Flags::default(),
                &MACHINE,
            )
            .unwrap_err()
            .to_string()
        };
        expect!["x.toml: run.num_actions = 6, but it follows from the world and is 5; correct the one or the other"].assert_eq(&said(text.replace("num_actions = 5", "num_actions = 6")));
        expect!["x.toml: the settings lack input.height, a whole number: use a config.toml that driml wrote"].assert_eq(&said(text.replace("[input]", "[inputs]")));
        expect!["x.toml: in the settings' [world] table: unknown field `boost_steps`, expected one of `cells`, `height`, `width`, `step_limit`, `reward_left`, `reward_right`"].assert_eq(&said(
            text.replace("world = \"mspacman\"", "world = \"chain\""),
        ));
        expect![
            "x.toml is not TOML: unquoted keys cannot be empty, expected letters, numbers, `-`, `_`"
        ]
        .assert_eq(&said("= 3".into()));
        expect!["x.toml: the settings lack run.world, a word: use a config.toml that driml wrote"]
            .assert_eq(&said(String::new()));
        expect!["x.toml: in the settings' [actor] table: unknown field `colour`, expected one of `envs`, `steps_per_chunk`, `chunks_in_flight_max`, `world_threads`, `epsilon_start`, `epsilon_end`, `epsilon_decay_frames`, `ack_timeout_ms`, `unreachable_max_ms`"].assert_eq(&said(text.replace("envs = 16", "envs = 16\ncolour = 1")));
    }

    #[test]
    fn flags_come_before_set_and_both_before_the_machine() {
        let flags = Flags {
            frames: Some(7_000),
            seed: Some(5),
            actors: Some(3),
            envs: Some(2),
            sets: vec!["run.seed=6".into()],
        };
        let config = resolve(&source("paper", "chain", "c51"), &flags, &MACHINE).unwrap();
        assert_eq!(
            (
                config.frames(),
                config.run.seed,
                config.local.actors,
                config.actor.envs
            ),
            (7_000, 6, 3, 2)
        );
    }

    #[test]
    fn the_replay_fits_the_memory_and_says_so() {
        let flags = Flags {
            frames: Some(50_000_000),
            ..Flags::default()
        };
        let small = Machine {
            cores: 2,
            memory_bytes: 8 << 30,
        };
        let config = resolve(
            &source("paper", "procgen:bigfish", "driml-fix"),
            &flags,
            &small,
        )
        .unwrap();
        expect![[r#"
            the paper's driml-fix augments the DIM inputs on this game; this build does not augment, so expect other numbers
            the replay holds the newest 348617 transitions instead of 1000000: 8.0 GiB of memory are free, and half is taken"#]].assert_eq(&config.notes.join("\n"));
        assert!(config.replay.capacity_transitions < 400_000);
        let large = Machine {
            cores: 2,
            memory_bytes: 64 << 30,
        };
        let config = resolve(
            &source("paper", "procgen:heist", "driml-fix"),
            &flags,
            &large,
        )
        .unwrap();
        assert_eq!(
            (config.replay.capacity_transitions, config.notes.len()),
            (1_000_000, 0)
        );
    }
}
