//! Values out of their ranges, each brought to where it would enter: settings to the resolver of a run, data to who receives it.

use candle_core::Device;
use driml_envs::WorldName;
use driml_learner::{
    Agent, Batch, Compute, Kernels, LearnerSettings,
    optimiser::adam::{Adam, AdamSettings},
};
use driml_machine::resources::Machine;
use driml_model::{ModelConfig, Parameters, PolicyNetwork, Precision, StoredAs};
use driml_protocol::{AffinityUpdate, Chunk, End, InsertReply, TimeoutRule};
use driml_replay_server::horizon::Affinity;
use driml_settings::{
    presets,
    resolve::{Flags, Source, resolve},
};

use super::{
    gradients::gradients,
    replays::{chunk, replay, spec},
};
use crate::stability::{check::Refusal, small};

/// Settings as `--set` takes them: the last part of the key is the name that the refusal must have.
const SETTINGS: [(&str, &str, &[&str]); 28] = [
    (
        "chain",
        "learner.update.tanh_clip",
        &["0.0", "1e-40", "1e31", "1e300"],
    ),
    (
        "chain",
        "learner.update.max_grad_norm",
        &["0.0", "1e-7", "2e19"],
    ),
    (
        "chain",
        "learner.update.target_tau",
        &["0.0", "1e-6", "1.000001"],
    ),
    ("chain", "learner.update.adam.lr", &["0.0", "1e-46", "1e39"]),
    (
        "chain",
        "learner.update.adam.beta1",
        &["-0.1", "1.0", "0.999999999"],
    ),
    (
        "chain",
        "learner.update.adam.beta2",
        &["-0.1", "1.0", "0.999999999"],
    ),
    (
        "chain",
        "learner.update.adam.eps",
        &["0.0", "1e-46", "1e-30", "1e39"],
    ),
    ("chain", "model.v_min", &["-1e31", "-inf"]),
    ("chain", "model.v_max", &["1e31", "inf", "-1.0"]),
    ("chain", "model.atoms", &["1", "100000"]),
    (
        "chain",
        "learner.affinity.exact.smoothing",
        &["0.0", "1e-320", "1e306"],
    ),
    ("chain", "learner.affinity.exact.decay", &["0.0", "1.1"]),
    ("chain", "learner.affinity.learned.hidden", &["0", "5000"]),
    ("chain", "learner.affinity.learned.beta1", &["-0.1", "1.0"]),
    ("chain", "learner.affinity.learned.beta2", &["-0.1", "1.0"]),
    (
        "chain",
        "learner.affinity.learned.eps",
        &["0.0", "1e-320", "inf"],
    ),
    (
        "chain",
        "learner.affinity.learned.lr",
        &["0.0", "1e300", "inf"],
    ),
    ("chain", "learner.affinity.learned.keep", &["-0.1", "1.0"]),
    ("chain", "run.gamma", &["-0.1", "1.1"]),
    ("chain", "run.n_step", &["0", "1001"]),
    ("chain", "actor.epsilon_start", &["-0.1", "1.1"]),
    ("chain", "actor.epsilon_end", &["-0.1", "1.1"]),
    ("chain", "replay.replay_ratio", &["0.0", "inf"]),
    ("chain", "learner.precision", &["\"f16\""]),
    ("chain", "learner.publish_as", &["\"f8\""]),
    ("ising", "world.temperature", &["0.0", "5.1", "1e300"]),
    ("chain", "learner.batch_size", &["0", "100000"]),
    ("chain", "learner.update.target_period_updates", &["0"]),
];

/// What the name of a setting is called where its refusal has other words for it.
const CALLED: [(&str, &str); 1] = [("world.temperature", "Ising temperature")];

pub(crate) fn check() -> anyhow::Result<Vec<Refusal>> {
    let mut all = Vec::new();
    for (world, key, values) in SETTINGS {
        for value in values {
            all.push(setting(world, key, value));
        }
    }
    all.extend(data()?);
    Ok(all)
}

fn setting(world: &str, key: &str, value: &str) -> Refusal {
    let world: WorldName = world.parse().expect("it is in the registry of worlds");
    let agent = match key.starts_with("learner.affinity") {
        true => "driml-ada",
        false => "driml-fix",
    };
    let mut sets = vec![format!("{key}={value}")];
    if key.starts_with("learner.affinity.exact") {
        sets.push("learner.affinity.estimator=exact".into());
    }
    let flags = Flags {
        sets,
        ..Flags::default()
    };
    let source = Source::Layers(&presets::PRESETS[0], world, agent);
    let said = resolve(&source, &flags, &Machine::this()).err();
    let name = key.rsplit('.').next().unwrap_or(key);
    let called = CALLED.iter().find(|(own, _)| *own == key);
    Refusal {
        name: called.map_or(name, |(_, called)| called).to_owned(),
        value: format!("{key} = {value}"),
        said: said.map(|e| e.to_string()),
    }
}

fn refusal<T, E: ToString>(name: &str, value: &str, result: Result<T, E>) -> Refusal {
    Refusal {
        name: name.to_owned(),
        value: value.to_owned(),
        said: result.err().map(|e| e.to_string()),
    }
}

