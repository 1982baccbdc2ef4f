//! What a run will do and about how long it takes, printed before it starts.
//! It decides nothing, and its time is an estimate from the network's arithmetic, not a promise.

use std::time::Duration;

use driml_learner::{DeviceName, Precision, auxiliary::loss::Passes};
use driml_machine::{resources::Machine, units::duration};
use driml_model::ModelConfig;
use driml_settings::{
    config::RunConfig,
    memory::{COMPRESSED_FIELDS_BYTES, replay_bytes_each},
};

use crate::run_folder::{ResumePoint, RunFolder};

/// Arithmetic that a core sustains over a whole run, learner and actors together, in GFLOP/s.
///
/// Measured on 2 cores of an AMD EPYC with AVX-512: an update of `driml-ada` on bigfish alone, 16 GFLOP, takes 54 ms, which is
/// 150 a core (`cargo bench --workspace --bench update`); actors and replay server share the cores with it, and other machines
/// have narrower registers, so this is half of it.
const GFLOPS_PER_CORE: f64 = 75.0;

/// Multiplications and additions, each counted as one, of one row through parts of the network.
struct RowFlops {
    /// Torso up to f3.
    local: f64,
    /// From f3 to f4.
    global: f64,
    /// The head that gives C51's distributions.
    head: f64,
    /// DIM heads that exist, at every location where they are applied.
    dim: f64,
}

fn row_flops(model: &ModelConfig) -> RowFlops {
    let mut flops = RowFlops {
        local: 0.0,
        global: 0.0,
        head: 0.0,
        dim: 0.0,
    };
    for layer in model.conv_shapes() {
        flops.local += 2.0 * (layer.locations() * layer.weight_len()) as f64;
    }
    let (height, width, _) = model.local_shape();
    for (name, shape) in model.parameter_shapes() {
        if shape.len() != 2 {
            continue;
        }
        let product = 2.0 * shape.iter().product::<usize>() as f64;
        match name.as_str() {
            "torso.fc.weight" => flops.global += product,
            "head.weight" => flops.head += product,
            local if local.starts_with("dim.psi3") || local.starts_with("dim.phi3") => {
                flops.dim += product * (height * width) as f64;
            }
            _ => flops.dim += product,
        }
    }
    flops
}

/// About how long the run takes on `cores` cores.
///
/// An update passes s_t forward and backward (3 times the forward arithmetic), s_{t+n} forward, and each positive s_{t+k}
/// forward and backward; an augmented s_t once more; CURL's query both ways and its key forward. The InfoNCE scores come on
/// top: locations * rows^2 * rkhs for each positive. A frame is one forward pass.
pub fn estimate(config: &RunConfig, cores: u32) -> Duration {
    let (model, rows) = (&config.model, f64::from(config.learner.batch_size));
    let RowFlops {
        local,
        global,
        head,
        dim,
    } = row_flops(model);
    let forward = local + global + head;
    let loss = config.learner.update.auxiliary();
    let augmented = config.learner.augment.is_some();
    let passes = loss.map_or_else(
        |_| Passes::default(),
        |loss| loss.passes(config.run.horizon.positives(), augmented),
    );
    let (height, width, _) = model.local_shape();
    let locations = if passes.local {
        (height * width) as f64
    } else {
        1.0
    };
    let scores = passes.scores * 6.0 * locations * rows * rows * model.rkhs as f64;
    let more_passes = passes.torso * (local + global) + passes.heads * dim;
    let update = rows * (4.0 * forward + more_passes) + scores;
    let flops = config.updates() as f64 * update + config.frames() as f64 * forward;
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
    let left = 1.0 - resume_point.updates as f64 / config.updates().max(1) as f64;
    let processes = if lockstep {
        "one, all parts in lockstep".into()
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
                "the newest {held} transitions, up to {} of memory",
                size(bytes)
            ),
        ),
        ("run folder", run_dir.display().to_string()),
        (
            "time",
            format!(
                "about {} (coarse: from the network's arithmetic)",
                about(estimate(config, machine.cores).mul_f64(left))
            ),
        ),
    ];
    let mut text: String = lines
        .iter()
        .map(|(name, fact)| format!("{name:<12}{fact}\n"))
        .collect();
    for note in &config.notes {
        text.push_str(&format!("{:<12}{note}\n", "note"));
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
    match time.as_secs() {
        0..60 => "a minute".into(),
        seconds @ 60..7200 => format!("{} min", seconds.div_ceil(60)),
        seconds => duration(Duration::from_secs(seconds.div_ceil(3600) * 3600))
            .replace(" 0 min", "")
            .replace(" 0 h", ""),
    }
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
    fn the_arithmetic_is_that_of_the_network() {
        // Mnih et al.'s network on 84 x 84 x 4: 20x20, 9x9, 7x7 maps.
        let mut model = config("mspacman", "c51").model;
        model.channels = 4;
        let flops = row_flops(&model);
        let conv = 20 * 20 * 32 * 4 * 64 + 9 * 9 * 64 * 32 * 16 + 7 * 7 * 64 * 64 * 9;
        assert_eq!(flops.local, 2.0 * f64::from(conv));
        assert_eq!(flops.global, 2.0 * 3136.0 * 512.0);
        assert_eq!(flops.dim, 0.0);
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
        assert_eq!(texts, ["a minute", "10 min", "3 h", "1 d 1 h", "1 d"]);
    }
}
