//! Checkpoints: bit-exact resumption, and damage that is reported instead of skipped.
//! Crashes are made up by what they leave on disk.

use std::{
    fs,
    path::{Path, PathBuf},
};

use candle_core::{Device, Tensor};
use driml_learner::{
    AffinityEstimator, Agent, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity,
    LearnedSettings, Progress,
    checkpoint::{self, CheckpointError, RunState, list, load_latest, lock, save},
};
use driml_model::{Compute, ModelConfig, Parameters, Precision, TorsoName};
use driml_protocol::Tally;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};

use crate::{
    errors::diverged,
    made_up::{ACTIONS, ALL_DIM, CANDLE, Rows, agent, agent_on, model, settings},
};

const SPEC: u64 = 0x0123_4567_89ab_cdef;

/// A folder of this test's own, removed at its end.
pub(crate) struct Folder(pub(crate) PathBuf);

impl Folder {
    pub(crate) fn new(name: &str) -> Self {
        let path =
            std::env::temp_dir().join(format!("driml-checkpoint-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

struct Run {
    agent: Agent,
    affinity: AffinityEstimator,
    rng: ChaCha8Rng,
}

impl Run {
    fn new() -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(99);
        let settings = LearnedSettings {
            hidden: 8,
            lr: 1e-3,
            beta1: 0.9,
            beta2: 0.999,
            eps: 1e-8,
            keep: 0.9,
        };
        let affinity =
            LearnedAffinity::new(Alphabet::raw(ACTIONS).unwrap(), settings, &mut rng).unwrap();
        Self {
            agent: agent(ALL_DIM, 1),
            affinity: AffinityEstimator::Learned(affinity),
            rng,
        }
    }

    fn updates(&mut self, count: u64) {
        for _ in 0..count {
            let rows = Rows::random(6, self.agent.updates());
            self.agent.update(&rows.batch()).unwrap();
            self.affinity
                .observe(&rows.batch().action_pairs(), &mut self.rng)
                .unwrap();
        }
    }

    fn save(&self, folder: &Path, keep: usize) -> PathBuf {
        let Self {
            agent,
            affinity,
            rng,
        } = self;
        let state = RunState {
            agent,
            affinity: Some(affinity),
            rng,
            weights_version: 7,
            progress: &progress(),
            run_spec_hash: SPEC,
            description: DESCRIPTION,
            companion: None,
        };
        save(folder, &state, keep).unwrap()
    }

    fn resume(folder: &Path) -> Self {
        let restored = load(folder).unwrap().expect("a checkpoint");
        assert_eq!(restored.weights_version, 7);
        assert_eq!(restored.progress, progress());
        let affinity = restored.affinity.expect("an estimate");
        Self {
            agent: restored.agent,
            affinity,
            rng: restored.rng,
        }
    }

    fn bytes(&self) -> [Vec<u8>; 2] {
        let all = |parameters: &Parameters| parameters.to_safetensors(|_| true).unwrap();
        [all(self.agent.online()), all(self.agent.target())]
    }
}

/// A run of two shards.
fn progress() -> Progress {
    let tally = |inserted, rows_sampled| Tally {
        inserted,
        rows_sampled,
    };
    Progress {
        run: u64::MAX,
        shards: vec![tally(100, 200), tally(7, 0)],
    }
}

/// What the metadata says is for others: here it is any text.
const DESCRIPTION: &str = r#"{"format":1}"#;

fn load(folder: &Path) -> Result<Option<driml_learner::checkpoint::Restored>, CheckpointError> {
    load_latest(
        folder,
        &model(ALL_DIM),
        &settings(ALL_DIM),
        &Compute::CPU,
        SPEC,
    )
}

/// A network of other sizes is no damage: the setting that differs is named.
#[test]
fn a_checkpoint_of_another_network_says_which_setting_differs() {
    let folder = Folder::new("model");
    let run = Run::new();
    let ours = model(ALL_DIM);
    let state = RunState {
        agent: &run.agent,
        affinity: None,
        rng: &run.rng,
        weights_version: 7,
        progress: &progress(),
        run_spec_hash: SPEC,
        description: &serde_json::json!({ "model": ours }).to_string(),
        companion: None,
    };
    let path = save(&folder.0, &state, 1).unwrap();
    let load = |model: &ModelConfig| {
        checkpoint::load(&path, model, &settings(ALL_DIM), &Compute::CPU, SPEC)
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
    assert!(
        said.contains(&differs) && !said.contains("damaged"),
        "{said}"
    );
    let other = ModelConfig {
        torso: TorsoName::Impala,
        conv: vec![],
        channels: vec![4],
        ..ours.clone()
    };
    let said = load(&other).unwrap_err().to_string();
    let differs = "was saved with model.torso = \"nature\", this run has model.torso = \"impala\"";
    assert!(said.contains(differs), "{said}");
}

#[test]
fn a_checkpoint_goes_on_with_other_operations_than_it_was_saved_by() {
    const BF16: Compute = Compute::cpu(Precision::Bf16);
    // Of the total, relative; of parameters, absolute: a learning rate is 1e-3, and bf16 may turn the sign of a small gradient.
    let (same, rounded) = ((1e-4, 1e-4), (1e-2, 2e-3));
    for (saver, loader, (total, parameter)) in [
        (&Compute::CPU, &CANDLE, same),
        (&CANDLE, &Compute::CPU, same),
        (&Compute::CPU, &BF16, rounded),
        (&BF16, &Compute::CPU, rounded),
    ] {
        let folder = Folder::new("operations");
        let mut run = Run::new();
        run.agent = agent_on(saver, ALL_DIM, 1);
        run.updates(4);
        run.save(&folder.0, 1);
        let (model, settings) = (model(ALL_DIM), settings(ALL_DIM));
        let restored = load_latest(&folder.0, &model, &settings, loader, SPEC).unwrap();
        let mut resumed = restored.expect("a checkpoint").agent;
        let is_same = run.agent.weights().unwrap() == resumed.weights().unwrap();
        assert!(is_same, "the weights are the same bits");
        let rows = Rows::random(6, 9);
        let (a, b) = (
            run.agent.update(&rows.batch()).unwrap(),
            resumed.update(&rows.batch()).unwrap(),
        );
        assert!((a.total - b.total).abs() < total * a.total, "{a:?}\n{b:?}");
        for (name, var) in run.agent.online().iter() {
            let other = resumed.online().get(name).unwrap();
            let difference = (var.as_tensor() - other.as_tensor()).unwrap().abs();
            let largest = difference.unwrap().max_all().unwrap();
            // With the moments lost, the step would be of another size altogether.
            let largest = largest.to_scalar::<f32>().unwrap();
            assert!(largest < parameter, "{name}: {largest}");
        }
    }
}

#[test]
fn a_resumed_run_is_the_same_run_bit_for_bit() {
    let folder = Folder::new("resume");
    let mut straight = Run::new();
    straight.updates(8);

    let mut first_half = Run::new();
    first_half.updates(4);
    first_half.save(&folder.0, 2);
    drop(first_half);
    let mut resumed = Run::resume(&folder.0);
    assert_eq!(resumed.agent.updates(), 4);
    resumed.updates(4);

    assert!(straight.bytes() == resumed.bytes(), "the networks differ");
    assert_eq!(straight.affinity, resumed.affinity);
    assert_eq!(straight.rng, resumed.rng);
    // The optimiser's state, through its file.
    let (a, b) = (Folder::new("straight"), Folder::new("resumed"));
    let optimizer = |path: PathBuf| fs::read(path.join("optimizer.safetensors")).unwrap();
    let is_same = optimizer(straight.save(&a.0, 1)) == optimizer(resumed.save(&b.0, 1));
    assert!(is_same, "the moments differ");
}

#[test]
fn the_newest_are_kept_and_an_unfinished_save_is_no_checkpoint() {
    let folder = Folder::new("keep");
    assert!(
        load(&folder.0).unwrap().is_none(),
        "no folder, no checkpoint"
    );
    let mut run = Run::new();
    for _ in 0..3 {
        run.updates(1);
        run.save(&folder.0, 2);
    }
    run.save(&folder.0, 2);
    fs::create_dir(folder.0.join("checkpoint-000000000009.tmp")).unwrap();
    let kept: Vec<u64> = list(&folder.0)
        .unwrap()
        .iter()
        .map(|(updates, _)| *updates)
        .collect();
    assert_eq!(kept, [2, 3]);
    assert_eq!(load(&folder.0).unwrap().unwrap().agent.updates(), 3);
}

#[test]
fn what_a_cut_off_save_left_is_gone_after_the_next() {
    let folder = Folder::new("cut-off");
    let mut run = Run::new();
    run.updates(1);
    run.save(&folder.0, 3);
    for name in ["checkpoint-000000000009.tmp", "checkpoint-000000000001.tmp"] {
        fs::create_dir(folder.0.join(name)).unwrap();
        fs::write(folder.0.join(name).join("online.safetensors"), "half").unwrap();
    }
    run.updates(1);
    run.save(&folder.0, 3);
    let mut names: Vec<_> = fs::read_dir(&folder.0)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(
        names,
        ["checkpoint-000000000001", "checkpoint-000000000002"]
    );
}

#[test]
fn a_checkpoint_is_there_while_it_is_replaced() {
    let folder = Folder::new("replaced");
    let mut run = Run::new();
    run.updates(1);
    let path = run.save(&folder.0, 3);
    let updates = || -> Vec<u64> {
        let all = list(&folder.0).unwrap();
        all.iter().map(|(updates, _)| *updates).collect()
    };
    // A crash between the two renames.
    let replaced = folder.0.join("checkpoint-000000000001.replaced.tmp");
    fs::rename(&path, &replaced).unwrap();
    assert_eq!(updates(), [1]);
    assert_eq!(Run::resume(&folder.0).bytes(), run.bytes());
    // The next save gives it its name back.
    run.updates(1);
    run.save(&folder.0, 3);
    assert_eq!(updates(), [1, 2]);
    assert!(path.exists() && !replaced.exists());
    // And a crash after them.
    fs::create_dir(&replaced).unwrap();
    assert_eq!(updates(), [1, 2]);
    run.save(&folder.0, 3);
    assert!(!replaced.exists());
}

#[test]
fn every_kind_of_damage_is_reported_with_its_file() {
    let folder = Folder::new("damage");
    let mut run = Run::new();
    run.updates(1);
    let path = run.save(&folder.0, 1);
    for name in [
        "online.safetensors",
        "target.safetensors",
        "optimizer.safetensors",
        "state.json",
        "state.json.sha256",
    ] {
        let file = path.join(name);
        let whole = fs::read(&file).unwrap();
        let reported = || {
            let error = load(&folder.0).expect_err(name);
            assert!(matches!(error, CheckpointError::Damaged { .. }), "{error}");
            let text = error.to_string();
            assert!(text.contains(name) && text.contains("remove"), "{text}");
        };
        fs::write(&file, &whole[..whole.len() / 2]).unwrap();
        reported();
        let mut flipped = whole.clone();
        flipped[whole.len() / 2] ^= 1;
        fs::write(&file, &flipped).unwrap();
        if name != "state.json.sha256" || whole.len() / 2 < 64 {
            reported();
        }
        fs::remove_file(&file).unwrap();
        reported();
        fs::write(&file, &whole).unwrap();
    }
    assert!(load(&folder.0).unwrap().is_some());
}

fn sha256(bytes: &[u8]) -> String {
    let digest = Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes state.json with `change` made to it, and its sum.
pub(crate) fn change_state(path: &Path, change: impl Fn(&mut serde_json::Value)) {
    let file = path.join("state.json");
    let mut state = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    change(&mut state);
    let text = serde_json::to_vec_pretty(&state).unwrap();
    let sum = sha256(&text);
    fs::write(&file, text).unwrap();
    fs::write(
        path.join("state.json.sha256"),
        format!("{sum}  state.json\n"),
    )
    .unwrap();
}

#[test]
fn a_checkpoint_of_another_format_is_rejected() {
    let folder = Folder::new("format");
    let path = Run::new().save(&folder.0, 1);
    for unknown in [0, 2, 4] {
        change_state(&path, |state| state["format"] = unknown.into());
        let said = load(&folder.0).unwrap_err().to_string();
        assert!(
            said.contains(&format!("its format is {unknown}, not 3")),
            "{said}"
        );
    }
}

/// With one checkpoint kept, a save of what cannot be gone on from would remove the last good one.
#[test]
fn a_state_that_is_not_finite_is_not_saved() {
    for compute in [&Compute::CPU, &CANDLE] {
        let folder = Folder::new("not-finite");
        let mut run = Run::new();
        run.save(&folder.0, 1);
        for name in ["head.bias", "dim.psi4.out.weight"] {
            run.agent = diverged(compute, name).0;
            let state = RunState {
                agent: &run.agent,
                affinity: None,
                progress: &progress(),
                rng: &run.rng,
                weights_version: 8,
                run_spec_hash: SPEC,
                description: DESCRIPTION,
                companion: None,
            };
            let said = save(&folder.0, &state, 1).unwrap_err().to_string();
            assert!(
                said.starts_with("nothing is saved") && said.contains(name),
                "{said}"
            );
            let left: Vec<_> = fs::read_dir(&folder.0).unwrap().collect();
            assert_eq!(left.len(), 1, "{left:?}");
            assert_eq!(load(&folder.0).unwrap().unwrap().agent.updates(), 0);
        }
    }
}

/// Files whose sum is right, as somebody may write them who wants the learner to fall over.
#[test]
fn arrays_and_counts_that_no_learner_wrote_are_damage() {
    let exact = ExactSettings {
        decay: 0.99,
        smoothing: 1.0,
    };
    let exact = ExactAffinity::new(Alphabet::raw(ACTIONS).unwrap(), exact).unwrap();
    let mut run = Run::new();
    let learned = run.affinity.clone();
    let refused = |run: &Run, change: &dyn Fn(&mut serde_json::Value), said: &str| {
        let folder = Folder::new("arrays");
        let path = run.save(&folder.0, 1);
        load(&folder.0).unwrap().unwrap();
        change_state(&path, change);
        let error = load(&folder.0).map(|_| ()).unwrap_err();
        assert!(matches!(error, CheckpointError::Damaged { .. }), "{error}");
        let text = error.to_string();
        assert!(
            text.contains("state.json") && text.contains(said),
            "{said}: {text}"
        );
    };
    let array = |state: &mut serde_json::Value, name: &str| -> Vec<serde_json::Value> {
        state["affinity"][name].as_array().unwrap().clone()
    };
    let kinds: [(AffinityEstimator, &[&str]); 2] = [
        (
            learned,
            &[
                "parameters",
                "first_moments",
                "second_moments",
                "smoothed",
                "matrix",
            ],
        ),
        (AffinityEstimator::Exact(exact), &["counts", "matrix"]),
    ];
    for (affinity, arrays) in kinds {
        run.affinity = affinity;
        run.updates(1);
        for name in arrays {
            let change = |change: fn(&mut Vec<serde_json::Value>)| {
                move |state: &mut serde_json::Value| {
                    let mut values = array(state, name);
                    change(&mut values);
                    state["affinity"][*name] = values.into();
                }
            };
            refused(&run, &change(|values| values.truncate(1)), name);
            refused(&run, &change(|values| values.clear()), name);
            refused(&run, &change(|values| values.push(0.into())), name);
            // NaN in 64 bits; in 32 too many bits to be read at all.
            let nan = change(|values| values[0] = f64::NAN.to_bits().into());
            refused(
                &run,
                &nan,
                if *name == "matrix" {
                    "state.json"
                } else {
                    name
                },
            );
            let nan = change(|values| values[0] = f32::NAN.to_bits().into());
            if *name == "matrix" {
                refused(&run, &nan, name);
            }
        }
        for (raw, len) in [
            (vec![], 0),
            (vec![9, 9], 1),
            (vec![0, 2], 3),
            (vec![0; 300], 1),
        ] {
            let change = |state: &mut serde_json::Value| {
                state["affinity"]["alphabet"]["index"] = raw.clone().into();
                state["affinity"]["alphabet"]["len"] = len.into();
            };
            refused(&run, &change, "alphabet");
        }
    }
    let huge = |state: &mut serde_json::Value| state["affinity"]["settings"]["decay"] = 2.into();
    refused(&run, &huge, "a decay of 2");
    run.affinity = Run::new().affinity;
    for (key, value) in [("hidden", u64::MAX), ("lr", 0), ("keep", 1)] {
        let change =
            |state: &mut serde_json::Value| state["affinity"]["settings"][key] = value.into();
        refused(&run, &change, &format!("{key} = "));
    }
    for key in ["updates", "adam_step", "weights_version"] {
        let change = |state: &mut serde_json::Value| state[key] = u64::MAX.into();
        refused(&run, &change, key);
    }
    for (key, value) in [
        ("seed", serde_json::json!([1, 2])),
        ("word_pos", (-1).into()),
    ] {
        let change = |state: &mut serde_json::Value| state["rng"][key] = value.clone();
        refused(&run, &change, "state.json");
    }
}

#[test]
fn moments_that_no_optimiser_has_are_damage() {
    let folder = Folder::new("moments");
    let mut run = Run::new();
    run.updates(1);
    let path = run.save(&folder.0, 1);
    let file = path.join("optimizer.safetensors");
    let whole = fs::read(&file).unwrap();
    for (name, number) in [
        ("m.head.bias", f32::NAN),
        ("m.head.bias", f32::INFINITY),
        ("v.head.bias", f32::NAN),
        ("v.head.bias", -1.0),
    ] {
        let mut tensors = candle_core::safetensors::load_buffer(&whole, &Device::Cpu).unwrap();
        let moment = &tensors[name];
        let poisoned = Tensor::full(number, moment.dims(), &Device::Cpu).unwrap();
        tensors.insert(name.to_owned(), poisoned);
        let bytes = safetensors::serialize(&tensors, None).unwrap();
        fs::write(&file, &bytes).unwrap();
        change_state(&path, |state| {
            state["sha256"]["optimizer.safetensors"] = sha256(&bytes).into();
        });
        let said = load(&folder.0).map(|_| ()).unwrap_err().to_string();
        let wanted = format!("the moment {name} is {number} at index 0");
        assert!(
            said.contains("optimizer.safetensors") && said.contains(&wanted),
            "{said}"
        );
    }
}

#[test]
fn another_run_s_checkpoint_is_refused() {
    let folder = Folder::new("other");
    Run::new().save(&folder.0, 1);
    let error = load_latest(
        &folder.0,
        &model(ALL_DIM),
        &settings(ALL_DIM),
        &Compute::CPU,
        SPEC + 1,
    )
    .expect_err("another run");
    assert!(matches!(error, CheckpointError::OtherRun { .. }), "{error}");
}

#[test]
fn one_learner_saves_in_a_folder() {
    let folder = Folder::new("lock");
    let held = lock(&folder.0).unwrap();
    let said = lock(&folder.0).unwrap_err().to_string();
    assert!(said.contains("another learner saves in"), "{said}");
    assert_eq!(list(&folder.0).unwrap(), []);
    drop(held);
    lock(&folder.0).unwrap();
}

/// Checkpoints of earlier versions say nothing of themselves, and load all the same.
#[test]
fn the_networks_say_what_they_are_and_need_not() {
    let folder = Folder::new("described");
    let run = Run::new();
    let path = run.save(&folder.0, 1);
    for name in ["online.safetensors", "target.safetensors"] {
        let file = fs::read(path.join(name)).unwrap();
        let (_, header) = safetensors::SafeTensors::read_metadata(&file).unwrap();
        let entries = header.metadata().as_ref().unwrap();
        assert_eq!(entries.len(), 1);
        assert_eq!(entries["driml"], DESCRIPTION);
    }
    let bare = run.agent.online().to_safetensors(|_| true).unwrap();
    fs::write(path.join("online.safetensors"), &bare).unwrap();
    change_state(&path, |state| {
        state["sha256"]["online.safetensors"] = sha256(&bare).into()
    });
    assert_eq!(Run::resume(&folder.0).bytes(), run.bytes());
}

/// Against float64; the average is no part of what is learned.
#[test]
fn averaged_weights_follow_and_are_saved_and_played() {
    const TAU: f64 = 0.25;
    let folder = Folder::new("average");
    let mut run = Run::new();
    let mut settings = run.agent.settings().clone();
    settings.average_tau = Some(TAU);
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    run.agent = Agent::new(model(ALL_DIM), settings.clone(), &Compute::CPU, rng).unwrap();
    let values = |parameters: &Parameters| -> Vec<f64> {
        let all = parameters
            .iter()
            .filter(|(name, _)| !name.starts_with("dim."));
        all.flat_map(|(_, var)| var.flatten_all().unwrap().to_vec1::<f32>().unwrap())
            .map(f64::from)
            .collect()
    };
    let mut expected = values(run.agent.online());
    for _ in 0..5 {
        run.updates(1);
        for (average, online) in expected.iter_mut().zip(values(run.agent.online())) {
            *average += TAU * (online - *average);
        }
    }
    let average = values(run.agent.average().unwrap());
    let worst = average.iter().zip(&expected).map(|(a, b)| (a - b).abs());
    assert!(worst.fold(0.0, f64::max) < 1e-6);
    assert_ne!(average, values(run.agent.online()));

    run.save(&folder.0, 1);
    let load = |settings: &_| {
        let restored = load_latest(&folder.0, &model(ALL_DIM), settings, &Compute::CPU, SPEC);
        restored.unwrap().unwrap().agent
    };
    let restored = load(&settings);
    assert_eq!(values(restored.average().unwrap()), average);
    assert_eq!(values(restored.online()), values(run.agent.online()));
    let mut played = restored;
    assert!(played.take_average().unwrap());
    assert_eq!(values(played.online()), average);
    settings.average_tau = None;
    assert!(!load(&settings).take_average().unwrap());
}
