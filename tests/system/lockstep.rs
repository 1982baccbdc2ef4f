//! `driml local --lockstep`: the same seed gives the same weights, and an agent learns what can be learned.
//! A run in lockstep has one process.

use driml_envs::{ChainConfig, WorldName};
use driml_settings::presets::AGENTS;
use driml_tests::{Summary, TestSystem};
use nix::sys::signal::Signal;

use crate::{PRIORITISED, SMALL_NETWORK, chain, system};

fn run(system: &TestSystem, flags: &str, name: &str) -> Summary {
    system.train(&format!("--lockstep {flags}"), name)
}

/// Each row: the flags of all three runs, the extra flags of two runs that are equal, and those of a third that is different.
#[test]
fn seed_and_settings_decide_the_weights() {
    let ada = format!("{} --agent driml-ada", chain(640));
    let of_two = format!("{ada} --actors 2 --envs 3");
    let curl = "--env mspacman --agent curl --preset smoke --frames 320 --seed 3";
    let bf16 = "--seed 3 --set learner.precision=bf16 --set actor.precision=bf16";
    for (flags, own, other) in [
        (&*of_two, "--seed 3", "--seed 4"),
        (&*ada, bf16, "--seed 3"),
        (&*of_two, PRIORITISED, ""),
        // The augmentation draws from the learner's random generator, which the seed determines.
        (curl, "", "--set learner.augment.hue=0.3"),
    ] {
        let system = system();
        let runs = [("first", own), ("same", own), ("other", other)];
        let [first, same, other] =
            runs.map(|(name, more)| run(&system, &format!("{flags} {more}"), name));
        assert_eq!(first.weights_sha256, same.weights_sha256, "{flags} {own}");
        assert_eq!(first.replay.k_histogram, same.replay.k_histogram);
        assert_eq!(first.episodes, same.episodes);
        assert_ne!(first.weights_sha256, other.weights_sha256, "{flags}");
        // The settings that the first run left give the same weights.
        let again = run(&system, "--config first/config.toml", "again");
        assert_eq!(first.weights_sha256, again.weights_sha256, "{flags} {own}");
        let configs = ["first", "again"].map(|name| system.run_folder(name).config());
        assert_eq!(configs[0], configs[1]);
    }
}

/// Returns the results of a run that are compared: weights, mean return, histogram of k, and episodes.
fn compared_results(it: Summary) -> (String, Option<f64>, Vec<u64>, u64) {
    let k_histogram = it.replay.k_histogram;
    (it.weights_sha256, it.mean_return, k_histogram, it.episodes)
}

/// Makes a whole run, one that is prolonged after half of its frames, and one that is resumed after each signal. SIGINT saves a checkpoint;
/// after SIGKILL, updates since the last checkpoint are made again. All runs give the same result.
pub(crate) fn continues_exactly(flags: &str) {
    const FRAMES: u64 = 2048;
    let start = |system: &TestSystem, frames: u64, name: &str| {
        system.start(&format!(
            "local --lockstep {flags} --actors 2 --frames {frames} --set replay.replay_ratio=8 \
             --set learner.checkpoint_period_updates=100 --run-dir {name}"
        ))
    };
    let system = system();
    let run = |frames: u64, name: &str| {
        start(&system, frames, name).wait_ok();
        system.run_folder(name).check_finished()
    };
    let whole = run(FRAMES, "whole");
    assert!(whole.updates > 300 && whole.episodes > 0, "{whole:#?}");
    let whole = compared_results(whole);

    let half = run(FRAMES / 2, "half");
    assert_ne!(half.weights_sha256, whole.0);
    // The error leaves the folder as it was.
    let wrong = format!("local --resume half --frames {FRAMES} --set actor.envs=3");
    system.fails(&wrong, "environments, not 3");
    system.run_folder("half").check_finished();
    system.run_ok(&format!("local --resume half --frames {FRAMES}"));
    let prolonged = system.run_folder("half").check_finished();
    assert_eq!(compared_results(prolonged), whole, "prolonged");

    for signal in [Signal::SIGINT, Signal::SIGKILL] {
        let system = crate::system();
        system.pause_learners_at(150);
        let process = start(&system, FRAMES, "run");
        let run = system.run_folder("run");
        // The signal comes between two checkpoints.
        run.wait_for_updates(110);
        process.signal(signal);
        system.release_learners();
        let ended = process.wait();
        if signal == Signal::SIGINT {
            ended
                .expect_code(130)
                .expect_stderr("`driml train --resume run` resumes it");
        }
        system
            .run_ok("local --resume run")
            .expect_stdout("processes   one, in lockstep");
        let resumed = run.check_finished();
        assert!(resumed.resumed_after_updates >= 100, "{resumed:#?}");
        assert_eq!(compared_results(resumed), whole, "{signal}");
        // A world's process has a second to exit by itself after its run was killed.
        system.wait_until_all_have_ended();
    }
}

#[test]
fn an_interrupted_run_ends_with_the_weights_that_it_would_have_had() {
    continues_exactly("--env chain --preset smoke --agent driml-ada");
    let mspacman = format!("--env mspacman --preset smoke --agent driml-ada {SMALL_NETWORK}");
    continues_exactly(&mspacman);
    // Rainbow's noise continues in the learner and the actors. By default beta would rise over the length of each run.
    let beta = "--set replay.sampling.beta_updates=500";
    let flags = format!("--env chain --preset smoke --agent rainbow {beta}");
    continues_exactly(&flags);
}

#[test]
fn every_agent_runs_in_every_world_that_needs_nothing() {
    let system = system();
    for world in WorldName::all().filter(|it| it.kind() != "procgen") {
        for agent in AGENTS.iter().map(|agent| agent.name) {
            let flags = format!("--env {world} --agent {agent} --preset smoke --frames 256");
            let summary = run(&system, &flags, &format!("{world}-{agent}"));
            let looks_ahead = !["c51", "curl", "rainbow"].contains(&agent);
            assert_eq!(summary.mean_k.is_some(), looks_ahead, "{world} {agent}");
        }
    }
}

#[test]
fn c51_learns_the_chain_and_evaluation_shows_it() {
    let system = system();
    let summary = run(&system, "--env chain --agent c51", "run");
    let folder = system.run_folder("run");
    let mut world = folder.config()["world"].as_table().unwrap().clone();
    world.remove("kind");
    let world: ChainConfig = world.try_into().unwrap();
    let return_min = 0.9 * f64::from(world.reward_right);
    let while_training = summary.mean_return.unwrap();
    assert!(while_training >= return_min, "{while_training}");

    let json = system.run_json("evaluate run --episodes 40 --json");
    let mean = |policy: &str| json["policies"][policy]["mean_return"].as_f64().unwrap();
    let (learned, random) = (mean("c51"), mean("random"));
    assert!(learned >= return_min, "greedy: {learned} of {return_min}");
    // A random walk reaches the far end in one of seven episodes.
    assert!(random < 0.6 * return_min, "random: {random}");
}
