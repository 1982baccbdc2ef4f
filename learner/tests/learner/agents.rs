//! What holds of the agents beside C51 and DIM: CPC's offsets, CURL's two views, and what a learner of each keeps.
//! The arithmetic's oracle is in `parity`.

use std::{collections::BTreeMap, fs};

use driml_learner::{
    AffinityConfig, Agent, AugmentSettings, Batch, Config, EqualStates, EstimatorKind, Lambda,
    Learner, LearnerConfig, LearnerSettings, NetworkParameters, Objective, UpdateError,
};
use driml_model::{Compute, DimHeads, InputSize, ModelConfig, Parameters};
use driml_protocol::{
    Batch as WireBatch, BatchHeader, Buffer, Horizon, RowScalars, RunSpec, Sampling, TimeoutRule,
    config::TransportConfig,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    checkpoint::{Folder, change_state},
    made_up::{ALL_DIM, CPC, CURL, DIM, NO_DIM, Rows, model, settings},
};

const GLOBAL: Lambda = Lambda {
    l4t4: 1.0,
    ..NO_DIM
};
const POSITIVES: usize = 3;
const KEY_TAU: f64 = 0.25;

/// The table `curl` with this pace, or nothing.
fn curl_table(key_tau: Option<f64>) -> toml::Table {
    let table = key_tau.map(|it| toml::Table::from_iter([("key_tau".to_owned(), it.into())]));
    table
        .map(|it| ("curl".to_owned(), it.into()))
        .into_iter()
        .collect()
}

/// The names and values of auxiliary losses.
type Losses = Vec<(&'static str, f32)>;

/// The one loss of an agent that has one.
fn only(losses: &Losses) -> f32 {
    assert_eq!(losses.len(), 1, "{losses:?}");
    losses[0].1
}

fn of(objective: Objective, lambda: Lambda) -> (ModelConfig, LearnerSettings) {
    let settings = LearnerSettings {
        objective,
        condition_on_action: false,
        own: curl_table((objective == CURL).then_some(KEY_TAU)),
        ..settings(lambda)
    };
    let model = ModelConfig {
        dim: settings.dim_heads(4),
        ..model(lambda)
    };
    (model, settings)
}

fn agent(objective: Objective, lambda: Lambda) -> Agent {
    let (model, settings) = of(objective, lambda);
    Agent::new(
        model,
        settings,
        &Compute::CPU,
        &mut ChaCha8Rng::seed_from_u64(1),
    )
    .unwrap()
}

/// `rows` with `POSITIVES` positives a row; the batch borrows what `later` makes of them.
fn cpc<'a>(rows: &'a Rows, states_k: &'a [u8], valid: &'a [u8]) -> Batch<'a> {
    Batch {
        positives: POSITIVES,
        states_k,
        positive_valid: valid,
        ..rows.batch()
    }
}

fn later(rows: &Rows) -> Vec<u8> {
    rows.frames.concat()
}

fn curl(rows: &Rows) -> Batch<'_> {
    Batch {
        anchors: Some(&rows.frames[1]),
        states_k: &rows.frames[2],
        ..rows.batch()
    }
}

#[test]
fn cpc_with_one_offset_is_dim() {
    let rows = Rows::random(7, 2);
    let one = agent(CPC, ALL_DIM).evaluate(&rows.batch());
    let dim = agent(DIM, ALL_DIM).evaluate(&rows.batch());
    let (one, dim) = (one.unwrap(), dim.unwrap());
    assert_eq!((one.losses.len(), dim.losses.len()), (4, 4));
    for ((cpc, a), (dim, b)) in one.losses.iter().zip(&dim.losses) {
        assert_eq!(cpc.strip_prefix("cpc_"), dim.strip_prefix("dim_"));
        assert!((a - b).abs() < 1e-5, "{cpc} {a} {b}");
    }
    assert!((one.total - dim.total).abs() < 1e-4);
}

