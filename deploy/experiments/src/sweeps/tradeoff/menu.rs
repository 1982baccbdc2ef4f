//! The settings of a call of `driml tradeoff`: the dials, their levels as settings, and the runs that follow.
//! Nothing is measured here. `tradeoff.toml` has the menu itself, and what all levels of a world share.

use std::collections::BTreeMap;

use driml_envs::WorldName;
use driml_machine::error::{Usage, did_you_mean, usage};
use driml_settings::config::RunConfig;
use serde::{Deserialize, Serialize};

use crate::{
    flags::TradeoffArgs,
    sweep::{PlannedRun, TrainCall},
};

/// A base has this many times the seeds of a level. All levels are compared with it, so chance in the base affects all differences.
const BASE_SEEDS: u32 = 2;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Menu {
    full: Length,
    smoke: Length,
    /// The settings of worlds, by the name of a world or of its kind.
    world: BTreeMap<String, WorldBase>,
    /// The dials, in the order in which they are tried.
    dial: Vec<Dial>,
}

/// The settings that a length (full or smoke) gives to the runs in every world.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Length {
    preset: String,
    seeds: u32,
    episodes: u32,
    /// The frames of a run; `None` takes those of the world.
    frames: Option<u64>,
    /// Settings in the form of `--set`, applied after those of the world.
    sets: Vec<String>,
}

/// The settings of all runs in the worlds of one kind, or in one game.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WorldBase {
    frames: u64,
    /// Settings in the form of `--set`.
    sets: Vec<String>,
}

/// A dial: a setting to vary, with a base and the levels that are compared with the base.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Dial {
    pub(super) name: String,
    /// The name of the level that the world's settings give.
    pub(super) base: String,
    buys: String,
    costs: String,
    /// The agent of the base; C51 by default.
    #[serde(default = "c51")]
    pub(super) agent: String,
    /// The kinds of worlds that have this dial; all if empty.
    #[serde(default)]
    worlds: Vec<String>,
    /// Levels given as values of the setting that the dial is named after.
    #[serde(default, skip_serializing)]
    values: Vec<String>,
    #[serde(default, skip_serializing)]
    levels: Vec<Level>,
}

fn c51() -> String {
    "c51".into()
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Level {
    name: String,
    /// Settings in the form of `--set`, applied after those of the world.
    #[serde(default)]
    sets: Vec<String>,
    /// The agent, if it differs from that of the dial.
    agent: Option<String>,
}

/// One choice of all settings except the seed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Point {
    /// The name of the point in the names of its runs and pieces.
    pub(super) key: String,
    pub(super) agent: String,
    /// Settings applied after those of the world.
    pub(super) sets: Vec<String>,
}

#[derive(Clone, Debug)]
pub(super) struct DialLevel {
    pub(super) dial: Dial,
    pub(super) level: String,
    pub(super) base: Point,
    pub(super) point: Point,
    /// Whether the call requests this dial. The page also has the runs of dials that other calls requested.
    pub(super) is_requested: bool,
}

impl DialLevel {
    pub(super) const fn points(&self) -> [&Point; 2] {
        [&self.base, &self.point]
    }

    pub(super) fn name(&self) -> String {
        format!("{} = {}", self.dial.name, self.level)
    }
}

impl Dial {
    fn levels(&self, is_requested: bool) -> impl Iterator<Item = DialLevel> {
        let base = Point {
            key: self.agent.clone(),
            agent: self.agent.clone(),
            sets: Vec::new(),
        };
        let values = self.values.iter().map(move |value| Level {
            name: value.clone(),
            sets: vec![format!("{}={value}", self.name)],
            agent: None,
        });
        values.chain(self.levels.iter().cloned()).map(move |level| {
            let agent = level.agent.unwrap_or_else(|| self.agent.clone());
            let key = match level.sets.is_empty() {
                true => agent.clone(),
                false => format!("{agent}-{}-{}", slug(&self.name), slug(&level.name)),
            };
            DialLevel {
                dial: self.clone(),
                level: level.name,
                base: base.clone(),
                point: Point {
                    key,
                    agent,
                    sets: level.sets,
                },
                is_requested,
            }
        })
    }
}

