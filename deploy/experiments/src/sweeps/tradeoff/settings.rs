//! What a call of `driml tradeoff` asks for, and the runs and settings that follow from it.

use driml_envs::WorldName;
use driml_machine::error::Usage;
use driml_settings::config::RunConfig;
use serde::{Deserialize, Serialize};

use super::dials::{self, LevelOf, MENU, Point};
use crate::{
    flags::{self, TradeoffArgs},
    sweep::plan::{Call, PlannedRun},
};

/// Seeds of a base for each of a level's: all levels are compared with it, so that its luck is in all of their differences.
const BASE_SEEDS: u32 = 2;

/// What every world's runs have at a length.
#[derive(Clone, Debug, Deserialize)]
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

/// The settings that the call asks for. A folder that has runs keeps their length.
pub(super) fn of(
    args: &TradeoffArgs,
    world: WorldName,
    found: Option<Common>,
) -> Result<Settings, Usage> {
    let base = dials::world_base(world)?;
    let length: Length = flags::settings("tradeoff", MENU, args.flags.smoke);
    let asked = [length.sets, args.queue.sets.clone()];
    let (found_frames, found_jobs) = found.map(|it| (it.frames, it.jobs)).unzip();
    let frames = args.frames.or(found_frames);
    Ok(Settings {
        common: Common {
            env: world.to_string(),
            preset: length.preset,
            sets: base.sets.into_iter().chain(asked.concat()).collect(),
            frames: frames.or(length.frames).unwrap_or(base.frames),
            episodes: args.episodes.unwrap_or(length.episodes),
            jobs: args.queue.jobs.or(found_jobs).unwrap_or(1),
        },
        levels: dials::levels(world, &args.dials)?,
        seeds: args.flags.seeds.unwrap_or(length.seeds),
        frames_open: frames.is_none() && !args.queue.report,
    })
}

impl Settings {
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
        PlannedRun::new(format!("{}-seed{seed}", point.key), call, self.frames)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use driml_settings::presets;

    use super::*;
    use crate::flags::tests::parsed;

    fn of(line: &str, found: Option<Common>) -> Result<Settings, Usage> {
        let args: TradeoffArgs = parsed(line);
        super::of(&args, presets::world(&args.env)?, found)
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