#[test]
fn cpc_is_the_mean_over_its_offsets() {
    let rows = Rows::random(6, 3);
    let states_k = later(&rows);
    let valid = [[0, 1, 1, 1, 1, 1], [0, 1, 0, 1, 1, 0], [0, 0, 0, 1, 0, 0]].concat();
    let agent = agent(CPC, ALL_DIM);
    let all = agent.evaluate(&cpc(&rows, &states_k, &valid)).unwrap();
    let mut sums = [0.0; 4];
    for (frames, valid) in rows.frames.iter().zip(valid.chunks(6)) {
        let batch = Batch {
            positives: 1,
            states_k: frames,
            positive_valid: valid,
            ..rows.batch()
        };
        let one = agent.evaluate(&batch).unwrap();
        assert_eq!(one.losses.len(), 4);
        for (sum, (_, loss)) in sums.iter_mut().zip(one.losses) {
            *sum += loss;
        }
    }
    assert_eq!(all.losses.len(), 4);
    for ((_, loss), sum) in all.losses.iter().zip(sums) {
        assert!((loss - sum / 3.0).abs() < 1e-5, "{loss} {sum}");
    }
}

#[test]
fn positives_that_are_missing_change_nothing() {
    let rows = Rows::random(6, 4);
    let mut states_k = later(&rows);
    let valid = [[0, 1, 1, 1, 1, 1], [0, 1, 0, 1, 1, 1], [0, 0, 0, 1, 0, 1]].concat();
    let agent = agent(CPC, ALL_DIM);
    let before = agent.evaluate(&cpc(&rows, &states_k, &valid)).unwrap();
    let bytes = states_k.len() / valid.len();
    for at in (0..valid.len()).filter(|&at| valid[at] == 0) {
        states_k[at * bytes..(at + 1) * bytes].fill(99);
    }
    let after = agent.evaluate(&cpc(&rows, &states_k, &valid)).unwrap();
    assert_eq!((before.losses, before.total), (after.losses, after.total));
}

/// `states` without those that are not `there`.
fn packed(states: &[u8], there: &[bool]) -> Vec<u8> {
    let states = states.chunks_exact(states.len() / there.len());
    let present = states.zip(there).filter(|(_, there)| **there);
    present.flat_map(|(state, _)| state.to_vec()).collect()
}

#[test]
fn states_that_rows_do_not_have_may_be_left_out() {
    for (objective, lambda) in [(Objective::NONE, NO_DIM), (DIM, ALL_DIM), (CPC, ALL_DIM)] {
        let mut rows = Rows::random(6, 4);
        rows.bootstrap_discount = vec![0.9, 0.0, 0.9, 0.9, 0.0, 0.9];
        rows.positive_valid = vec![0, 1, 0, 1, 1, 1];
        let several = later(&rows);
        let valid = [[0, 1, 1, 1, 1, 1], [0, 1, 0, 1, 1, 1], [0, 0, 0, 1, 0, 1]].concat();
        let whole = if objective == CPC {
            cpc(&rows, &several, &valid)
        } else {
            rows.batch()
        };
        let there: Vec<_> = whole.positive_valid.iter().map(|it| *it != 0).collect();
        let states_k = packed(whole.states_k, &there);
        let there: Vec<_> = rows
            .bootstrap_discount
            .iter()
            .map(|it| *it != 0.0)
            .collect();
        let states_n = packed(whole.states_n, &there);
        let parts = Batch {
            states_k: &states_k,
            states_n: &states_n,
            ..whole
        };
        assert!(states_k.len() < whole.states_k.len() && states_n.len() < whole.states_n.len());
        let learned = [whole, parts].map(|batch| {
            let mut agent = agent(objective, lambda);
            let reports = [agent.update(&batch).unwrap(), agent.update(&batch).unwrap()];
            (reports, values(agent.online()))
        });
        assert!(learned[0] == learned[1], "{objective:?}");

        for (states_k, states_n, what) in [
            (&states_k[1..], &states_n[..], "states_k"),
            (&states_k, &states_n[1..], "states_n"),
        ] {
            let batch = Batch {
                states_k,
                states_n,
                ..whole
            };
            let error = agent(objective, lambda).evaluate(&batch).unwrap_err();
            assert!(error.to_string().contains(what), "{error}");
        }
    }
}

