//! A learner of each agent on batches as its replay server sends them: augmentation, priorities, checkpoints.
//! `agents` tests losses and gradients on synthetic rows.

use std::fs;

use driml_learner::{
    AffinityConfig, AlphabetKind, AugmentSettings, AuxiliaryKind, Config, EstimatorKind,
    LearnedSettings, Learner, LearnerConfig,
};
use driml_model::{Compute, InputSize};
use driml_protocol::{
    Batch as WireBatch, BatchHeader, Buffer, Horizon, RowScalars, RunSpec, Sampling,
    config::TransportConfig,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::tempdir;

use crate::{
    agents,
    augment::{NOTHING, PAPER},
    synthetic::{CPC, CURL, DIM, LEARNED, check_says},
};

const STATE: usize = 20 * 24 * 2;

pub(crate) fn config(
    auxiliary_loss: AuxiliaryKind,
    augment: Option<AugmentSettings>,
) -> LearnerConfig {
    let (model, update) = agents::configs(auxiliary_loss, agents::GLOBAL);
    let horizon = match auxiliary_loss.name() {
        "cpc" => Horizon::All { k_max: 3 },
        "dim" => Horizon::Fixed { k: 1 },
        _ => Horizon::None {},
    };
    LearnerConfig {
        spec: RunSpec {
            agent: auxiliary_loss.name().into(),
            seed: 5,
            frame_height: 20,
            frame_width: 24,
            frame_channels: 2,
            num_actions: 4,
            n_step: 3,
            gamma: 0.9,
            horizon,
            ..RunSpec::smallest()
        },
        input: InputSize {
            height: model.height as u32,
            width: model.width as u32,
            frame: None,
        },
        model,
        learner: Config {
            deduplicate_states: true,
            precision: Default::default(),
            publish_dtype: Default::default(),
            batch_size: 6,
            batches_in_flight: 1,
            publish_period_updates: 2,
            checkpoint_period_updates: 2,
            checkpoints_kept: 1,
            unreachable_max_ms: 60_000,
            update,
            augment,
            affinity: toml::from_str("estimator = 'none'").unwrap(),
        },
        sampling: Sampling::Uniform {},
        transport: TransportConfig {
            shared_memory: false,
        },
    }
}

fn new_learner(config: &LearnerConfig) -> Learner {
    Learner::new(config.clone(), &Compute::CPU).unwrap()
}

/// A batch as the replay server of this run would send it.
pub(crate) fn served(config: &LearnerConfig, seed: u64) -> WireBatch {
    served_with(config, seed, |_| {})
}

fn served_with(config: &LearnerConfig, seed: u64, change: impl Fn(&mut [RowScalars])) -> WireBatch {
    let positives = config.spec.horizon.positives();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let row = |row: usize| RowScalars {
        action: (row % 4) as u8,
        next_action: 0,
        n_step_return: rng.random_range(-1.0..1.0),
        // The episode of the last row ends.
        bootstrap_discount: if row < 5 { 0.9 } else { 0.0 },
        positives: positives.min(row) as u32,
        k_first: 1,
    };
    let mut rows: Vec<_> = (0..6).map(row).collect();
    change(&mut rows);
    let header = BatchHeader {
        state_bytes: STATE as u32,
        held: 9,
        weights_versions: (1, 1),
        ..BatchHeader::largest(&config.spec, 6).with_sampling(&config.sampling)
    };
    let mut batch = WireBatch::from_rows(header, &rows, Buffer::zeroed);
    let states = batch.header.rows + batch.header.states_k + batch.header.states_n;
    for number in 0..states as usize {
        rng.fill(batch.frame_mut(number));
    }
    batch
}

#[test]
fn augmentation_of_no_strength_is_none_and_a_stronger_one_changes_dim_alone() {
    for auxiliary_loss in [DIM, CPC] {
        let report = |augment| {
            let config = config(auxiliary_loss, augment);
            new_learner(&config).update(&served(&config, 1)).unwrap()
        };
        let (plain, identity, strong) = (report(None), report(Some(NOTHING)), report(Some(PAPER)));
        // The augmented states add rows to the pass, so the sum of gradients may round differently.
        assert_eq!(plain.losses, identity.losses);
        assert!((plain.grad_norm - identity.grad_norm).abs() < 1e-5 * plain.grad_norm);
        assert_eq!(plain.losses.c51_kl, strong.losses.c51_kl);
        assert_eq!(plain.q_mean, strong.q_mean);
        assert_ne!(plain.losses.auxiliary, strong.losses.auxiliary);
    }
}

/// Checkpoints contain the generator and the key encoder: half a run, resumed for the other half, equals the whole run.
#[test]
fn an_augmenting_run_resumes_bit_for_bit() {
    for auxiliary_loss in [CURL, DIM] {
        let folder = tempdir().unwrap();
        let mut config = config(auxiliary_loss, Some(PAPER));
        // A number that f32 does not hold exactly.
        config.model.v_max = 12.6;
        // A number whose digits an inexact parser reads as the neighbouring float.
        config.learner.affinity = AffinityConfig {
            estimator: EstimatorKind::Learned,
            alphabet: Some(AlphabetKind::Raw),
            learned: Some(LearnedSettings {
                eps: 1e-23,
                ..LEARNED
            }),
            ..config.learner.affinity
        };
        let learn = |learner: &mut Learner, updates: std::ops::Range<u64>| {
            for seed in updates {
                learner.update(&served(&config, seed)).unwrap();
            }
        };
        let mut straight = new_learner(&config);
        learn(&mut straight, 0..8);
        let mut half = new_learner(&config);
        learn(&mut half, 0..4);
        half.save(folder.path(), None).unwrap();
        let mut resumed = new_learner(&config).resume(folder.path()).unwrap();
        assert_eq!(resumed.updates(), 4);
        learn(&mut resumed, 4..8);
        let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
        straight.save(&a, None).unwrap();
        resumed.save(&b, None).unwrap();
        let mut files = vec![
            "online.safetensors",
            "target.safetensors",
            "optimizer.safetensors",
            // The affinity and the generator.
            "state.json",
        ];
        if auxiliary_loss == CURL {
            files.push("key.safetensors");
        }
        for file in files {
            let [a, b] = [&a, &b]
                .map(|folder| fs::read(folder.join("checkpoint-000000000008").join(file)).unwrap());
            assert!(a == b, "{auxiliary_loss:?}: {file}");
        }
    }
}

/// A checkpoint that lost its key encoder is damaged.
#[test]
fn a_curl_checkpoint_without_a_key_encoder_is_rejected() {
    let folder = tempdir().unwrap();
    let config = config(CURL, Some(PAPER));
    new_learner(&config).save(folder.path(), None).unwrap();
    let path = folder.path().join("checkpoint-000000000000");
    let resume = || new_learner(&config).resume(folder.path()).map(drop);
    resume().unwrap();
    fs::remove_file(path.join("key.safetensors")).unwrap();
    let missing = "key.safetensors is damaged: it is missing";
    check_says(resume().unwrap_err(), &[missing]);
}

/// A rejected batch leaves the generator unchanged.
#[test]
fn a_refused_batch_draws_nothing() {
    let config = config(CURL, Some(PAPER));
    let good = served(&config, 1);
    let bad = served_with(&config, 2, |rows| rows[0].action = 77);
    let mut learner = new_learner(&config);
    assert!(learner.update(&bad).is_err());
    let after = learner.update(&good).unwrap();
    assert_eq!(after, new_learner(&config).update(&good).unwrap());
}

/// The probability of each row weights its C51 loss alone, at the update's beta. The row's unweighted loss is reported.
#[test]
fn rows_drawn_by_priority_are_weighted_and_answered() {
    let uniform = config(DIM, None);
    let sampling = Sampling::Prioritised {
        alpha: 0.5,
        beta_start: 0.5,
        beta_end: 1.0,
        beta_updates: 1,
    };
    let config = LearnerConfig {
        sampling,
        ..uniform.clone()
    };
    let chances = [0.5f32, 0.25, 0.125, 0.1, 0.5, 1.0];
    let mut batch = served(&config, 1);
    batch.set_draws(&chances.map(|chance| (0_u64, chance)));
    let plain = new_learner(&uniform).update(&served(&uniform, 1));
    let plain = plain.unwrap().losses;
    assert!(plain.row_kls.is_empty());

    let mut learner = new_learner(&config);
    for (update, beta) in [0.5, 1.0, 1.0].into_iter().enumerate() {
        let losses = learner.update(&batch).unwrap().losses;
        let weighted = chances.iter().zip(&losses.row_kls).map(|(chance, kl)| {
            let weight = (0.1 / f64::from(*chance)).powf(beta);
            weight * f64::from(*kl)
        });
        let mean = weighted.sum::<f64>() / 6.0;
        let error = f64::from(losses.c51_kl) - mean;
        assert!(error.abs() < 1e-6 * mean, "beta {beta}: {error} of {mean}");
        if update == 0 {
            assert_eq!(losses.auxiliary, plain.auxiliary, "DIM is unchanged");
            let rows = losses.row_kls.iter().map(|kl| f64::from(*kl)).sum::<f64>();
            let (mean, plain) = (rows / 6.0, f64::from(plain.c51_kl));
            assert!((mean - plain).abs() < 1e-6 * plain, "{mean}, {plain}");
        }
    }
}
