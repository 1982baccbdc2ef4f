//! Checkpoints: which are kept, and what a crash leaves, imitated with files.
//! `checkpoint_damage` tests damage, and `served` that a resumed run is the same run.

use std::{
    fs,
    path::{Path, PathBuf},
};

use driml_learner::{
    AffinityEstimator, Agent, Alphabet, LearnedAffinity, RunCounts,
    checkpoint::{self, CheckpointError, Extras, LearnerState, list, load_latest, lock},
};
use driml_model::{Compute, InputSize, ModelConfig, Parameters, Precision, TorsoName, WeightDtype};
use driml_protocol::{RunSpec, ShardCounts};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};
use tempfile::tempdir;

use crate::agents::{assert_near, average_in, select};
use crate::synthetic::{
    ACTIONS, ALL_DIM, CANDLE, LEARNED, agent, agent_on, check_says, model, new_agent, random_batch,
    settings, values,
};

/// A learner's state before its first update, in a run with earlier learners.
pub(crate) fn initial_state() -> LearnerState {
    let mut rng = ChaCha8Rng::seed_from_u64(99);
    let alphabet = Alphabet::raw(ACTIONS).unwrap();
    let affinity = LearnedAffinity::new(alphabet, LEARNED, &mut rng).unwrap();
    LearnerState {
        agent: agent(ALL_DIM, 1),
        affinity: Some(AffinityEstimator::Learned(affinity)),
        rng,
        weights_version: 7,
        run_counts: run_counts(),
    }
}

pub(crate) fn learn(run: &mut LearnerState, updates: u64) {
    for _ in 0..updates {
        let rows = random_batch(6, run.agent.updates());
        run.agent.update(&rows.batch()).unwrap();
        let affinity = run.affinity.as_mut().unwrap();
        let pairs = rows.batch().action_pairs(0..6);
        affinity.observe(&pairs, &mut run.rng).unwrap();
    }
}

pub(crate) fn save(run: &LearnerState, folder: &Path, keep: usize) -> PathBuf {
    try_save(run, folder, keep).unwrap()
}

pub(crate) fn try_save(
    run: &LearnerState,
    folder: &Path,
    keep: usize,
) -> Result<PathBuf, CheckpointError> {
    let extras = Extras {
        spec: &RunSpec::smallest(),
        input: &InputSize {
            height: 20,
            width: 24,
            frame: None,
        },
        companion: None,
    };
    checkpoint::save(folder, run, extras, keep)
}

fn resume(folder: &Path) -> LearnerState {
    let run = load(folder).unwrap().expect("a checkpoint");
    assert_eq!((run.weights_version, &run.run_counts), (7, &run_counts()));
    run
}

fn listed_updates(folder: &Path) -> Vec<u64> {
    let all = list(folder).unwrap();
    all.iter().map(|(updates, _)| *updates).collect()
}

fn network_bytes(run: &LearnerState) -> [Vec<u8>; 2] {
    let all = |parameters: &Parameters| parameters.to_safetensors(|_| true).unwrap();
    [all(run.agent.online()), all(run.agent.target())]
}

pub(crate) fn run_counts() -> RunCounts {
    RunCounts {
        run: u64::MAX,
        shards: vec![ShardCounts::new(100, 200), ShardCounts::new(7, 0)],
    }
}

fn spec_hash() -> u64 {
    RunSpec::smallest().hash()
}

pub(crate) fn load(folder: &Path) -> Result<Option<LearnerState>, CheckpointError> {
    let (model, settings) = (model(ALL_DIM), settings(ALL_DIM));
    load_latest(folder, &model, &settings, &Compute::CPU, spec_hash())
}

pub(crate) fn sha256(bytes: &[u8]) -> String {
    format!("{:x}", Sha256::digest(bytes))
}

/// Applies `change` to state.json and writes it with its checksum.
pub(crate) fn change_state(path: &Path, change: impl Fn(&mut serde_json::Value)) {
    let file = path.join("state.json");
    let mut state = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    change(&mut state);
    let text = serde_json::to_vec_pretty(&state).unwrap();
    let sum = format!("{}  state.json\n", sha256(&text));
    fs::write(&file, text).unwrap();
    fs::write(path.join("state.json.sha256"), sum).unwrap();
}