#[test]
fn without_any_positive_cpc_learns_the_return() {
    let rows = Rows::random(5, 5);
    let states_k = later(&rows);
    for there in 0..2 {
        let mut valid = [0; 5 * POSITIVES];
        valid[..there].fill(1);
        let mut agent = agent(CPC, GLOBAL);
        let report = agent.update(&cpc(&rows, &states_k, &valid)).unwrap();
        assert_eq!(report.losses, [("cpc_4t4", 0.0)]);
        assert_eq!(report.total, report.c51_kl);
    }
}

#[test]
fn cpc_and_curl_bring_their_losses_down() {
    let rows = Rows::random(16, 6);
    let (states_k, valid) = (later(&rows), [1; 16 * POSITIVES]);
    for (objective, batch) in [(CPC, cpc(&rows, &states_k, &valid)), (CURL, curl(&rows))] {
        let mut agent = agent(objective, GLOBAL);
        let first = only(&agent.update(&batch).unwrap().losses);
        for _ in 0..80 {
            agent.update(&batch).unwrap();
        }
        let last = only(&agent.update(&batch).unwrap().losses);
        assert!(last < 0.7 * first, "{objective:?}: {first} to {last}");
    }
}

#[test]
fn curl_compares_its_views_and_not_the_state() {
    let rows = Rows::random(8, 7);
    let agent = agent(CURL, GLOBAL);
    let loss = |batch: &Batch<'_>| only(&agent.evaluate(batch).unwrap().losses);
    let before = loss(&curl(&rows));
    let mut other = rows.clone();
    other.frames[0].fill(3);
    assert_eq!(loss(&curl(&other)), before, "s_t itself");
    // No row is masked: the end of an episode matters to neither view.
    other.positive_valid.fill(0);
    assert_eq!(loss(&curl(&other)), before, "positive_valid");
    other.frames[1].fill(3);
    assert_ne!(loss(&curl(&other)), before, "the query's view");
    let mut other = rows.clone();
    other.frames[2] = other.frames[1].clone();
    let batch = Batch {
        states_n: &rows.frames[2],
        ..curl(&other)
    };
    assert_ne!(loss(&batch), before, "the key's view");
}

type Values = BTreeMap<String, Vec<f32>>;

fn values(parameters: &Parameters) -> Values {
    let flat = |var: &candle_core::Var| var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let named = parameters.iter();
    named
        .map(|(name, var)| (name.to_owned(), flat(var)))
        .collect()
}

/// The part of `values` whose names pass `part`.
fn part_of(values: &Values, part: impl Fn(&str) -> bool) -> Values {
    let named = values.iter().filter(|(name, _)| part(name));
    named.map(|(name, v)| (name.clone(), v.clone())).collect()
}

#[test]
fn curl_s_key_encoder_is_a_moving_average_that_moves_at_every_update() {
    let rows = Rows::random(6, 8);
    let mut agent = agent(CURL, GLOBAL);
    let key = |agent: &Agent| values(agent.key().unwrap());
    let encoder = |name: &str| name.starts_with("torso.") || name.starts_with("dim.psi4.");
    let start = part_of(&values(agent.online()), encoder);
    assert_eq!(key(&agent), start, "torso and psi_4, and nothing else");
    let mut average = start.clone();
    // The target network moves once, at the third.
    for _ in 0..4 {
        agent.update(&curl(&rows)).unwrap();
        let online = values(agent.online());
        for (name, values) in &mut average {
            for (value, online) in values.iter_mut().zip(&online[name]) {
                *value =
                    (KEY_TAU * f64::from(*online) + (1.0 - KEY_TAU) * f64::from(*value)) as f32;
            }
        }
        for (name, found) in key(&agent) {
            for (found, wanted) in found.iter().zip(&average[&name]) {
                assert!((found - wanted).abs() < 1e-6, "{name}");
            }
        }
    }
    assert_ne!(average, start);
    // Actors get none of it.
    let acting = agent.model().without_dim();
    let weights = agent.weights().unwrap();
    let device = candle_core::Device::Cpu;
    Parameters::load_safetensors(&acting, &weights, &device).unwrap();
}

