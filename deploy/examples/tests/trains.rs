//! The example's program trains in its own world, with its own loss, in processes as well as in lockstep.

use driml_tests::{Outcome, TestSystem};

#[test]
fn the_world_and_the_loss_train_as_built_in_ones_do() {
    let system = TestSystem::new(env!("CARGO_BIN_EXE_driml-with-island"));
    let flags =
        "--env island --agent predictive --preset smoke --frames 1280 --set replay.replay_ratio=8";
    let trained = system.train(&format!("{flags} --actors 2"), "run");
    assert!(
        trained.updates == 540 && trained.episodes > 10,
        "{trained:#?}"
    );
    let run = system.run_folder("run");
    let last = run.column("prediction").pop().expect("there is a row");
    let last: f64 = last.parse().expect("it is a number");
    assert!(last.is_finite() && last > 0.0, "{last}");

    // The settings of a run contain all that repeats it.
    let hashes = [("first", flags), ("again", "--config first/config.toml")].map(|(name, args)| {
        let trained = system.train(&format!("--lockstep {args}"), name);
        trained.weights_sha256
    });
    assert_eq!(hashes[0], hashes[1]);
    system.run_ok("local --resume first --frames 1600");
    let resumed = system.run_folder("first").check(Outcome::Finished);
    assert!(resumed.frames >= 1600, "{resumed:#?}");
    let played = system.run_ok("evaluate run --episodes 4").stdout;
    assert!(played.starts_with("island as trained on"), "{played}");
    system
        .run_ok("presets")
        .expect_stdout("predictive")
        .expect_stdout("island");
}