/// A network of other sizes is not reported as damage: the error names the setting that differs.
#[test]
fn a_checkpoint_of_another_network_says_which_setting_differs() {
    let folder = tempdir().unwrap();
    let run = initial_state();
    let ours = model(ALL_DIM);
    let path = save(&run, folder.path(), 1);
    let load = |model: &ModelConfig| {
        checkpoint::load(&path, model, &settings(ALL_DIM), &Compute::CPU, spec_hash())
    };
    assert!(load(&ours).is_ok());
    let other = ModelConfig {
        hidden: ours.hidden + 1,
        ..ours.clone()
    };
    let said = load(&other).unwrap_err().to_string();
    let differs = format!(
        "was saved with model.hidden = {}, this run has model.hidden = {}",
        ours.hidden, other.hidden
    );
    let is_told = said.contains(&differs) && !said.contains("damaged");
    assert!(is_told, "{said}");
    let other = ModelConfig {
        torso: TorsoName::Impala,
        conv: vec![],
        channels: vec![4],
        ..ours.clone()
    };
    let differs = "was saved with model.torso = \"nature\", this run has model.torso = \"impala\"";
    check_says(load(&other).unwrap_err(), &[differs]);
}

#[test]
fn a_checkpoint_continues_with_other_operations_than_it_was_saved_by() {
    const BF16: Compute = Compute::cpu(Precision::Bf16);
    // Relative for the total, absolute for the largest and the mean difference of parameters: a learning rate is 1e-3, and bf16 may turn
    // the sign of a small gradient.
    let (same, rounded) = ((1e-4, 1e-4, 1e-4), (1e-2, 2e-3, 2e-4));
    for (saver, loader, (total, parameter, mean)) in [
        (&Compute::CPU, &CANDLE, same),
        (&CANDLE, &Compute::CPU, same),
        (&Compute::CPU, &BF16, rounded),
        (&BF16, &Compute::CPU, rounded),
    ] {
        let folder = tempdir().unwrap();
        let mut run = initial_state();
        run.agent = agent_on(saver, ALL_DIM, 1);
        learn(&mut run, 4);
        save(&run, folder.path(), 1);
        let (model, settings) = (model(ALL_DIM), settings(ALL_DIM));
        let restored = load_latest(folder.path(), &model, &settings, loader, spec_hash()).unwrap();
        let mut resumed = restored.expect("a checkpoint").agent;
        let weights = |agent: &Agent| agent.weights(WeightDtype::F32).unwrap();
        let is_same = weights(&run.agent) == weights(&resumed);
        assert!(is_same, "the weights are the same bits");
        let rows = random_batch(6, 9);
        let (a, b) = (
            run.agent.update(&rows.batch()).unwrap().losses,
            resumed.update(&rows.batch()).unwrap().losses,
        );
        assert!((a.total - b.total).abs() < total * a.total, "{a:?}\n{b:?}");
        let [ours, theirs] = [&run.agent, &resumed].map(|it| values(it.online()));
        let pairs = ours
            .iter()
            .flat_map(|(name, it)| it.iter().zip(&theirs[name]));
        let differences: Vec<f32> = pairs.map(|(a, b)| (a - b).abs()).collect();
        assert!(differences.iter().all(|it| *it < parameter));
        // Without the moments, the steps of moving parameters would differ by 0.4 learning rates or more.
        let found = differences.iter().sum::<f32>() / differences.len() as f32;
        assert!(found < mean, "{found}");
    }
}

#[test]
fn the_newest_are_kept_and_what_a_cut_off_save_left_is_gone_after_the_next() {
    let parent = tempdir().unwrap();
    let folder = parent.path().join("checkpoints");
    assert!(load(&folder).unwrap().is_none(), "no folder, no checkpoint");
    let mut run = initial_state();
    for _ in 0..3 {
        learn(&mut run, 1);
        save(&run, &folder, 2);
    }
    save(&run, &folder, 2);
    for name in ["checkpoint-000000000009.tmp", "checkpoint-000000000002.tmp"] {
        fs::create_dir(folder.join(name)).unwrap();
        fs::write(folder.join(name).join("online.safetensors"), "half").unwrap();
    }
    assert_eq!(listed_updates(&folder), [2, 3]);
    assert_eq!(load(&folder).unwrap().unwrap().agent.updates(), 3);
    learn(&mut run, 1);
    save(&run, &folder, 2);
    assert_eq!(listed_updates(&folder), [3, 4]);
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 2);
}

