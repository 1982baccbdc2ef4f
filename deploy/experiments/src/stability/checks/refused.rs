//! Values out of their ranges, each brought to where it would enter: settings to the resolver of a run, data to what receives it.

use candle_core::Device;
use driml_learner::{
    Batch, Compute, Kernels,
    optimiser::adam::{Adam, AdamSettings},
};
use driml_model::{Parameters, PolicyNetwork, Precision, StoredAs};
use driml_protocol::{AffinityUpdate, Chunk, End, InsertReply, TimeoutRule, codec};
use driml_replay_server::horizon::Affinity;

use super::{
    counters::insert_silently,
    optimiser::gradients,
    replay::{chunk, config, replay, spec},
};
use crate::stability::{
    property::{Cases, Listed, Property},
    small,
};

pub(super) const PROPERTIES: &[Property] = &[Property {
    routine: "values out of range",
    range: "every setting and every number that a process receives",
    promises: &[("values not refused by name", 0.0)],
    extremes: &[("settings", Listed, settings), ("data", Listed, data)],
}];

/// World, key and values of settings as `--set` takes them.
const SETTINGS: &str = r#"
chain learner.update.tanh_clip 0.0 1e-40 1e31 1e300
chain learner.update.max_grad_norm 0.0 1e-7 2e19
chain learner.update.target_tau 0.0 1e-6 1.000001
chain learner.update.target_period_updates 0
chain learner.update.adam.lr 0.0 1e-46 1e39
chain learner.update.adam.beta1 -0.1 1.0 0.999999999
chain learner.update.adam.beta2 -0.1 1.0 0.999999999
chain learner.update.adam.eps 0.0 1e-46 1e-30 1e39
chain model.v_min -1e31 -inf
chain model.v_max 1e31 inf -1.0
chain model.atoms 1 100000
chain learner.affinity.exact.smoothing 0.0 1e-320 1e306
chain learner.affinity.exact.decay 0.0 1.1
chain learner.affinity.learned.hidden 0 5000
chain learner.affinity.learned.beta1 -0.1 1.0
chain learner.affinity.learned.beta2 -0.1 1.0
chain learner.affinity.learned.eps 0.0 1e-320 inf
chain learner.affinity.learned.lr 0.0 1e300 inf
chain learner.affinity.learned.keep -0.1 1.0
chain run.gamma -0.1 1.1
chain run.n_step 0 1001
chain actor.epsilon_start -0.1 1.1
chain actor.epsilon_end -0.1 1.1
chain replay.replay_ratio 0.0 inf
chain learner.precision "f16"
chain learner.publish_dtype "f8"
chain learner.batch_size 0 100000
ising world.temperature 0.0 5.1 1e300
"#;

fn settings(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for line in SETTINGS.trim().lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let (world, key) = (words[0].parse()?, words[1]);
        let name = match key.rsplit_once('.') {
            Some((_, "temperature")) => "Ising temperature",
            Some((_, last)) => last,
            None => key,
        };
        let agent = match key.starts_with("learner.affinity") {
            true => "driml-ada",
            false => "driml-fix",
        };
        for value in &words[2..] {
            let mut sets = vec![format!("{key}={value}")];
            if key.starts_with("learner.affinity.exact") {
                sets.push("learner.affinity.estimator=exact".into());
            }
            let said = said(small::run(world, agent, sets));
            cases.keeps(
                0,
                format_args!("{key} = {value}: {said}"),
                said.contains(name),
            )?;
        }
    }
    Ok(())
}

fn data(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let data = batches()?.into_iter().chain(replays()?).chain(weights()?);
    for (name, said) in data {
        cases.keeps(0, format_args!("{name}: {said}"), said.contains(name))?;
    }
    Ok(())
}

/// The whole message; empty where the value was taken.
fn said<T, E: ToString>(result: Result<T, E>) -> String {
    result.err().map_or_else(String::new, |e| e.to_string())
}

