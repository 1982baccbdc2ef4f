//! What a run will do and about how long it takes, printed before it starts.
//! It decides nothing, and its time is an estimate from the network's arithmetic, not a promise.

use std::time::Duration;

use driml_learner::{
    DeviceName, Precision,
    cost::{UpdateCost, UpdateShape},
};
use driml_machine::{resources::Machine, units::duration};
use driml_settings::{
    config::RunConfig,
    memory::{COMPRESSED_FIELDS_BYTES, replay_bytes_each},
};

use crate::run_folder::{ResumePoint, RunFolder};

/// Arithmetic that a core sustains over a whole run, learner and actors together, in GFLOP/s.
///
/// Measured on 2 cores of an AMD EPYC with AVX-512: an update of `driml-ada` on bigfish alone, 16 GFLOP, takes 54 ms, which is
/// 150 a core (`driml bench learner`); actors and replay server share the cores with it, and other machines
/// have narrower registers, so this is half of it.
const GFLOPS_PER_CORE: f64 = 75.0;

/// Columns before the facts of the plan.
pub const INDENT: usize = 12;

/// About how long the run takes on `cores` cores: its updates, and one forward pass a frame.
pub fn estimate(config: &RunConfig, cores: u32) -> Duration {
    let shape = UpdateShape::of(&config.learner, config.run.horizon.positives());
    let update = UpdateCost::of(&config.model, &shape).total() as f64;
    let layers = config.model.without_dim().layer_costs();
    let forward: u64 = layers.iter().map(|layer| layer.forward).sum();
    let flops = config.updates() as f64 * update + config.frames() as f64 * forward as f64;
    let seconds = flops / (GFLOPS_PER_CORE * 1e9 * f64::from(cores.max(1)));
    Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX)
}

/// The plan of a run that starts at `resume_point`, one fact a line.
pub fn describe(
    config: &RunConfig,
    from: &str,
    run_dir: &RunFolder,
    lockstep: bool,
    resume_point: ResumePoint,
    machine: &Machine,
) -> String {
    let RunConfig {
        run,
        actor,
        replay,
        learner,
        local,
        ..
    } = config;
    let held = config.frames().min(replay.capacity_transitions);
    let compressed = replay.compressed_bytes_max.map_or(u64::MAX, |max| {
        max.saturating_add(held * COMPRESSED_FIELDS_BYTES)
    });
    let bytes = compressed.min(held * replay_bytes_each(run));
    let done = resume_point.updates as f64 / config.updates().max(1) as f64;
    let left = (1.0 - done).max(0.0);
    let processes = if lockstep {
        "one, with everything in lockstep".into()
    } else {
        let servers = match replay.shards {
            1 => "replay server".into(),
            shards => format!("{shards} replay servers"),
        };
        let learner = match local.learner_device {
            DeviceName::Cpu if learner.precision == Precision::F32 => {
                format!("with {} threads", local.learner_threads)
            }
            DeviceName::Cpu => {
                let (threads, precision) = (local.learner_threads, learner.precision);
                format!("with {threads} threads, in {precision}")
            }
            gpu => format!("on {gpu}"),
        };
        let actors = if local.actors == 1 { "actor" } else { "actors" };
        format!(
            "{servers}; learner {learner}; {} {actors} with {} copies of the world each",
            local.actors, actor.envs
        )
    };
    let lines = [
        (
            "trains",
            format!(
                "{} on {}, seed {}, from {from}",
                run.agent, run.world, run.seed
            ),
        ),
        (
            "frames",
            format!(
                "{} in all, with {} updates of {} rows (replay ratio {})",
                config.frames(),
                config.updates(),
                learner.batch_size,
                replay.replay_ratio
            ),
        ),
        ("processes", processes),
        (
            "replay",
            format!(
                "the newest {held} transitions, up to {} of memory{}",
                size(bytes),
                match local.durable || lockstep {
                    true => " and about as much of disk, in the run folder",
                    false => "",
                }
            ),
        ),
        ("run folder", run_dir.display().to_string()),
        (
            "time",
            format!(
                "{} (coarse: from the network's arithmetic)",
                about(estimate(config, machine.cores).mul_f64(left))
            ),
        ),
    ];
    let mut text: String = lines
        .iter()
        .map(|(name, fact)| format!("{name:<INDENT$}{fact}\n"))
        .collect();
    for note in &config.notes {
        text.push_str(&format!("{:<INDENT$}{note}\n", "note"));
    }
    text
}

/// Bytes in a unit that fits them.
fn size(bytes: u64) -> String {
    match bytes >> 20 {
        mib @ 0..1024 => format!("{} MiB", mib + 1),
        mib => format!("{:.1} GiB", mib as f64 / 1024.0),
    }
}

/// A time that pretends to no more precision than an estimate has.
fn about(time: Duration) -> String {
    let time = match time.as_secs() {
        0..60 => return "under a minute".into(),
        seconds @ 60..7200 => format!("{} min", seconds.div_ceil(60)),
        seconds => duration(Duration::from_secs(seconds.div_ceil(3600) * 3600))
            .replace(" 0 min", "")
            .replace(" 0 h", ""),
    };
    format!("about {time}")
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;
    use driml_settings::{
        presets::PRESETS,
        resolve::{Flags, Source, resolve},
    };

    const MACHINE: Machine = Machine {
        cores: 2,
        memory_bytes: 16 << 30,
        fast_bf16: false,
    };

    fn config(world: &str, agent: &'static str) -> RunConfig {
        let source = Source::Layers(&PRESETS[0], world.parse().unwrap(), agent);
        resolve(&source, &Flags::default(), &MACHINE).unwrap()
    }

    #[test]
    fn the_plan_says_what_will_be_done() {
        let config = config("procgen:bigfish", "driml-fix");
        let plan = describe(
            &config,
            "preset paper",
            &RunFolder::new("runs/x"),
            false,
            ResumePoint::default(),
            &MACHINE,
        );
        // The time depends on a measured constant.
        let plan: String = plan
            .lines()
            .filter(|line| !line.starts_with("time"))
            .map(|line| format!("{line}\n"))
            .collect();
        expect![[r#"
            trains      driml-fix on procgen:bigfish, seed 1, from preset paper
            frames      200000 in all, with 6218 updates of 256 rows (replay ratio 8)
            processes   replay server; learner with 2 threads; 1 actor with 16 copies of the world each
            replay      the newest 200000 transitions, up to 2.3 GiB of memory
            run folder  runs/x
        "#]].assert_eq(&plan);
    }

    #[test]
    fn more_cores_and_less_to_learn_take_less_time() {
        let time = |agent| estimate(&config("procgen:bigfish", agent), 2);
        assert!(estimate(&config("procgen:bigfish", "driml-ada"), 4) < time("driml-ada"));
        let ascending = ["c51", "driml-ada", "driml-fix", "cpc"].map(time);
        assert!(ascending.is_sorted(), "{ascending:?}");
        assert!(time("c51") < time("curl") && time("curl") < time("cpc"));
    }

    #[test]
    fn estimates_are_not_precise() {
        let texts =
            [5, 600, 7_300, 90_000, 86_400].map(|seconds| about(Duration::from_secs(seconds)));
        let expected = [
            "under a minute",
            "about 10 min",
            "about 3 h",
            "about 1 d 1 h",
            "about 1 d",
        ];
        assert_eq!(texts, expected);
    }
}