/// Converts a name to one for files: letters, digits, dots and single dashes.
fn slug(name: &str) -> String {
    let parts = name.split(|c: char| !c.is_ascii_alphanumeric() && c != '.');
    let parts = parts.filter(|part| !part.is_empty());
    parts.collect::<Vec<_>>().join("-")
}

/// The settings that all runs of a folder share. Dials, levels and seeds can be added later.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Common {
    pub(super) env: String,
    pub(super) preset: String,
    pub(super) sets: Vec<String>,
    pub(super) frames: u64,
    pub(super) episodes: u32,
    /// The number of concurrent runs. It decides the threads of each run, and so what wall-clock time means.
    pub(super) jobs: u32,
}

#[derive(Clone, Debug)]
pub(super) struct Settings {
    pub(super) common: Common,
    pub(super) levels: Vec<DialLevel>,
    pub(super) seeds: u32,
    /// Whether the number of frames may still be reduced to fit the budget.
    pub(super) may_shorten: bool,
}

impl Settings {
    /// Returns the settings of a call. A folder with earlier runs keeps their length.
    pub(super) fn from_args(
        args: &TradeoffArgs,
        world: WorldName,
        stored: Option<Common>,
    ) -> Result<Self, Usage> {
        let menu: Menu = toml::from_str(include_str!("../tradeoff.toml"))
            .unwrap_or_else(|e| panic!("tradeoff.toml is built in, and a test reads it: {e}"));
        let smoke = args.flags.smoke;
        let length = if smoke { menu.smoke } else { menu.full };
        let base = world_base(menu.world, world)?;
        let asked = [base.sets, length.sets, args.queue.sets.clone()];
        let stored = stored.as_ref();
        let frames = args.frames.or(stored.map(|it| it.frames));
        let episodes = args.episodes.or(stored.map(|it| it.episodes));
        let jobs = args.queue.jobs.or(stored.map(|it| it.jobs));
        Ok(Self {
            common: Common {
                env: world.to_string(),
                preset: length.preset,
                sets: asked.concat(),
                frames: frames.or(length.frames).unwrap_or(base.frames),
                episodes: episodes.unwrap_or(length.episodes),
                jobs: jobs.unwrap_or(1),
            },
            levels: levels(menu.dial, world, &args.dials)?,
            seeds: args.flags.seeds.unwrap_or(length.seeds),
            may_shorten: frames.is_none() && !args.queue.report,
        })
    }

    /// Whether the call requests this point, as a level or as the base of a level.
    pub(super) fn requests(&self, point: &Point) -> bool {
        let mut asked = self.levels.iter().filter(|it| it.is_requested);
        asked.any(|it| it.points().contains(&point))
    }

    /// Returns the base beside which a point is timed, whichever dial requests it: the base of its level, or itself if it is only a base.
    pub(super) fn timing_base<'a>(&'a self, point: &'a Point) -> &'a Point {
        let level = self.levels.iter().find(|it| it.point == *point);
        level.map_or(point, |it| &it.base)
    }

    pub(super) const fn seed_count(&self, is_base: bool) -> u32 {
        match is_base {
            true => BASE_SEEDS * self.seeds,
            false => self.seeds,
        }
    }
}

impl Common {
    pub(super) fn config(&self, point: &Point) -> Result<RunConfig, Usage> {
        self.plan_run(point, 1).call.config()
    }

    pub(super) fn plan_run(&self, point: &Point, seed: u32) -> PlannedRun {
        let call = TrainCall {
            env: Some(self.env.clone()),
            agent: Some(point.agent.clone()),
            preset: Some(self.preset.clone()),
            seed,
            frames: Some(self.frames),
            sets: self.sets.iter().chain(&point.sets).cloned().collect(),
        };
        let name = format!("{}-seed{seed}", point.key);
        PlannedRun::new(&name, call, self.frames)
    }
}

