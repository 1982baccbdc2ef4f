//! What a call of `driml tradeoff` asks for: the dials that can be turned, their levels as settings, and the runs that follow.
//! It measures nothing; the menu itself, and what all levels share in a world, is `tradeoff.toml`.

use std::collections::BTreeMap;

use driml_envs::WorldName;
use driml_machine::error::{Usage, nearest, usage};
use driml_settings::config::RunConfig;
use serde::{Deserialize, Serialize};

use crate::{
    flags::TradeoffArgs,
    sweep::plan::{Call, PlannedRun},
};

/// Seeds of a base for each of a level's: all levels are compared with it, so that its luck is in all of their differences.
const BASE_SEEDS: u32 = 2;

/// The file with all of it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Menu {
    full: Length,
    smoke: Length,
    /// By a world's name or its kind.
    world: BTreeMap<String, WorldBase>,
    /// In the order in which they are tried.
    dial: Vec<Dial>,
}

/// What every world's runs have at a length.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Length {
    preset: String,
    /// Of each level.
    seeds: u32,
    /// Played with each run's weights.
    episodes: u32,
    /// Of a run; as its world says if this says nothing.
    frames: Option<u64>,
    /// After those of the world, in the form of `--set`.
    sets: Vec<String>,
}

/// What all runs in the worlds of one kind have, or in one game of it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WorldBase {
    frames: u64,
    /// In the form of `--set`.
    sets: Vec<String>,
}

/// A dial in one world: a base and the levels that are compared with it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Dial {
    pub(super) name: String,
    /// The name of the level that the settings of the world have.
    pub(super) base: String,
    buys: String,
    costs: String,
    /// The agent of its base; C51 if it names none.
    #[serde(default = "c51")]
    pub(super) agent: String,
    /// Kinds of worlds that have it; all if it names none.
    #[serde(default)]
    worlds: Vec<String>,
    /// Levels that set what the dial is named for.
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
    /// In the form of `--set`, over the settings of the world.
    #[serde(default)]
    sets: Vec<String>,
    /// Another agent than the dial's.
    agent: Option<String>,
}

/// One choice of all settings: what a run, of any seed, is made with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Point {
    /// Names its runs and pieces.
    pub(super) key: String,
    pub(super) agent: String,
    /// Over the settings of the world.
    pub(super) sets: Vec<String>,
}

#[derive(Clone, Debug)]
pub(super) struct LevelOf {
    pub(super) dial: Dial,
    pub(super) level: String,
    pub(super) base: Point,
    pub(super) point: Point,
    /// Whether the call asks for its dial. What others have made of a dial is on the page too.
    pub(super) is_asked: bool,
}

impl LevelOf {
    pub(super) const fn points(&self) -> [&Point; 2] {
        [&self.base, &self.point]
    }

    pub(super) fn name(&self) -> String {
        format!("{} = {}", self.dial.name, self.level)
    }
}

impl Dial {
    fn levels(&self, is_asked: bool) -> impl Iterator<Item = LevelOf> {
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
            LevelOf {
                dial: self.clone(),
                level: level.name,
                base: base.clone(),
                point: Point {
                    key,
                    agent,
                    sets: level.sets,
                },
                is_asked,
            }
        })
    }
}

/// A name as files have it: letters, digits, dots and single dashes.
fn slug(name: &str) -> String {
    let parts = name.split(|c: char| !c.is_ascii_alphanumeric() && c != '.');
    let parts = parts.filter(|part| !part.is_empty());
    parts.collect::<Vec<_>>().join("-")
}

/// What all runs of a folder have in common. Dials, levels and seeds can be added.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Common {
    pub(super) env: String,
    pub(super) preset: String,
    pub(super) sets: Vec<String>,
    /// Of each run.
    pub(super) frames: u64,
    /// Played with each run's weights.
    pub(super) episodes: u32,
    /// Runs at once: it decides the threads of each, and so what wall-clock time means.
    pub(super) jobs: u32,
}

/// A call, with what it leaves open filled in.
#[derive(Clone, Debug)]
pub(super) struct Settings {
    pub(super) common: Common,
    /// Those of the world.
    pub(super) levels: Vec<LevelOf>,
    pub(super) seeds: u32,
    /// Whether the frames may still be made fewer to fit the budget.
    pub(super) frames_open: bool,
}