/// An agent on one pixel, all of whose weights are this.
fn agent(weight: f32) -> anyhow::Result<Agent> {
    let world: WorldName = "chain".parse()?;
    let source = Source::Layers(&presets::PRESETS[0], world, "c51");
    let config = resolve(&source, &Flags::default(), &Machine::this())?;
    let settings: LearnerSettings = config.learner.update;
    let model: ModelConfig = small::config(3, 4, (-1.0, 1.0));
    let online = small::parameters(&model, &vec![weight; small::len(&model)])?;
    let parameters = driml_learner::NetworkParameters {
        target: online.copy()?,
        key: None,
        online,
    };
    Ok(Agent::from_parameters(
        model,
        settings,
        &Compute::CPU,
        parameters,
    )?)
}

/// One row of a batch with this return and discount.
fn evaluate(weight: f32, n_step_return: f32, discount: f32) -> anyhow::Result<()> {
    agent(weight)?.evaluate(&Batch {
        rows: 1,
        states_t: &[255],
        anchors: None,
        positives: 0,
        states_k: &[],
        states_n: &[255],
        action: &[0],
        next_action: &[0],
        n_step_return: &[n_step_return],
        bootstrap_discount: &[discount],
        positive_valid: &[],
        importance_weight: None,
    })?;
    Ok(())
}

fn data() -> anyhow::Result<Vec<Refusal>> {
    let spec = spec(7, 0.99, TimeoutRule::Terminal);
    let too_large = chunk(&[(1e38, End::Running); 10]);
    let mut replay = replay(&spec, 1)?;
    // What the replay server logs of it would look like a fault.
    let silence = tracing::subscriber::NoSubscriber::default();
    let inserted = tracing::subscriber::with_default(silence, || replay.insert(&too_large));
    let inserted = match inserted {
        InsertReply::Refused { why } => Err(why),
        _ => Ok(()),
    };
    let infinite = chunk(&[(f32::INFINITY, End::Running); 10]);
    let (header, payload) = infinite.seal(7)?;
    let received = Chunk::decode(&[header.as_slice(), payload].concat(), 7, 2);
    let update = AffinityUpdate {
        learner: 1,
        version: 1,
        num_actions: 1,
        matrix: vec![1.000_000_1],
    };
    let config = small::least();
    let len = small::len(&config);
    let with = |value: f32| {
        let mut values = vec![0.1; len];
        values[0] = value;
        values
    };
    let slopes = gradients(&config, &with(f32::INFINITY))?.norm(Kernels::FUSED);
    let large = small::parameters(&config, &with(1e5))?;
    let larger = small::parameters(&config, &with(f32::MAX))?;
    let weights = |parameters: &Parameters, stored| parameters.to_safetensors_as(stored, |_| true);
    // Adam as far as a learning rate within its range takes it.
    let far = AdamSettings {
        lr: 1e38,
        beta1: 0.0,
        beta2: 0.0,
        eps: 1e-15,
    };
    let parameters = small::parameters(&config, &vec![0.0; len])?;
    let mut adam = Adam::new(far, &parameters, Kernels::FUSED)?;
    let mut step = Ok(());
    for _ in 0..8 {
        step = adam.step(&parameters, &gradients(&config, &vec![1.0; len])?, 1.0);
        if step.is_err() {
            break;
        }
    }
    // What left the finite numbers is neither saved nor sent.
    let left = weights(&parameters, StoredAs::F32);
    // The file of finite weights, one of which is made infinite.
    let mut bytes = weights(&large, StoredAs::F32)?;
    let last = bytes.len() - 4;
    bytes[last..].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let loaded = Parameters::load_safetensors(&config, &bytes, &Device::Cpu);
    bytes[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    let acting = Precision::ALL.map(|precision| PolicyNetwork::new(&config, &bytes, precision));
    let [acting_f32, acting_bf16] = acting;
    Ok(vec![
        refusal(
            "reward",
            "a reward of 1e38 in a run of 7-step returns",
            inserted,
        ),
        refusal("reward", "an infinite reward in a chunk", received),
        refusal(
            "entry (0, 0) of the affinity",
            "an affinity of 1.0000001",
            Affinity::uniform(1).update(&update),
        ),
        refusal(
            "return inf",
            "an infinite return in a batch",
            evaluate(0.1, f32::INFINITY, 0.9),
        ),
        refusal(
            "return NaN",
            "a return that is no number, in a batch",
            evaluate(0.1, f32::NAN, 0.9),
        ),
        refusal(
            "discount NaN",
            "a discount that is no number, in a batch",
            evaluate(0.1, 0.0, f32::NAN),
        ),
        refusal(
            "discount 1.1",
            "a discount of 1.1 in a batch",
            evaluate(0.1, 0.0, 1.1),
        ),
        refusal(
            "target network",
            "logits beyond 3.4e38, from weights of 1e20",
            evaluate(1e20, 0.0, 0.9),
        ),
        refusal("gradient of", "an infinite gradient", slopes),
        refusal(
            "too large for F16",
            "a weight of 1e5, published as f16",
            weights(&large, StoredAs::F16),
        ),
        refusal(
            "too large for Bf16",
            "a weight of 3.4e38, published as bf16",
            weights(&larger, StoredAs::Bf16),
        ),
        refusal("beyond the finite numbers", "steps of 1e38 (adam.lr)", step),
        refusal(
            "inf",
            "weights that such steps left, on their way to a file",
            left,
        ),
        refusal("inf", "an infinite weight in a file", loaded),
        refusal("NaN", "a weight that is no number, in an actor", acting_f32),
        refusal(
            "NaN",
            "a weight that is no number, in an actor that computes in bf16",
            acting_bf16,
        ),
    ])
}