/// So that a comparison of agents compares the auxiliary loss alone.
#[test]
fn c51_s_target_network_is_the_same_for_every_agent() {
    let rows = Rows::random(6, 8);
    for (objective, lambda) in [
        (Objective::NONE, NO_DIM),
        (DIM, GLOBAL),
        (CPC, GLOBAL),
        (CURL, GLOBAL),
    ] {
        let mut agent = agent(objective, lambda);
        assert_eq!(agent.key().is_some(), objective == CURL);
        let online =
            |agent: &Agent| part_of(&values(agent.online()), |name| !name.starts_with("dim."));
        let start = online(&agent);
        assert_eq!(values(agent.target()), start, "{objective:?}");
        let batch = match objective.name() {
            "none" => Batch {
                positives: 0,
                states_k: &[],
                positive_valid: &[],
                ..rows.batch()
            },
            "curl" => curl(&rows),
            _ => rows.batch(),
        };
        for _ in 0..2 {
            agent.update(&batch).unwrap();
            assert_eq!(values(agent.target()), start, "its turn has not come");
        }
        agent.update(&batch).unwrap();
        let online = online(&agent);
        for (name, slow) in values(agent.target()) {
            for ((slow, online), start) in slow.iter().zip(&online[&name]).zip(&start[&name]) {
                assert!(
                    (slow - (0.95 * online + 0.05 * start)).abs() < 1e-6,
                    "{name}"
                );
            }
        }
    }
}

#[test]
fn a_target_network_that_moves_leaves_curl_s_keys_where_they_are() {
    let rows = Rows::random(8, 12);
    let loss = |target_tau| {
        let (model, mut settings) = of(CURL, GLOBAL);
        (settings.target_period_updates, settings.target_tau) = (1, target_tau);
        // So small a step that the key encoder stands still.
        settings.adam.lr = 1e-30;
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let mut parameters = Agent::new(model.clone(), settings.clone(), &Compute::CPU, rng)
            .map(|agent| NetworkParameters {
                online: agent.online().copy().unwrap(),
                target: agent.target().copy().unwrap(),
                key: agent.key().map(|key| key.copy().unwrap()),
            })
            .unwrap();
        // A target network of another seed.
        let rng = &mut ChaCha8Rng::seed_from_u64(2);
        parameters.target =
            Parameters::init(&model.without_dim(), rng, &Compute::CPU.device).unwrap();
        let mut agent = Agent::from_parameters(model, settings, &Compute::CPU, parameters).unwrap();
        let first = agent.update(&curl(&rows)).unwrap();
        let second = agent.update(&curl(&rows)).unwrap();
        assert_ne!(first.c51_kl, second.c51_kl, "the target network has moved");
        (first.losses, second.losses)
    };
    let (first, second) = loss(1.0);
    assert_eq!(first, second);
}

#[test]
fn batches_that_an_agent_cannot_use_are_refused() {
    let rows = Rows::random(5, 9);
    let (states_k, valid) = (later(&rows), [1; 5 * POSITIVES]);
    let said = |objective, batch: &Batch<'_>| {
        let error = agent(objective, GLOBAL).evaluate(batch).unwrap_err();
        assert!(matches!(error, UpdateError::Batch(_)));
        error.to_string()
    };
    let several = cpc(&rows, &states_k, &valid);
    assert!(said(DIM, &several).contains("3 positives a row; this agent needs one"));
    let plain = rows.batch();
    assert!(said(CURL, &plain).contains("needs two views of each state"));
    let short = Batch {
        positive_valid: &valid[1..],
        ..several
    };
    assert!(said(CPC, &short).contains("positive_valid"));
    let short = Batch {
        anchors: Some(&states_k[..8]),
        ..curl(&rows)
    };
    assert!(said(CURL, &short).contains("anchors"));
}