impl Settings {
    /// What the call asks for. A folder that has runs keeps their length.
    pub(super) fn of(
        args: &TradeoffArgs,
        world: WorldName,
        found: Option<Common>,
    ) -> Result<Self, Usage> {
        let menu: Menu = toml::from_str(include_str!("../tradeoff.toml"))
            .unwrap_or_else(|e| panic!("tradeoff.toml is built in, and a test reads it: {e}"));
        let length = match args.flags.smoke {
            true => menu.smoke,
            false => menu.full,
        };
        let base = world_base(menu.world, world)?;
        let asked = [base.sets, length.sets, args.queue.sets.clone()];
        let (found_frames, found_jobs) = found.map(|it| (it.frames, it.jobs)).unzip();
        let frames = args.frames.or(found_frames);
        Ok(Self {
            common: Common {
                env: world.to_string(),
                preset: length.preset,
                sets: asked.concat(),
                frames: frames.or(length.frames).unwrap_or(base.frames),
                episodes: args.episodes.unwrap_or(length.episodes),
                jobs: args.queue.jobs.or(found_jobs).unwrap_or(1),
            },
            levels: levels(menu.dial, world, &args.dials)?,
            seeds: args.flags.seeds.unwrap_or(length.seeds),
            frames_open: frames.is_none() && !args.queue.report,
        })
    }

    /// Whether the call asks for this point, as a level or as the base of one.
    pub(super) fn asks_for(&self, point: &Point) -> bool {
        let mut asked = self.levels.iter().filter(|it| it.is_asked);
        asked.any(|it| it.points().contains(&point))
    }

    /// The base beside which a point is timed, whichever dial asks for it: that of its level, or itself if it is none.
    pub(super) fn base_of<'a>(&'a self, point: &'a Point) -> &'a Point {
        let level = self.levels.iter().find(|it| it.point == *point);
        level.map_or(point, |it| &it.base)
    }

    pub(super) const fn seeds_of(&self, is_base: bool) -> u32 {
        match is_base {
            true => BASE_SEEDS * self.seeds,
            false => self.seeds,
        }
    }
}

impl Common {
    pub(super) fn config(&self, point: &Point) -> Result<RunConfig, Usage> {
        self.run(point, 1).call.config()
    }