/// The error, if any, for one row with this return and discount, by an agent on one pixel, all of whose weights are this.
fn evaluated(weight: f32, n_step_return: f32, discount: f32) -> anyhow::Result<String> {
    let settings = small::run("chain".parse()?, "c51", Vec::new())?
        .learner
        .update;
    let model = small::config(3, 4, (-1.0, 1.0));
    let weights = small::parameters(&model, &vec![weight; small::len(&model)])?;
    let agent = small::agent(&model, &settings, &Compute::CPU, &weights, &weights)?;
    Ok(said(agent.evaluate(&Batch {
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
    })))
}

/// The name that the error for a value must contain, and that error.
type Refusal = (&'static str, String);

/// Batches of one row, and logits beyond 3.4e38.
fn batches() -> anyhow::Result<Vec<Refusal>> {
    let each = [
        ("return inf", 0.1, f32::INFINITY, 0.9),
        ("return NaN", 0.1, f32::NAN, 0.9),
        ("discount NaN", 0.1, 0.0, f32::NAN),
        ("discount 1.1", 0.1, 0.0, 1.1),
        ("target network", 1e20, 0.0, 0.9),
    ];
    let each = each.into_iter();
    each.map(|(name, weight, sum, rest)| Ok((name, evaluated(weight, sum, rest)?)))
        .collect()
}

/// Rewards beyond 3.4e38 / n and infinite ones; an affinity that is not a probability.
fn replays() -> anyhow::Result<[Refusal; 3]> {
    let mut replay = replay(&spec(7, 0.99, TimeoutRule::Terminal), 1, &config(4096))?;
    let too_large = chunk(&[(1e38, End::Running); 10]);
    let inserted = match insert_silently(&mut replay, &too_large) {
        InsertReply::Refused { why } => why.to_string(),
        _ => String::new(),
    };
    let infinite = chunk(&[(f32::INFINITY, End::Running); 10]);
    let bytes = codec::encode(7, &infinite.header, infinite.payload())?;
    let received = Chunk::decode(&bytes, 7);
    let mut affinity = Affinity::uniform(1);
    let update = AffinityUpdate {
        learner: 1,
        version: 1,
        num_actions: 1,
        matrix: vec![1.000_000_1],
    };
    let updated = said(affinity.update(&update));
    Ok([
        ("reward", inserted),
        ("reward", said(received)),
        ("entry (0, 0) of the affinity", updated),
    ])
}

/// Gradients and weights that left the finite numbers or those of their type, in a step, on their way to a file, and in an actor.
fn weights() -> anyhow::Result<[Refusal; 8]> {
    let config = small::least();
    let len = small::len(&config);
    let with = |value: f32| {
        let mut values = vec![0.1; len];
        values[0] = value;
        values
    };
    let saved = |parameters: &Parameters, stored| parameters.to_safetensors_as(stored, |_| true);
    let slopes = gradients(&config, &with(f32::INFINITY))?.norm(Kernels::FUSED);
    let large = small::parameters(&config, &with(1e5))?;
    let larger = small::parameters(&config, &with(f32::MAX))?;
    // Adam as far as a learning rate within its range takes it.
    let far = AdamSettings {
        lr: 1e38,
        beta1: 0.0,
        beta2: 0.0,
        eps: 1e-15,
    };
    let stepped = small::parameters(&config, &vec![0.0; len])?;
    let mut adam = Adam::new(far, &stepped, Kernels::FUSED)?;
    let ones = gradients(&config, &vec![1.0; len])?;
    let steps = (0..8).try_for_each(|_| adam.step(&stepped, &ones, 1.0));
    // The file of finite weights, one of which is made infinite.
    let mut bytes = saved(&large, StoredAs::F32)?;
    let last = bytes.len() - 4;
    bytes[last..].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let loaded = Parameters::load_safetensors(&config, &bytes, &Device::Cpu);
    bytes[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    let acting = |precision| said(PolicyNetwork::new(&config, &bytes, precision));
    Ok([
        ("gradient of", said(slopes)),
        ("too large for F16", said(saved(&large, StoredAs::F16))),
        ("too large for Bf16", said(saved(&larger, StoredAs::Bf16))),
        ("beyond the finite numbers", said(steps)),
        ("inf", said(saved(&stepped, StoredAs::F32))),
        ("inf", said(loaded)),
        ("NaN", acting(Precision::F32)),
        ("NaN", acting(Precision::Bf16)),
    ])
}