#[test]
fn objectives_at_odds_with_their_settings_are_refused() {
    let with = |objective, lambda, condition_on_action, key_tau: Option<f64>| LearnerSettings {
        objective,
        condition_on_action,
        own: curl_table(key_tau),
        ..settings(lambda)
    };
    let said = |objective, lambda, condition_on_action| {
        let settings = with(objective, lambda, condition_on_action, Some(0.1));
        settings.validate().unwrap_err().to_string()
    };
    assert!(said(Objective::NONE, GLOBAL, false).contains("but lambda.4t4 is above 0"));
    for objective in [DIM, CPC, CURL] {
        assert!(said(objective, NO_DIM, false).contains("but all lambdas are 0"));
    }
    assert!(said(CURL, ALL_DIM, false).contains("lambda.4t4 alone"));
    assert!(said(CURL, GLOBAL, true).contains("condition_on_action"));
    assert!(said(DIM, GLOBAL, true).contains("has no use for the table curl"));
    assert!(said(Objective::NONE, NO_DIM, true).contains("has no use for the table curl"));
    let curl = |key_tau| with(CURL, GLOBAL, false, key_tau).validate();
    let missing = curl(None).unwrap_err().to_string();
    assert!(
        missing.contains("--set learner.update.curl.key_tau="),
        "{missing}"
    );
    for out in [0.0, -0.1, 1.1, f64::NAN] {
        let said = curl(Some(out)).unwrap_err().to_string();
        assert!(said.starts_with(&format!("curl.key_tau = {out}")), "{said}");
    }
    curl(Some(1.0)).unwrap();
}

#[test]
fn a_psi_that_is_not_given_the_action_does_not_see_it() {
    let mut rows = Rows::random(6, 10);
    let agent = agent(DIM, ALL_DIM);
    assert!(!agent.model().dim.action);
    let before = agent.evaluate(&rows.batch()).unwrap().losses;
    rows.action.rotate_left(1);
    assert_eq!(agent.evaluate(&rows.batch()).unwrap().losses, before);
}

const STATE: usize = 20 * 24 * 2;

pub(crate) fn config(objective: Objective, augment: Option<AugmentSettings>) -> LearnerConfig {
    let (model, update) = of(objective, GLOBAL);
    let horizon = match objective.name() {
        "cpc" => Horizon::All { k_max: 3 },
        "dim" => Horizon::Fixed { k: 1 },
        _ => Horizon::None,
    };
    LearnerConfig {
        spec: RunSpec {
            world: "test".into(),
            agent: objective.name().into(),
            seed: 5,
            frame_height: 20,
            frame_width: 24,
            frame_channels: 2,
            frame_stack: 1,
            num_actions: 4,
            n_step: 3,
            gamma: 0.9,
            horizon,
            timeout: TimeoutRule::Terminal,
        },
        input: InputSize {
            height: model.height as u32,
            width: model.width as u32,
            frame: None,
        },
        model,
        learner: Config {
            equal_states: EqualStates::Once,
            precision: Default::default(),
            publish_as: Default::default(),
            batch_size: 6,
            batches_in_flight: 1,
            publish_period_updates: 2,
            checkpoint_period_updates: 2,
            checkpoints_kept: 1,
            unreachable_max_ms: 60_000,
            update,
            augment,
            affinity: AffinityConfig {
                estimator: EstimatorKind::None,
                alphabet: None,
                visible: None,
                learned: None,
                exact: None,
            },
        },
        sampling: Sampling::Uniform,
        transport: TransportConfig {
            shared_memory: false,
        },
    }
}

/// A batch as the replay server of this run would send it.
pub(crate) fn served(config: &LearnerConfig, seed: u64) -> WireBatch {
    served_with(config, seed, |_| {})
}

/// [`served`], with its rows changed.
fn served_with(config: &LearnerConfig, seed: u64, change: impl Fn(&mut [RowScalars])) -> WireBatch {
    let positives = config.spec.horizon.positives();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let row = |row: usize| RowScalars {
        action: (row % 4) as u8,
        next_action: 0,
        n_step_return: rng.random_range(-1.0..1.0),
        // The last one's episode ends.
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
        ..BatchHeader::of(&config.spec, 6)
    };
    let mut batch = WireBatch::of_rows(header, &rows, Buffer::zeroed);
    let mut places = batch.states_mut();
    for row in 0..6 {
        rng.fill(places.t(row));
        if let Some(place) = places.n(row) {
            rng.fill(place);
        }
        for p in 0..positives {
            if let Some(place) = places.k(p, row) {
                rng.fill(place);
            }
        }
    }
    batch
}