    pub(super) fn run(&self, point: &Point, seed: u32) -> PlannedRun {
        let call = Call {
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

/// The levels of all dials that a world has, in their order. `names` are the dials that are asked for; all if it is empty.
fn levels(mut dials: Vec<Dial>, world: WorldName, names: &[String]) -> Result<Vec<LevelOf>, Usage> {
    dials.retain(|it| it.worlds.is_empty() || it.worlds.iter().any(|kind| kind == world.kind()));
    let known: Vec<_> = dials.iter().map(|dial| dial.name.as_str()).collect();
    if let Some(unknown) = names.iter().find(|name| !known.contains(&name.as_str())) {
        return Err(usage!(
            "unknown dial {unknown:?} in this world{}; --dials takes {}",
            nearest(unknown, known.iter().copied()),
            known.join(", ")
        ));
    }
    let asks_for = |dial: &Dial| names.is_empty() || names.contains(&dial.name);
    let levels = dials.iter().flat_map(|dial| dial.levels(asks_for(dial)));
    Ok(levels.collect())
}

/// What all runs in a world have: the game's own entry comes before that of its kind.
fn world_base(
    mut worlds: BTreeMap<String, WorldBase>,
    world: WorldName,
) -> Result<WorldBase, Usage> {
    let own = worlds.remove(&world.to_string());
    own.or_else(|| worlds.remove(world.kind())).ok_or_else(|| {
        let kinds = worlds.into_keys().filter(|name| !name.contains(':'));
        usage!(
            "driml tradeoff has no settings for {world}, with which something is learned in minutes; it has some for {}",
            kinds.collect::<Vec<_>>().join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use driml_settings::presets;

    use super::*;
    use crate::flags::tests::parsed;

    fn of(line: &str, found: Option<Common>) -> Result<Settings, Usage> {
        let args: TradeoffArgs = parsed(line);
        Settings::of(&args, presets::world(&args.env)?, found)
    }

    fn settings(world: &str, smoke: &str) -> Settings {
        // Else the free memory of the moment decides.
        let line = format!("--env={world} --set=replay.capacity_transitions=10000{smoke}");
        of(&line, None).unwrap()
    }

    #[test]
    fn every_level_of_every_dial_is_a_run_that_can_be_made() {
        let worlds = ["mspacman", "coinrun", "fruitbot", "dodgeball", "chain"];
        for (name, smoke) in worlds.iter().flat_map(|it| [(it, ""), (it, " --smoke")]) {
            let Settings { common, levels, .. } = settings(name, smoke);
            let mut keys = BTreeSet::new();
            for LevelOf { base, point, .. } in levels {
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

    /// Worlds, a dial, and the settings that are its base's there.
    const BASES: &str = "\
mspacman coinrun chain|learner.precision|learner.precision=f32
mspacman coinrun chain|actor.precision|actor.precision=f32
mspacman coinrun chain|learner.publish_dtype|learner.publish_dtype=f32
mspacman coinrun chain|learner.batch_size|learner.batch_size=64
mspacman coinrun chain|replay.replay_ratio|replay.replay_ratio=8
mspacman coinrun chain|model.atoms|model.atoms=51
mspacman coinrun chain|replay.compression|replay.compression=none
mspacman coinrun chain|learner.affinity.estimator|learner.affinity.estimator=learned
mspacman coinrun chain|replay.shards|replay.shards=1
mspacman coinrun chain|transport.shared_memory|transport.shared_memory=true
mspacman coinrun|learner.publish_period_updates|learner.publish_period_updates=8
mspacman coinrun|model.hidden|model.hidden=512
mspacman coinrun|model.embedding_dim|model.embedding_dim=512
mspacman coinrun|pairs NtM|learner.update.lambda.3t3=0 learner.update.lambda.3t4=0 learner.update.lambda.4t3=0
mspacman|observation|input.height=42 input.width=38
coinrun|observation|input.height=64 input.width=64";

    #[test]
    fn a_base_has_what_its_dial_says() {
        for line in BASES.lines() {
            let words: Vec<_> = line.split('|').collect();
            for world in words[0].split(' ') {
                let Settings { common, levels, .. } = settings(world, "");
                let level = levels.iter().find(|it| it.dial.name == words[1]);
                let base = &level.unwrap().base;
                let mut said = base.clone();
                said.sets = words[2].split(' ').map(String::from).collect();
                let configs = [base, &said].map(|point| common.config(point).unwrap());
                assert_eq!(configs[0], configs[1], "{line} in {world}");
            }
        }
    }

    #[test]
    fn a_level_that_is_also_a_base_is_timed_beside_its_own() {
        let settings = of("--env mspacman --dials model.embedding_dim", None).unwrap();
        let asked: Vec<_> = settings.levels.iter().filter(|it| it.is_asked).collect();
        let timed = |point: &Point| {
            let base = settings.base_of(point).key.clone();
            (base, settings.asks_for(point))
        };
        assert_eq!(timed(&asked[0].base), ("c51".into(), true));
        assert_eq!(timed(&asked[0].point), ("driml-fix".into(), true));
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
            // A priced preset says in its notes what it gives up.
            config.notes.clear();
            config
        };
        let is_preset = |it: &&LevelOf| it.dial.name.starts_with("preset");
        for it in levels.iter().filter(is_preset) {
            assert_eq!(of("paper", &it.base), of(&it.dial.base, &it.base));
            let whole = of(&it.level, &it.base);
            assert_eq!(of("paper", &it.point), whole, "{}", it.point.key);
        }
    }

    #[test]
    fn a_folder_keeps_its_length() {
        let first = of("--env mspacman", None).unwrap();
        assert!(first.frames_open);
        let found = Common {
            frames: 777,
            jobs: 2,
            ..first.common
        };
        let again = of("--env mspacman", Some(found)).unwrap();
        let kept = (again.common.frames, again.common.jobs);
        assert_eq!((kept, again.frames_open), ((777, 2), false));
        // A report measures nothing, so it chooses no length.
        assert!(!of("--env mspacman --report", None).unwrap().frames_open);
    }

    #[test]
    fn names_that_nothing_has() {
        for (line, expected) in [
            (
                "--env chain --dials learner.precison",
                "did you mean \"learner.precision\"?",
            ),
            ("--env ising", "it has some for chain, mspacman, procgen"),
        ] {
            let said = of(line, None).unwrap_err().to_string();
            assert!(said.contains(expected), "{said}");
        }
    }
}
