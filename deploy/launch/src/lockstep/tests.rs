//! What a run in lockstep computes, and that an interrupted run computes the same.

use driml_model::{Precision, describe_kernels};

use super::*;
use crate::testing;

fn config(world: &str, agent: &'static str, frames: u64, sets: &[&str]) -> RunConfig {
    let frames = format!("replay.transitions_max={frames}");
    let sets = [sets, &["local.actors=2", &frames]].concat();
    testing::config("smoke", world, agent, &sets)
}

fn frame(config: &RunConfig) -> (u32, u32) {
    (config.run.frame_height, config.run.frame_width)
}

fn sha256(lockstep: &Lockstep) -> String {
    lockstep.turn.status.weights_sha256.clone()
}

fn weights(config: &RunConfig) -> String {
    let mut lockstep = Lockstep::in_memory(config).unwrap();
    while lockstep.run_round().unwrap() {}
    lockstep.finish().unwrap();
    sha256(&lockstep)
}

/// Worlds so large that a convolution leaves out a border: as drawn, and enlarged.
#[test]
fn a_border_that_no_convolution_reads_changes_no_bit() {
    let chain = "world.height=15 world.width=17 input.height=15 input.width=17";
    let pacman = "input.height=88 input.width=90";
    // AMX sums 32 terms at a time, and zeros between the terms change which 32 these are.
    let is_amx = describe_kernels(Precision::Bf16).starts_with("AMX");
    let precisions = [Precision::F32, Precision::Bf16];
    let precisions = &precisions[..if is_amx { 1 } else { 2 }];
    for (world, sets, cut, whole) in [
        ("chain", chain, (14, 16), (15, 17)),
        ("mspacman", pacman, (20, 18), (21, 19)),
    ] {
        for precision in precisions {
            let sets = format!("{sets} learner.precision={precision} actor.precision={precision}");
            let sets: Vec<_> = sets.split(' ').collect();
            let config = config(world, "driml-ada", 400, &sets);
            let before = config.with_whole_frames().unwrap();
            assert_eq!((frame(&config), frame(&before)), (cut, whole));
            assert_eq!(weights(&config), weights(&before), "{world}, {sets:?}");
        }
    }
}

/// Begins a run, and saves it after `rounds` rounds.
fn begun(config: &RunConfig, rounds: usize) -> (tempfile::TempDir, RunFolder, Lockstep) {
    let (folder, run_dir) = testing::run_folder();
    let mut lockstep = Lockstep::begin(config, &run_dir).unwrap();
    (0..rounds).for_each(|_| assert!(lockstep.run_round().unwrap()));
    lockstep.save(&run_dir.checkpoints()).unwrap();
    (folder, run_dir, lockstep)
}

const IMPALA: [&str; 2] = ["model.torso=impala", "model.channels=[4,6]"];
const IMPOOLA: [&str; 2] = ["model.torso=impoola", "model.channels=[4,6]"];
const PRIORITISED: &str =
    "replay.sampling={rule=\"prioritised\",alpha=0.5,beta_start=0.4,beta_end=1.0}";

/// Each resume begins where the one before saved: before the first update, and late, when the ring is full. The round after it is lost.
#[test]
fn a_run_that_is_interrupted_again_and_again_computes_the_same() {
    let small = ["replay.capacity_transitions=320"];
    let packed = ["replay.compression=lz4", "replay.capacity_transitions=320"];
    let prioritised = [PRIORITISED, "replay.capacity_transitions=320"];
    for (world, agent, sets) in [
        ("chain", "driml-ada", &small[..]),
        ("mspacman", "driml-ada", &packed),
        ("mspacman", "curl", &[]),
        ("ising", "driml-fix", &[]),
        ("mspacman", "driml-ada", &prioritised),
        ("chain", "driml-ada", &IMPALA),
        ("chain", "driml-ada", &IMPOOLA),
    ] {
        let config = config(world, agent, 800, sets);
        let whole = weights(&config);
        let (_folder, run_dir, mut lockstep) = begun(&config, 0);
        while lockstep.run_round().unwrap() {
            lockstep.save(&run_dir.checkpoints()).unwrap();
            lockstep.run_round().unwrap();
            drop(lockstep);
            lockstep = Lockstep::resume(&config, &run_dir).unwrap();
        }
        lockstep.finish().unwrap();
        assert_eq!(sha256(&lockstep), whole, "{world} {agent} {sets:?}");
    }
    let of = |sets: &[&str]| weights(&config("mspacman", "driml-ada", 800, sets));
    assert_eq!(of(&small), of(&packed), "compressed frames are the same");
}

fn refused(config: &RunConfig, run_dir: &RunFolder) -> String {
    let error = Lockstep::resume(config, run_dir).map(drop).unwrap_err();
    format!("{error:#}")
}

#[test]
fn what_cannot_go_on_says_why() {
    let prioritised = config("chain", "c51", 800, &[PRIORITISED]);
    let config = config("chain", "c51", 800, &[]);
    let (_folder, run_dir, _) = begun(&config, 9);
    let said = refused(&prioritised, &run_dir);
    let why = "replay.sampling differs from the rule that was used before";
    assert!(said.contains(why), "{said}");
    // The newest segment begins with the mark, the one before it has the transitions.
    let damaged = "is missing or damaged: the replay cannot be rolled back";
    for (is_newest, why) in [
        (true, damaged),
        (false, "cannot resume to the same weights"),
    ] {
        let (_folder, run_dir, _) = begun(&config, 9);
        let files = std::fs::read_dir(run_dir.replay()).unwrap();
        let paths = files.map(|it| it.unwrap().path());
        let segments = paths.filter(|path| path.extension().is_some_and(|it| it == "log"));
        let removed = match is_newest {
            true => segments.max(),
            false => segments.min(),
        };
        std::fs::remove_file(removed.unwrap()).unwrap();
        let said = refused(&config, &run_dir);
        assert!(said.contains(why), "{said}");
    }
}