const STRONG: AugmentSettings = AugmentSettings {
    crop_side: 0.8,
    brightness: 0.4,
    contrast: 0.4,
    saturation: 0.4,
    hue: 0.4,
};
const NOTHING: AugmentSettings = AugmentSettings {
    crop_side: 1.0,
    brightness: 0.0,
    contrast: 0.0,
    saturation: 0.0,
    hue: 0.0,
};

#[test]
fn augmentation_of_no_strength_is_none_and_a_stronger_one_changes_dim_alone() {
    for objective in [DIM, CPC] {
        let report = |augment| {
            let config = config(objective, augment);
            let batch = served(&config, 1);
            Learner::new(config, &Compute::CPU)
                .unwrap()
                .update(&batch)
                .unwrap()
        };
        let (plain, identity, strong) = (report(None), report(Some(NOTHING)), report(Some(STRONG)));
        // The augmented states go through a pass of their own, so the sum of gradients may round otherwise.
        assert_eq!(
            (plain.c51_kl, &plain.losses),
            (identity.c51_kl, &identity.losses)
        );
        assert!((plain.grad_norm - identity.grad_norm).abs() < 1e-5 * plain.grad_norm);
        assert_eq!((plain.c51_kl, plain.q_mean), (strong.c51_kl, strong.q_mean));
        assert_ne!(plain.losses, strong.losses);
    }
}

/// The draws and the key encoder are part of a checkpoint: half a run and the other half are the run.
#[test]
fn an_augmenting_run_resumes_bit_for_bit() {
    for objective in [CURL, DIM] {
        let folder = std::env::temp_dir().join(format!(
            "driml-agents-{}-{}",
            objective.name(),
            std::process::id()
        ));
        let _ = fs::remove_dir_all(&folder);
        let config = config(objective, Some(STRONG));
        let learn = |learner: &mut Learner, updates: std::ops::Range<u64>| {
            for seed in updates {
                learner.update(&served(&config, seed)).unwrap();
            }
        };
        let mut straight = Learner::new(config.clone(), &Compute::CPU).unwrap();
        learn(&mut straight, 0..8);
        let mut half = Learner::new(config.clone(), &Compute::CPU).unwrap();
        learn(&mut half, 0..4);
        half.save(&folder).unwrap();
        let mut resumed = Learner::resume(config.clone(), &Compute::CPU, &folder).unwrap();
        assert_eq!(resumed.updates(), 4);
        learn(&mut resumed, 4..8);
        let (mut a, mut b) = (folder.join("a"), folder.join("b"));
        straight.save(&a).unwrap();
        resumed.save(&b).unwrap();
        let mut files = vec![
            "online.safetensors",
            "target.safetensors",
            "optimizer.safetensors",
        ];
        if objective == CURL {
            files.push("key.safetensors");
        }
        for file in files {
            let read = |folder: &mut std::path::PathBuf| {
                fs::read(folder.join("checkpoint-000000000008").join(file)).unwrap()
            };
            assert!(read(&mut a) == read(&mut b), "{objective:?}: {file}");
        }
        fs::remove_dir_all(&folder).unwrap();
    }
}

/// A checkpoint whose keys came from the target network is not this agent's.
#[test]
fn a_curl_checkpoint_without_a_key_encoder_is_refused() {
    let folder = Folder::new("old-curl");
    let config = config(CURL, Some(STRONG));
    let learner = Learner::new(config.clone(), &Compute::CPU).unwrap();
    learner.save(&folder.0).unwrap();
    let path = folder.0.join("checkpoint-000000000000");
    change_state(&path, |state| state["format"] = 1.into());
    let resume = || Learner::resume(config.clone(), &Compute::CPU, &folder.0).map(|_| ());
    let said = resume().unwrap_err().to_string();
    assert!(
        said.contains("keys came from the target network") && said.contains("begin anew"),
        "{said}"
    );
    // One of today's that lost the file is damaged.
    change_state(&path, |state| state["format"] = 2.into());
    resume().unwrap();
    fs::remove_file(path.join("key.safetensors")).unwrap();
    let said = resume().unwrap_err().to_string();
    assert!(
        said.contains("key.safetensors is damaged: it is missing"),
        "{said}"
    );
}