/// Returns the levels of all dials of a world, in the order of the menu. `names` are the requested dials; all if empty.
fn levels(mut all: Vec<Dial>, world: WorldName, names: &[String]) -> Result<Vec<DialLevel>, Usage> {
    all.retain(|it| it.worlds.is_empty() || it.worlds.iter().any(|kind| kind == world.kind()));
    let known: Vec<_> = all.iter().map(|dial| dial.name.as_str()).collect();
    if let Some(unknown) = names.iter().find(|name| !known.contains(&name.as_str())) {
        return Err(usage!(
            "unknown dial {unknown:?} in this world{}; --dials takes {}",
            did_you_mean(unknown, known.iter().copied()),
            known.join(", ")
        ));
    }
    let requests = |dial: &Dial| names.is_empty() || names.contains(&dial.name);
    let levels = all.iter().flat_map(|dial| dial.levels(requests(dial)));
    Ok(levels.collect())
}

/// Returns the settings of all runs in a world. The entry of a game takes precedence over that of its kind.
fn world_base(
    mut worlds: BTreeMap<String, WorldBase>,
    world: WorldName,
) -> Result<WorldBase, Usage> {
    let own = worlds.remove(&world.to_string());
    own.or_else(|| worlds.remove(world.kind())).ok_or_else(|| {
        let kinds = worlds.into_keys().filter(|name| !name.contains(':'));
        usage!(
            "driml tradeoff has no settings for {world}; it has settings for {}",
            kinds.collect::<Vec<_>>().join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use driml_settings::presets;

    use super::*;
    use crate::flags::tests::parse;

    fn of(line: &str, found: Option<Common>) -> Result<Settings, Usage> {
        let args: TradeoffArgs = parse(line);
        Settings::from_args(&args, presets::world(&args.env)?, found)
    }

    fn settings(world: &str, smoke: &str) -> Settings {
        // Without this the free memory would decide the replay's capacity.
        let line = format!("--env={world} --set=replay.capacity_transitions=10000{smoke}");
        of(&line, None).unwrap()
    }

    #[test]
    fn every_level_of_every_dial_is_a_run_that_can_be_made() {
        let worlds = ["mspacman", "coinrun", "fruitbot", "dodgeball", "chain"];
        for (name, smoke) in worlds.iter().flat_map(|it| [(it, ""), (it, " --smoke")]) {
            let Settings { common, levels, .. } = settings(name, smoke);
            let mut keys = BTreeSet::new();
            for DialLevel { base, point, .. } in levels {
                let config = common.config(&point);
                let config = config.unwrap_or_else(|e| panic!("{name} {}: {e}", point.key));
                let key = point.key;
                let is_base = config == common.config(&base).unwrap();
                assert!(!is_base, "{key}: nothing is turned");
                let one = keys.insert(key.clone());
                assert!(one || point.sets.is_empty(), "{key} twice");
            }
        }
    }

    /// Worlds, a dial without `values`, and the settings that its base has in these worlds on any machine.
    const BASES: &str = "\
mspacman coinrun|pairs NtM|learner.update.lambda.3t3=0 learner.update.lambda.3t4=0 learner.update.lambda.4t3=0
mspacman|observation|input.height=42 input.width=38
coinrun|observation|input.height=64 input.width=64
coinrun|colour|world.grey=false
mspacman coinrun|model.conv|model.conv=[{out=32,kernel=8,stride=4},{out=64,kernel=4,stride=2},{out=64,kernel=3,stride=1}]
mspacman coinrun chain|actors x environments|actor.envs=16
mspacman coinrun chain|replay.shards|replay.shards=1";

    #[test]
    fn a_base_has_what_its_dial_says() {
        for world in ["mspacman", "coinrun", "chain"] {
            let Settings { common, levels, .. } = settings(world, "");
            for DialLevel { dial, base, .. } in &levels {
                let mut lines = BASES.lines().map(|it| it.split('|').collect::<Vec<_>>());
                let line = lines.find(|it| it[0].contains(world) && it[1] == dial.name);
                // A dial with values is named after the setting that they are values of.
                let by_name =
                    (!dial.values.is_empty()).then(|| format!("{}={}", dial.name, dial.base));
                let said = line.map(|it| it[2].to_owned()).or(by_name);
                // The base of the others is an agent, or a preset that another test compares.
                let is_whole = dial.name == "DIM" || dial.name.starts_with("preset");
                assert!(said.is_some() || is_whole, "{}", dial.name);
                let mut with = base.clone();
                with.sets
                    .extend(said.iter().flat_map(|it| it.split(' ')).map(String::from));
                let configs = [base, &with].map(|point| common.config(point).unwrap());
                assert_eq!(configs[0], configs[1], "{said:?} in {world}");
            }
        }
    }

    #[test]
    fn a_level_that_is_also_a_base_is_timed_beside_its_own() {
        let settings = of("--env mspacman --dials model.embedding_dim", None).unwrap();
        let asked = settings.levels.iter().find(|it| it.is_requested).unwrap();
        let timed = |point: &Point| {
            let base = settings.timing_base(point).key.clone();
            (base, settings.requests(point))
        };
        assert_eq!(timed(&asked.base), ("c51".into(), true));
        assert_eq!(timed(&asked.point), ("driml-fix".into(), true));
        assert_eq!(timed(&settings.levels[0].base), ("c51".into(), false));
    }

    #[test]
    fn the_entry_of_a_game_comes_before_that_of_its_kind() {
        for (name, sets) in [("fruitbot", 5), ("coinrun", 1)] {
            let common = of(&format!("--env {name}"), None).unwrap().common;
            let found = (common.frames, common.sets.len());
            assert_eq!(found, (30_000, sets), "{name}");
        }
    }

    #[test]
    fn a_preset_as_a_level_is_that_preset() {
        let Settings { common, levels, .. } = settings("mspacman", "");
        let of = |preset: &str, point: &Point| {
            let mut common = common.clone();
            common.preset = preset.to_owned();
            let mut config = common.config(point).unwrap();
            // The note of a preset with a price says what it gives up, so the points differ in it.
            config.accuracy_note = None;
            config
        };
        let is_preset = |it: &&DialLevel| it.dial.name.starts_with("preset");
        let presets: Vec<_> = levels.iter().filter(is_preset).collect();
        assert!(!presets.is_empty());
        for it in presets {
            assert_eq!(of("paper", &it.base), of(&it.dial.base, &it.base));
            let whole = of(&it.level, &it.base);
            assert_eq!(of("paper", &it.point), whole, "{}", it.point.key);
        }
    }

    #[test]
    fn a_folder_keeps_its_length() {
        let first = of("--env mspacman", None).unwrap();
        assert!(first.may_shorten);
        let found = Common {
            frames: 777,
            episodes: 7,
            jobs: 2,
            ..first.common
        };
        let again = of("--env mspacman", Some(found)).unwrap();
        let kept = &again.common;
        assert_eq!((kept.frames, kept.episodes, kept.jobs), (777, 7, 2));
        assert!(!again.may_shorten);
        // A report measures nothing, so it does not choose a length.
        assert!(!of("--env mspacman --report", None).unwrap().may_shorten);
    }

    #[test]
    fn names_that_nothing_has() {
        let said = |line| of(line, None).unwrap_err().to_string();
        let dial = said("--env chain --dials learner.precison");
        let meant = "did you mean \"learner.precision\"?";
        assert!(dial.contains(meant), "{dial}");
        let world = said("--env ising");
        let kinds = "it has settings for chain, mspacman, procgen";
        assert!(world.contains(kinds), "{world}");
    }
}
