//! Checkpoints that are damaged, or that no learner wrote: each gives an error that names the file, and none is skipped.

use std::fs;

use candle_core::{Device, Tensor};
use driml_learner::{
    AffinityEstimator, Alphabet, ExactAffinity, ExactSettings,
    checkpoint::{self, CheckpointError, LearnerState},
};
use driml_model::Compute;
use serde_json::{Value, json};
use tempfile::tempdir;

use crate::{
    checkpoint::{change_state, initial_state, learn, load, save, sha256, try_save},
    errors::diverged_agent,
    synthetic::{ACTIONS, CANDLE, check_says},
};

#[test]
fn every_kind_of_damage_is_reported_with_its_file() {
    let folder = tempdir().unwrap();
    let mut run = initial_state();
    learn(&mut run, 1);
    let path = save(&run, folder.path(), 1);
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
            let error = load(folder.path()).expect_err(name);
            assert!(matches!(error, CheckpointError::Damaged { .. }), "{error}");
            check_says(error, &[name, "remove"]);
            let error = checkpoint::read_affinity(&path);
            assert_eq!(error.is_err(), name.starts_with("state.json"), "{name}");
        };
        for cut in [0, whole.len() / 2] {
            fs::write(&file, &whole[..cut]).unwrap();
            reported();
        }
        // The last digit of a size in a network's description.
        let size = br#"hidden\":16"#;
        let size = whole.windows(size.len()).position(|it| it == size);
        let is_described = name == "online.safetensors" || name == "target.safetensors";
        assert_eq!(size.is_some(), is_described);
        for at in [Some(whole.len() / 2), size.map(|at| at + 10)]
            .into_iter()
            .flatten()
        {
            let mut flipped = whole.clone();
            flipped[at] ^= 1;
            fs::write(&file, &flipped).unwrap();
            if name != "state.json.sha256" || at < 64 {
                reported();
            }
        }
        fs::remove_file(&file).unwrap();
        reported();
        fs::write(&file, &whole).unwrap();
    }
    assert!(load(folder.path()).unwrap().is_some());
}

#[test]
fn a_checkpoint_of_another_format_is_rejected() {
    let folder = tempdir().unwrap();
    let path = save(&initial_state(), folder.path(), 1);
    for unknown in [0, 3, 5] {
        // Another format may have any other fields.
        change_state(&path, |state| {
            *state = json!({ "format": unknown, "field": 1 });
        });
        let said = format!("another version of this program (format {unknown}, this one reads 4)");
        check_says(load(folder.path()).unwrap_err(), &[&said]);
    }
}

/// With one checkpoint kept, saving a state that cannot be resumed would remove the last good one.
#[test]
fn a_state_that_is_not_finite_is_not_saved() {
    for compute in [&Compute::CPU, &CANDLE] {
        let folder = tempdir().unwrap();
        let mut run = initial_state();
        save(&run, folder.path(), 1);
        for name in ["head.bias", "dim.psi4.out.weight"] {
            run.agent = diverged_agent(compute, name).0;
            let said = try_save(&run, folder.path(), 1).unwrap_err().to_string();
            let is_told = said.starts_with("the checkpoint was not saved") && said.contains(name);
            assert!(is_told, "{said}");
            let left: Vec<_> = fs::read_dir(folder.path()).unwrap().collect();
            assert_eq!(left.len(), 1, "{left:?}");
            assert_eq!(load(folder.path()).unwrap().unwrap().agent.updates(), 0);
        }
    }
}

/// A change of one place in state.json.
fn set(place: &'static str, value: Value) -> impl Fn(&mut Value) {
    move |state| *state.pointer_mut(place).unwrap() = value.clone()
}

/// Files with a valid checksum, as an attacker may write them.
#[test]
fn arrays_and_counts_that_no_learner_wrote_are_damage() {
    let exact = ExactSettings {
        decay: 0.99,
        smoothing: 1.0,
    };
    let exact = ExactAffinity::new(Alphabet::raw(ACTIONS).unwrap(), exact).unwrap();
    let mut run = initial_state();
    let learned = run.affinity.clone().unwrap();
    let refused = |run: &LearnerState, change: &dyn Fn(&mut Value), said: &str| {
        let folder = tempdir().unwrap();
        let path = save(run, folder.path(), 1);
        load(folder.path()).unwrap().unwrap();
        change_state(&path, change);
        let error = load(folder.path()).map(|_| ()).unwrap_err();
        assert!(matches!(error, CheckpointError::Damaged { .. }), "{error}");
        check_says(error, &["state.json", said]);
    };
    let kinds: [(AffinityEstimator, &[&str]); 2] = [
        (
            learned,
            &["parameters", "first_moments", "second_moments", "smoothed"],
        ),
        (AffinityEstimator::Exact(exact), &["counts"]),
    ];
    for (affinity, arrays) in kinds {
        run.affinity = Some(affinity);
        learn(&mut run, 1);
        for name in arrays {
            let change = |change: fn(&mut Vec<Value>)| {
                move |state: &mut Value| {
                    change(state["affinity"][*name].as_array_mut().unwrap());
                }
            };
            refused(&run, &change(|values| values.truncate(1)), name);
            refused(&run, &change(|values| values.clear()), name);
            refused(&run, &change(|values| values.push(0.into())), name);
            // JSON's form of a number that is not finite.
            refused(&run, &change(|values| values[0] = ().into()), "state.json");
        }
        for (index, len) in [
            (vec![], 0),
            (vec![9, 9], 1),
            (vec![0, 2], 3),
            (vec![0; 300], 1),
        ] {
            let alphabet = json!({ "index": index, "len": len });
            refused(&run, &set("/affinity/alphabet", alphabet), "alphabet");
        }
    }
    let decay = set("/affinity/settings/decay", 2.into());
    refused(&run, &decay, "decay = 2");
    run.affinity = initial_state().affinity;
    for (place, value, said) in [
        ("/affinity/settings/hidden", json!(u64::MAX), "hidden = "),
        ("/updates", json!(u64::MAX), "updates"),
        ("/adam_step", json!(u64::MAX), "adam_step"),
        ("/weights_version", json!(u64::MAX), "weights_version"),
        ("/rng/seed", json!([1, 2]), "state.json"),
        ("/rng/word_pos", json!(-1), "state.json"),
    ] {
        refused(&run, &set(place, value), said);
    }
}

#[test]
fn moments_that_no_optimiser_has_are_damage() {
    let folder = tempdir().unwrap();
    let mut run = initial_state();
    learn(&mut run, 1);
    let path = save(&run, folder.path(), 1);
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
        let wanted = format!("the moment {name} is {number} at index 0");
        let error = load(folder.path()).map(|_| ()).unwrap_err();
        check_says(error, &["optimizer.safetensors", &wanted]);
    }
}
