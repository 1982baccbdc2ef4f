//! What a call of `driml tradeoff` asks for, and the runs and settings that follow from it.

use driml_envs::WorldName;
use driml_machine::error::{Usage, usage};
use driml_settings::{config::RunConfig, presets};
use serde::{Deserialize, Serialize};

use super::dials::{self, Dial, Point};
use crate::{
    flags::TradeoffArgs,
    sweep::plan::{Call, PlannedRun},
};

/// Seeds of a base for each of a level's: all levels are compared with it, so that its luck is in all of their differences.
const BASE_SEEDS: u32 = 2;

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
    /// Those of the world, asked for or not: what has runs is on the page.
    pub(super) all_dials: Vec<Dial>,
    /// The names of those that are asked for.
    pub(super) asked: Vec<String>,
    pub(super) seeds: u32,
    /// Machine time for the runs of this call, in seconds.
    pub(super) budget_seconds: f64,
    /// Whether the frames may still be made fewer to fit the budget.
    pub(super) frames_open: bool,
}

/// The settings that the call asks for. A folder that has runs keeps their length.
pub(super) fn of(args: &TradeoffArgs, found: Option<Common>) -> Result<Settings, Usage> {
    let world: WorldName = presets::world(&args.env).map_err(|e| usage!("--env: {e}"))?;
    let base = dials::world_base(world)?;
    let length = dials::length(args.flags.smoke);
    let asked = [length.sets, args.queue.sets.clone()];
    let found = found.as_ref();
    let frames = args.frames.or(found.map(|it| it.frames));
    let jobs = args.queue.jobs.or(found.map(|it| it.jobs));
    let all_dials = dials::dials(world);
    Ok(Settings {
        common: Common {
            env: world.to_string(),
            preset: length.preset,
            sets: base.sets.into_iter().chain(asked.concat()).collect(),
            frames: frames.or(length.frames).unwrap_or(base.frames),
            episodes: args.episodes.unwrap_or(length.episodes),
            jobs: jobs.unwrap_or(1),
        },
        asked: dials::chosen(&all_dials, &args.dials)?,
        all_dials,
        seeds: args.flags.seeds.unwrap_or(length.seeds),
        budget_seconds: f64::from(args.budget) * 60.0,
        frames_open: frames.is_none(),
    })
}

impl Settings {
    /// Seeds of a point, from 1.
    pub(super) const fn seeds_of(&self, is_base: bool) -> u32 {
        if is_base {
            BASE_SEEDS * self.seeds
        } else {
            self.seeds
        }
    }

    /// Whether the call asks for this dial.
    pub(super) fn asks_for(&self, dial: &Dial) -> bool {
        self.asked.contains(&dial.name)
    }
}

impl Common {
    /// The resolved settings of a run at `point`.
    pub(super) fn config(&self, point: &Point) -> Result<RunConfig, Usage> {
        self.run(point, 1).call.config()
    }

