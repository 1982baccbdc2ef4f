//! What a run will do and about how long it takes, printed before the run starts.
//! This module decides nothing, and its time is an estimate from the network's arithmetic, not a promise.

use driml_actor::Schedule;
use driml_learner::{
    DeviceName, Precision,
    cost::{UpdateCost, UpdateShape},
};
use driml_machine::{
    resources::Machine,
    units::{count, rough_duration},
};
use driml_settings::{
    config::RunConfig,
    memory::{COMPRESSED_FIELDS_BYTES, replay_bytes_each},
};

use crate::run_folder::{ResumePoint, RunFolder};

/// Arithmetic that one core sustains over a whole run, learner and actors together, in GFLOP/s.
///
/// Measured on 2 cores of an AMD EPYC with AVX-512: an update of `driml-ada` on bigfish alone, 16 GFLOP, takes 54 ms, which is
/// 150 per core (`driml bench learner`). The constant is half of that, as actors and replay server share the cores with the
/// learner, and other machines have narrower registers.
const GFLOPS_PER_CORE: f64 = 75.0;

/// Width in characters of the labels in front of the plan's facts.
pub const INDENT: usize = 12;

/// Estimates the seconds that the run takes on `cores` cores: its updates, and one forward pass per frame.
fn estimate_s(config: &RunConfig, cores: u32) -> f64 {
    let shape = UpdateShape::for_learner(&config.learner, config.run.horizon.positives());
    let update = UpdateCost::compute(&config.model, &shape).total() as f64;
    let layers = config.model.without_dim().layer_costs();
    let forward: u64 = layers.iter().map(|layer| layer.forward).sum();
    let flops = config.updates() as f64 * update + config.frames() as f64 * forward as f64;
    flops / (GFLOPS_PER_CORE * 1e9 * f64::from(cores.max(1)))
}

/// The plan of a run that starts at `resume_point`, one fact per line.
pub fn describe(
    config: &RunConfig,
    source: &str,
    run_dir: &RunFolder,
    lockstep: bool,
    resume_point: ResumePoint,
    machine: &Machine,
) -> String {
    let (run, replay) = (&config.run, &config.replay);
    let (frames, updates) = (config.frames(), config.updates());
    let held = frames.min(replay.capacity_transitions);
    let with_fields = |max: u64| max.saturating_add(held * COMPRESSED_FIELDS_BYTES);
    let compressed = replay.compressed_bytes_max.map_or(u64::MAX, with_fields);
    let bytes = format_size(compressed.min(held * replay_bytes_each(run)));
    let disk = match config.local.durable || lockstep {
        true => " and about as much of disk, in the run folder",
        false => "",
    };
    let left = (1.0 - resume_point.updates as f64 / updates.max(1) as f64).max(0.0);
    let time = rough_duration(left * estimate_s(config, machine.cores));
    let (rows, ratio) = (config.learner.batch_size, replay.replay_ratio);
    let (updates, rows) = (count(updates, "update"), count(rows, "row"));
    let (agent, world, seed) = (&run.agent, &run.world, run.seed);
    let (processes, run_dir) = (processes(config, lockstep), run_dir.display());
    let note = |note: &String| format!("{:INDENT$}{note}\n", "note");
    let exploration = note_on_epsilon(config);
    let notes = config.notes.iter().chain(&config.accuracy_note);
    let notes: String = notes.chain(&exploration).map(note).collect();
    format!(
        "trains      {agent} on {world}, seed {seed}, from {source}\n\
         frames      {frames} in all, with {updates} of {rows} (replay ratio {ratio})\n\
         processes   {processes}\n\
         replay      the newest {held} transitions, up to {bytes} of memory{disk}\n\
         run folder  {run_dir}\n\
         time        roughly {time}, from the network's arithmetic\n{notes}"
    )
}

/// The note of a run that ends while epsilon still falls.
fn note_on_epsilon(config: &RunConfig) -> Option<String> {
    let schedule = Schedule::new(&config.actor, 0).ok()?;
    let (frames, falls) = (config.frames(), schedule.decay_frames);
    (frames < falls && schedule.start > schedule.end).then(|| {
        let last = schedule.epsilon(frames);
        format!(
            "the last actions are still random with probability {last:.2}, as epsilon falls over {falls} frames (actor.epsilon_decay_frames)"
        )
    })
}

fn processes(config: &RunConfig, lockstep: bool) -> String {
    if lockstep {
        return "one, in lockstep".into();
    }
    let servers = match config.replay.shards {
        1 => "replay server".into(),
        shards => format!("{shards} replay servers"),
    };
    let threads = count(config.local.learner_threads, "thread");
    let learner = match (config.local.learner_device, config.learner.precision) {
        (DeviceName::Cpu, Precision::F32) => format!("with {threads}"),
        (DeviceName::Cpu, precision) => format!("with {threads}, in {precision}"),
        (gpu, _) => format!("on {gpu}"),
    };
    let actors = count(config.local.actors, "actor");
    let envs = count(config.actor.envs, "environment");
    format!("{servers}; learner {learner}; {actors} with {envs} each")
}

fn format_size(bytes: u64) -> String {
    match bytes >> 20 {
        mib @ 0..1024 => format!("{} MiB", mib + 1),
        mib => format!("{:.1} GiB", mib as f64 / 1024.0),
    }
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;
    use crate::testing::{MACHINE, config};

    #[test]
    fn the_plan_says_what_will_be_done() {
        let config = config("paper", "procgen:bigfish", "driml-fix", &[]);
        let (folder, point) = (RunFolder::new("runs/x"), ResumePoint::default());
        let plan = describe(&config, "preset paper", &folder, false, point, &MACHINE);
        // 199_000 transitions after the warm-up, at 8 rows each, in batches of 256. The time depends on a measured constant.
        let plan = plan.lines().filter(|line| !line.starts_with("time"));
        let plan: String = plan.map(|line| format!("{line}\n")).collect();
        expect![[r#"
            trains      driml-fix on procgen:bigfish, seed 1, from preset paper
            frames      200000 in all, with 6218 updates of 256 rows (replay ratio 8)
            processes   replay server; learner with 2 threads; 1 actor with 16 environments each
            replay      the newest 200000 transitions, up to 2.3 GiB of memory
            run folder  runs/x
        "#]]
        .assert_eq(&plan);
    }

    #[test]
    fn more_cores_and_less_to_learn_take_less_time() {
        let time =
            |agent, cores| estimate_s(&config("paper", "procgen:bigfish", agent, &[]), cores);
        assert!(time("driml-ada", 4) < time("driml-ada", 2));
        let time = |agent| time(agent, 2);
        let ascending = ["c51", "driml-ada", "driml-fix", "cpc"].map(time);
        assert!(ascending.is_sorted(), "{ascending:?}");
        assert!(time("c51") < time("curl") && time("curl") < time("cpc"));
    }
}