/// A failure to remove an old checkpoint does not concern the new one.
#[test]
fn a_checkpoint_is_saved_though_an_old_one_cannot_be_removed() {
    let folder = tempdir().unwrap();
    // The removal works on folders only: this file is renamed like an unfinished save, but not removed.
    let stuck = folder.path().join("checkpoint-000000000000");
    fs::write(&stuck, "").unwrap();
    let mut run = initial_state();
    for updates in 1..=3 {
        learn(&mut run, 1);
        save(&run, folder.path(), 1);
        let left = listed_updates(folder.path());
        assert_eq!(left, [updates], "no half of it passes for a checkpoint");
    }
}

#[test]
fn a_checkpoint_is_there_while_it_is_replaced() {
    let folder = tempdir().unwrap();
    let mut run = initial_state();
    learn(&mut run, 1);
    let path = save(&run, folder.path(), 3);
    // A crash between the two renames.
    let replaced = folder.path().join("checkpoint-000000000001.replaced.tmp");
    fs::rename(&path, &replaced).unwrap();
    assert_eq!(listed_updates(folder.path()), [1]);
    assert_eq!(network_bytes(&resume(folder.path())), network_bytes(&run));
    // The next save gives the checkpoint its name back.
    learn(&mut run, 1);
    save(&run, folder.path(), 3);
    assert_eq!(listed_updates(folder.path()), [1, 2]);
    assert!(path.exists() && !replaced.exists());
    // A crash after both renames.
    fs::create_dir(&replaced).unwrap();
    assert_eq!(listed_updates(folder.path()), [1, 2]);
    save(&run, folder.path(), 3);
    assert!(!replaced.exists());
}

#[test]
fn one_learner_saves_in_a_folder() {
    let folder = tempdir().unwrap();
    let held = lock(folder.path()).unwrap();
    let refused = lock(folder.path()).unwrap_err();
    check_says(refused, &["another learner saves in"]);
    assert_eq!(list(folder.path()).unwrap(), []);
    drop(held);
    lock(folder.path()).unwrap();
}

/// Checkpoints of earlier versions have no description, and load all the same.
#[test]
fn the_networks_say_what_they_are_and_need_not() {
    let folder = tempdir().unwrap();
    let run = initial_state();
    let path = save(&run, folder.path(), 1);
    for (name, has_heads) in [("online.safetensors", true), ("target.safetensors", false)] {
        let file = fs::read(path.join(name)).unwrap();
        let described = checkpoint::read_description(&file).unwrap().unwrap();
        assert_eq!(described["model"]["dim"]["psi4"], has_heads);
    }
    let bare = run.agent.online().to_safetensors(|_| true).unwrap();
    fs::write(path.join("online.safetensors"), &bare).unwrap();
    change_state(&path, |state| {
        state["sha256"]["online.safetensors"] = sha256(&bare).into()
    });
    assert_eq!(network_bytes(&resume(folder.path())), network_bytes(&run));
}

/// The average does not affect learning.
#[test]
fn averaged_weights_follow_and_are_saved_and_played() {
    const TAU: f32 = 0.25;
    let folder = tempdir().unwrap();
    let mut run = initial_state();
    let mut settings = run.agent.settings().clone();
    settings.average_tau = Some(TAU.into());
    run.agent = new_agent(model(ALL_DIM), settings.clone(), &Compute::CPU, 1);
    let values =
        |parameters: &Parameters| select(&values(parameters), |name| !name.starts_with("dim."));
    let load = |settings: &_| {
        let model = model(ALL_DIM);
        let restored = load_latest(folder.path(), &model, settings, &Compute::CPU, spec_hash());
        restored.unwrap().unwrap().agent
    };
    save(&run, folder.path(), 1);
    // Before the first update nothing is averaged.
    assert!(!load(&settings).copy_average_to_online().unwrap());
    let mut expected = values(run.agent.online());
    for t in 1..=6 {
        learn(&mut run, 1);
        // A plain mean at first, without the weights that the run began with.
        let rate = TAU.max(1.0 / t as f32);
        average_in(&mut expected, &values(run.agent.online()), rate);
        if t == 2 {
            save(&run, folder.path(), 1);
            run.agent = load(&settings);
        }
    }
    let average = values(run.agent.average().unwrap());
    assert_near(&average, &expected);
    assert_ne!(average, values(run.agent.online()));

    save(&run, folder.path(), 1);
    let restored = load(&settings);
    assert_eq!(values(restored.average().unwrap()), average);
    assert_eq!(values(restored.online()), values(run.agent.online()));
    let mut played = restored;
    assert!(played.copy_average_to_online().unwrap());
    assert_eq!(values(played.online()), average);
    settings.average_tau = None;
    assert!(!load(&settings).copy_average_to_online().unwrap());
}