    /// The run of a seed at `point`.
    pub(super) fn run(&self, point: &Point, seed: u32) -> PlannedRun {
        PlannedRun::new(
            format!("{}-seed{seed}", point.key),
            Call {
                env: Some(self.env.clone()),
                agent: Some(point.agent.clone()),
                preset: Some(self.preset.clone()),
                seed,
                frames: Some(self.frames),
                sets: self.sets.iter().chain(&point.sets).cloned().collect(),
            },
            self.frames,
        )
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct CommandLine {
        #[command(flatten)]
        args: TradeoffArgs,
    }

    fn args(line: &str) -> TradeoffArgs {
        let words = ["tradeoff"].into_iter().chain(line.split(' '));
        CommandLine::parse_from(words).args
    }

    fn settings(world: &str, smoke: bool) -> Settings {
        // Else the free memory of the moment decides.
        let line = format!("--env={world} --set=replay.capacity_transitions=10000");
        let mut args = args(&line);
        args.flags.smoke = smoke;
        of(&args, None).unwrap()
    }

    #[test]
    fn every_level_of_every_dial_is_a_run_that_can_be_made() {
        let worlds = ["mspacman", "coinrun", "fruitbot", "dodgeball", "chain"];
        for (name, smoke) in worlds.iter().flat_map(|it| [(it, false), (it, true)]) {
            let Settings {
                common, all_dials, ..
            } = settings(name, smoke);
            let mut keys = BTreeSet::new();
            for level in all_dials.iter().flat_map(Dial::level_points) {
                let config = common.config(&level.point);
                let config = config.unwrap_or_else(|e| panic!("{name} {}: {e}", level.point.key));
                let base = common.config(&level.base).unwrap();
                let key = level.point.key;
                assert_ne!(config, base, "{key}: nothing is turned");
                let one = keys.insert(key.clone());
                assert!(one || level.point.sets.is_empty(), "{key} twice");
            }
        }
    }

    #[test]
    fn a_base_has_what_its_dial_says() {
        const ALL: [&str; 3] = ["mspacman", "coinrun", "chain"];
        for (worlds, dial, sets) in [
            (&ALL[..], "learner.precision", "learner.precision=f32"),
            (&ALL, "actor.precision", "actor.precision=f32"),
            (&ALL, "learner.publish_as", "learner.publish_as=f32"),
            (&ALL, "learner.batch_size", "learner.batch_size=64"),
            (&ALL, "replay.replay_ratio", "replay.replay_ratio=8"),
            (&ALL, "model.atoms", "model.atoms=51"),
            (&ALL, "replay.compression", "replay.compression=none"),
            (
                &ALL,
                "learner.affinity.estimator",
                "learner.affinity.estimator=learned",
            ),
            (&ALL, "replay.shards", "replay.shards=1"),
            (
                &ALL,
                "transport.shared_memory",
                "transport.shared_memory=true",
            ),
            (
                &ALL[..2],
                "learner.publish_period_updates",
                "learner.publish_period_updates=8",
            ),
            (&ALL[..2], "model.hidden", "model.hidden=512"),
            (&ALL[..2], "model.rkhs", "model.rkhs=512"),
            (
                &ALL[..2],
                "pairs NtM",
                "learner.update.lambda.3t3=0 learner.update.lambda.3t4=0 learner.update.lambda.4t3=0",
            ),
            (&ALL[..1], "observation", "input.height=42 input.width=38"),
            (&ALL[1..2], "observation", "input.height=64 input.width=64"),
        ] {
            for world in worlds {
                let Settings {
                    common, all_dials, ..
                } = settings(world, false);
                let dial = all_dials.iter().find(|it| it.name == dial).unwrap();
                let base = dial.base_point();
                let mut said = base.clone();
                said.sets = sets.split(' ').map(String::from).collect();
                let configs = [&base, &said].map(|point| common.config(point).unwrap());
                assert_eq!(configs[0], configs[1], "{} in {world}", dial.name);
            }
        }
    }

    #[test]
    fn a_preset_as_a_level_is_that_preset() {
        let Settings {
            common, all_dials, ..
        } = settings("mspacman", false);
        let of = |preset: &str, point: &Point| {
            let mut common = common.clone();
            common.preset = preset.to_owned();
            let mut config = common.config(point).unwrap();
            // A priced preset says in its notes what it gives up.
            config.notes.clear();
            config
        };
        for dial in all_dials.iter().filter(|it| it.name.starts_with("preset")) {
            let base = dial.base_point();
            assert_eq!(of("paper", &base), of(&dial.base, &base));
            for level in dial.level_points() {
                let whole = of(&level.level, &base);
                assert_eq!(of("paper", &level.point), whole, "{}", level.point.key);
            }
        }
    }

    #[test]
    fn a_folder_keeps_its_length() {
        let first = of(&args("--env mspacman"), None).unwrap();
        assert!(first.frames_open);
        let found = Common {
            frames: 777,
            jobs: 2,
            ..first.common
        };
        let again = of(&args("--env mspacman"), Some(found)).unwrap();
        assert_eq!(
            (again.common.frames, again.common.jobs, again.frames_open),
            (777, 2, false)
        );
    }

    #[test]
    fn names_that_nothing_has() {
        for (line, expected) in [
            (
                "--env chain --dials learner.precison",
                "did you mean \"learner.precision\"?",
            ),
            ("--env ising", "it has some for mspacman, procgen, chain"),
        ] {
            let said = of(&args(line), None).unwrap_err().to_string();
            assert!(said.contains(expected), "{said}");
        }
    }
}
