//! What a run leaves that never was, for tests.

use driml_launch::run_folder::{Outcome, Recorded, RunFolder, RunRecorder, Summary};
use driml_protocol::{Horizon, LearnerStatus, ReplayStatus, RunSpec, TimeoutRule};

pub(crate) fn spec() -> RunSpec {
    RunSpec {
        world: "chain".into(),
        agent: "driml-ada".into(),
        seed: 3,
        frame_height: 12,
        frame_width: 12,
        frame_channels: 1,
        frame_stack: 1,
        num_actions: 3,
        n_step: 7,
        gamma: 0.99,
        horizon: Horizon::Nhg { k_max: 5 },
        timeout: TimeoutRule::Terminal,
    }
}

/// What a run leaves that did nothing.
pub(crate) fn summary() -> Summary {
    let folder = tempfile::tempdir().unwrap();
    let recorder =
        RunRecorder::create(&RunFolder::new(folder.path()), Recorded::default()).unwrap();
    let (replay, learner) = (ReplayStatus::default(), LearnerStatus::default());
    recorder.summarise(Outcome::Finished, &spec(), &replay, &learner)
}
