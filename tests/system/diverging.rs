//! A run whose arithmetic leaves the finite numbers: it fails, reports why, and leaves only checkpoints that can be resumed.
//! The learner's own tests check which updates it rejects.

use std::fs;

use driml_tests::{Outcome, RunFolder, check_has};
use safetensors::SafeTensors;

use crate::{SHORT, system};

/// Checks that every number in the tensor files of the checkpoints is finite.
fn check_finite(run: &RunFolder) {
    let checkpoints = run.checkpoints();
    assert!(!checkpoints.is_empty());
    for checkpoint in checkpoints {
        for file in fs::read_dir(checkpoint).unwrap() {
            let path = file.unwrap().path();
            if path.extension().is_none_or(|it| it != "safetensors") {
                continue;
            }
            let bytes = fs::read(&path).unwrap();
            for (name, tensor) in SafeTensors::deserialize(&bytes).unwrap().iter() {
                let (numbers, _) = tensor.data().as_chunks::<4>();
                let finite = numbers.iter().all(|&it| f32::from_le_bytes(it).is_finite());
                assert!(finite, "{name} in {}", path.display());
            }
        }
    }
}

#[test]
fn parameters_that_are_not_finite_are_neither_saved_nor_acted_with() {
    let at_once =
        "--set learner.checkpoint_period_updates=1 --set learner.publish_period_updates=1";
    // The first step is finite, but the next loss is not.
    let large = "--set learner.update.adam.lr=1e33";
    let system = system();
    let call = format!("local --agent driml-fix {SHORT} {at_once} {large} --run-dir run");
    system.run(&call).expect_code(1);
    system.check_outcome(Outcome::Failed);
    let run = system.run_folder("run");
    let log = run.log("learner");
    check_has(&log, &["is not finite; the update was not applied"]);
    let log = run.log("actor-0");
    assert!(!log.contains("were rejected"), "{log}");
    check_finite(&run);
}
