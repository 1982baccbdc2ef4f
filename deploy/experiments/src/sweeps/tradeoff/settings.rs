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
    pub(super) dials: Vec<Dial>,
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
    let sets = base.sets.into_iter().chain(asked.concat()).collect();
    let frames = length.frames.unwrap_or(base.frames);
    let frames_open = args.frames.is_none() && found.is_none();
    let found_frames = found.as_ref().map(|it| it.frames);
    let found_jobs = found.as_ref().map(|it| it.jobs);
    Ok(Settings {
        common: Common {
            env: world.to_string(),
            preset: length.preset,
            sets,
            frames: args.frames.or(found_frames).unwrap_or(frames),
            episodes: args.episodes.unwrap_or(length.episodes),
            jobs: args.queue.jobs.or(found_jobs).unwrap_or(1),
        },
        dials: dials::chosen(dials::dials(world), &args.dials)?,
        seeds: args.flags.seeds.unwrap_or(length.seeds),
        budget_seconds: f64::from(args.budget) * 60.0,
        frames_open,
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
}

impl Common {
    /// The resolved settings of a run at `point`.
    pub(super) fn config(&self, point: &Point) -> Result<RunConfig, Usage> {
        self.run(point, 1).call.config()
    }

    /// The run of a seed at `point`.
    pub(super) fn run(&self, point: &Point, seed: u32) -> PlannedRun {
        PlannedRun {
            name: format!("{}-seed{seed}", point.key),
            call: Call {
                env: Some(self.env.clone()),
                agent: Some(point.agent.clone()),
                preset: Some(self.preset.clone()),
                seed,
                frames: Some(self.frames),
                sets: self.sets.iter().chain(&point.sets).cloned().collect(),
            },
            frames: self.frames,
            episodes: None,
            units: self.frames,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    fn common(world: WorldName, smoke: bool) -> Common {
        let mut args = TradeoffArgs::of(&world.to_string(), smoke);
        // Else the free memory of the moment decides.
        args.queue
            .sets
            .push("replay.capacity_transitions=10000".into());
        of(&args, None).unwrap().common
    }

    #[test]
    fn every_level_of_every_dial_is_a_run_that_can_be_made() {
        for name in [
            "mspacman",
            "procgen:coinrun",
            "procgen:fruitbot",
            "procgen:dodgeball",
            "chain",
        ] {
            let world: WorldName = name.parse().unwrap();
            for smoke in [false, true] {
                let common = common(world, smoke);
                let mut keys = BTreeSet::new();
                for dial in dials::dials(world) {
                    assert!(!dial.buys.is_empty() && !dial.costs.is_empty());
                    let base = dial.base_point();
                    let base_config = common.config(&base).unwrap();
                    for level in &dial.levels {
                        let point = dial.point(level);
                        let config = common
                            .config(&point)
                            .unwrap_or_else(|e| panic!("{name} {}: {e}", point.key));
                        assert_ne!(config, base_config, "{}: nothing is turned", point.key);
                        let one = keys.insert(point.key.clone());
                        assert!(one || point.sets.is_empty(), "{} twice", point.key);
                    }
                }
            }
        }
    }

    #[test]
    fn a_base_has_what_its_dial_says() {
        let has = |world: &str, dial: &str, sets: &[&str]| {
            let world: WorldName = world.parse().unwrap();
            let common = common(world, false);
            let found = dials::chosen(dials::dials(world), &[dial.to_owned()]).unwrap();
            let base = found[0].base_point();
            let said = Point {
                sets: sets.iter().map(|&set| set.to_owned()).collect(),
                ..base.clone()
            };
            assert_eq!(
                common.config(&base).unwrap(),
                common.config(&said).unwrap(),
                "{dial} in {world}"
            );
        };
        for world in ["mspacman", "procgen:coinrun", "chain"] {
            has(world, "learner.precision", &["learner.precision=f32"]);
            has(world, "actor.precision", &["actor.precision=f32"]);
            has(world, "learner.publish_as", &["learner.publish_as=f32"]);
            has(world, "learner.batch_size", &["learner.batch_size=64"]);
            has(world, "replay.replay_ratio", &["replay.replay_ratio=8"]);
            has(world, "model.atoms", &["model.atoms=51"]);
            has(world, "replay.compression", &["replay.compression=none"]);
            has(
                world,
                "learner.affinity.estimator",
                &["learner.affinity.estimator=learned"],
            );
            has(world, "replay.shards", &["replay.shards=1"]);
            has(
                world,
                "transport.shared_memory",
                &["transport.shared_memory=true"],
            );
        }
        for world in ["mspacman", "procgen:coinrun"] {
            has(
                world,
                "learner.publish_period_updates",
                &["learner.publish_period_updates=8"],
            );
            has(world, "model.hidden", &["model.hidden=512"]);
            has(world, "model.rkhs", &["model.rkhs=512"]);
            let zero = ["3t3", "3t4", "4t3"].map(|pair| format!("learner.update.lambda.{pair}=0"));
            has(world, "pairs NtM", &zero.each_ref().map(String::as_str));
        }
        has(
            "mspacman",
            "observation",
            &["input.height=42", "input.width=38"],
        );
        has(
            "procgen:coinrun",
            "observation",
            &["input.height=64", "input.width=64"],
        );
    }

    #[test]
    fn a_preset_as_a_level_is_that_preset() {
        let world: WorldName = "mspacman".parse().unwrap();
        let common = common(world, false);
        for name in ["preset", "preset with DIM"] {
            let found = dials::chosen(dials::dials(world), &[name.to_owned()]);
            let dial = &found.unwrap()[0];
            let base = dial.base_point();
            let of = |preset: &str, point: &Point| {
                let common = Common {
                    preset: preset.to_owned(),
                    ..common.clone()
                };
                // A priced preset says in its notes what it gives up.
                RunConfig {
                    notes: Vec::new(),
                    ..common.config(point).unwrap()
                }
            };
            assert_eq!(of("paper", &base), of(&dial.base, &base));
            for level in &dial.levels {
                let point = dial.point(level);
                let whole = of(&level.name, &base);
                assert_eq!(of("paper", &point), whole, "{}", point.key);
            }
        }
    }

    #[test]
    fn a_folder_keeps_its_length() {
        let args = TradeoffArgs::of("mspacman", false);
        let first = of(&args, None).unwrap();
        assert!(first.frames_open);
        let found = Common {
            frames: 777,
            jobs: 2,
            ..first.common
        };
        let again = of(&args, Some(found)).unwrap();
        assert_eq!(
            (again.common.frames, again.common.jobs, again.frames_open),
            (777, 2, false)
        );
    }

    #[test]
    fn names_that_nothing_has() {
        let args = TradeoffArgs {
            dials: vec!["learner.precison".into()],
            ..TradeoffArgs::of("chain", false)
        };
        let said = of(&args, None).unwrap_err().to_string();
        assert!(
            said.contains("did you mean \"learner.precision\"?"),
            "{said}"
        );
        assert!(of(&TradeoffArgs::of("ising", false), None).is_err());
    }
}