/// A refused batch leaves the generator where it was.
#[test]
fn a_refused_batch_draws_nothing() {
    let config = config(CURL, Some(STRONG));
    let good = served(&config, 1);
    let bad = served_with(&config, 2, |rows| rows[0].action = 77);
    let mut learner = Learner::new(config.clone(), &Compute::CPU).unwrap();
    assert!(learner.update(&bad).is_err());
    let after = learner.update(&good).unwrap();
    assert_eq!(
        after,
        Learner::new(config, &Compute::CPU)
            .unwrap()
            .update(&good)
            .unwrap()
    );
}

#[test]
fn augmentation_and_objective_belong_together() {
    let said = |objective, augment| {
        config(objective, augment)
            .learner
            .validate()
            .unwrap_err()
            .to_string()
    };
    assert!(said(CURL, None).contains("take the agent curl"));
    let mut c51 = config(DIM, Some(STRONG)).learner;
    c51.update.objective = Objective::NONE;
    assert!(
        c51.validate()
            .unwrap_err()
            .to_string()
            .contains("this agent has none")
    );
    let wild = AugmentSettings { hue: 0.7, ..STRONG };
    assert_eq!(
        said(DIM, Some(wild)),
        "learner.augment.hue = 0.7 cannot work: it must lie between 0 and 0.5, half a turn either way"
    );
    assert_eq!(
        config(CURL, Some(NOTHING)).model.dim,
        DimHeads {
            psi4: true,
            ..DimHeads::NONE
        }
    );
}

/// The chance of each row weights its C51 loss, at the beta of the update's number; nothing else, and the row's own loss comes back.
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
    let drawn = |chances: &[f32]| {
        let plain = served(&config, 1);
        let header = BatchHeader::of(&config.spec, 6).sampled_by(&sampling);
        let header = BatchHeader {
            origin: header.origin,
            ..plain.header
        };
        let (_, payload) = plain.into_payload();
        let mut more = Buffer::zeroed(header.payload_bytes());
        more[..payload.len()].copy_from_slice(&payload);
        for (row, chance) in chances.iter().enumerate() {
            let at = payload.len() + 6 * 8 + row * 4;
            more[at..at + 4].copy_from_slice(&chance.to_le_bytes());
        }
        WireBatch::from_payload(header, more).unwrap()
    };
    let learner = |config: &LearnerConfig| Learner::new(config.clone(), &Compute::CPU).unwrap();
    let plain = learner(&uniform).update(&served(&uniform, 1)).unwrap();
    assert!(plain.row_kls.is_empty());

    // Equal chances are a weight of 1 each.
    let mut equal = learner(&config);
    let report = equal.update(&drawn(&[0.25; 6])).unwrap();
    assert_eq!(report.losses, plain.losses);
    assert!((report.c51_kl - plain.c51_kl).abs() < 1e-6 * plain.c51_kl);
    assert!((report.grad_norm - plain.grad_norm).abs() < 1e-5 * plain.grad_norm);

    let mut learner = learner(&config);
    for beta in [0.5, 1.0, 1.0] {
        let report = learner.update(&drawn(&chances)).unwrap();
        let weighted = chances.iter().zip(&report.row_kls).map(|(chance, kl)| {
            let weight = (0.1 / f64::from(*chance)).powf(beta);
            weight * f64::from(*kl)
        });
        let mean = weighted.sum::<f64>() / 6.0;
        let error = f64::from(report.c51_kl) - mean;
        assert!(error.abs() < 1e-6 * mean, "beta {beta}: {error} of {mean}");
        let dim: f32 = report.losses.iter().map(|it| it.1).sum();
        assert!(
            (report.total - report.c51_kl - dim).abs() < 1e-5,
            "DIM is as it is"
        );
    }
    let rows = report.row_kls.iter().map(|kl| f64::from(*kl)).sum::<f64>();
    assert!((rows / 6.0 - f64::from(plain.c51_kl)).abs() < 1e-6 * f64::from(plain.c51_kl));
}
