//! Settings of runs, run folders, views and players, for tests.

use driml_learner::Compute;
use driml_machine::resources::Machine;
use driml_model::Parameters;
use driml_protocol::{LearnerStatus, ReplayStatus};
use driml_settings::{config::RunConfig, flags::resolve_names};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    evaluate::{EPSILON, Levels, Player, PolicyKind},
    run_folder::RunFolder,
    run_view::{Plan, RunView},
};

pub(crate) const MACHINE: Machine = Machine {
    cores: 2,
    memory_bytes: 64 << 30,
    fast_bf16: false,
};

/// A default value in which some fields are `set`.
pub(crate) fn make<T: Default>(set: impl FnOnce(&mut T)) -> T {
    let mut it = T::default();
    set(&mut it);
    it
}

/// An empty run folder. Dropping the first value removes it.
pub(crate) fn run_folder() -> (tempfile::TempDir, RunFolder) {
    let root = tempfile::tempdir().unwrap();
    let folder = RunFolder::new(root.path());
    (root, folder)
}

/// The view of a run with one replay server, after these answers.
pub(crate) fn view(plan: Plan, replay: ReplayStatus, learner: Option<LearnerStatus>) -> RunView {
    let mut view = RunView::new(plan);
    view.set_learner(learner);
    view.set_replay(vec![replay]);
    view
}

pub(crate) fn config(preset: &str, world: &str, agent: &str, sets: &[&str]) -> RunConfig {
    resolve_names(preset, world, agent, sets, &MACHINE).unwrap()
}

/// An untrained network for this world and agent, with DIM's heads if the agent has them.
pub(crate) fn untrained_player(world: &str, agent: &str) -> Player {
    let config = config("smoke", world, agent, &[]);
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    let network = Parameters::init(&config.model, rng, &Compute::CPU.device).unwrap();
    Player {
        network,
        config,
        updates: 7,
        is_averaged: true,
        epsilon: EPSILON,
    }
}

pub(crate) fn play_returns(player: &Player) -> Vec<f64> {
    let played = player.returns(PolicyKind::Agent, Levels::Train, 4, 3, || false);
    played.unwrap()
}
