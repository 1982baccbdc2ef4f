//! The rows of the table: parameters, FLOPs and bytes, of a configuration and of the same with everything on.
//! What a layer or an update costs is counted in the crates of the model and the learner.

use driml_learner::cost::{UpdateCost, UpdateShape};
use driml_model::{LayerCost, ModelConfig, StoredAs};
use driml_protocol::{BatchHeader, Horizon, RunSpec, TRANSITION_BYTES};
use driml_settings::{config::RunConfig, memory::replay_bytes_each};
use serde::Serialize;

use super::everything::Everything;

/// The row of a whole batch.
pub(super) const BATCH: &str = "a batch";

/// One row of the table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Line {
    /// What is counted.
    pub what: String,
    /// How much of it the configuration has.
    pub is: u64,
    /// How much it would have with everything on.
    pub everything: u64,
}

fn line(what: impl Into<String>, [is, everything]: [u64; 2]) -> Line {
    Line {
        what: what.into(),
        is,
        everything,
    }
}

fn sum(layers: &[LayerCost], part: &str, cost: fn(&LayerCost) -> u64) -> u64 {
    let of_part = layers.iter().filter(|layer| layer.is_of(part));
    of_part.map(cost).sum()
}

/// The units in which layers are shown: a residual block is one, and so is C51's head, of one layer or two.
fn units(model: &ModelConfig) -> Vec<String> {
    let mut units: Vec<String> = Vec::new();
    for layer in model.layer_costs() {
        let unit = match layer.name.split('.').collect::<Vec<_>>()[..] {
            ["dim", block, _] => format!("dim.{block}"),
            ["head", ..] => "head".to_owned(),
            _ => layer.name,
        };
        if units.last() != Some(&unit) {
            units.push(unit);
        }
    }
    units
}

fn shape_of(config: &RunConfig) -> UpdateShape {
    UpdateShape::of(&config.learner, config.run.horizon.positives())
}

/// Scalars of all networks that the learner holds.
pub(super) fn parameters(config: &RunConfig, every: &Everything) -> Vec<Line> {
    let models = [&config.model, &every.model].map(ModelConfig::layer_costs);
    let scalars = |parts: &[&str]| {
        let of = |layers: &Vec<LayerCost>| {
            let each = parts
                .iter()
                .map(|part| sum(layers, part, |layer| layer.parameters));
            each.sum()
        };
        models.each_ref().map(of)
    };
    let units = units(&every.model).into_iter();
    let mut lines: Vec<_> = units
        .map(|unit| line(unit.as_str(), scalars(&[&unit])))
        .collect();
    lines.push(line("target network", scalars(&["torso", "head"])));
    let [is, everything] = scalars(&["torso", "dim.psi4"]);
    let has_key = shape_of(config).passes.keys > 0;
    let is = if has_key { is } else { 0 };
    lines.push(line("key encoder", [is, everything]));
    lines
}

/// Arithmetic of one decision of an actor, where the network takes it and not chance.
pub(super) fn decision_flops(config: &RunConfig, every: &Everything) -> Vec<Line> {
    let models = [&config.model, &every.model].map(ModelConfig::without_dim);
    let layers = models.each_ref().map(ModelConfig::layer_costs);
    let forward = |part: &str| {
        layers
            .each_ref()
            .map(|it| sum(it, part, |layer| layer.forward))
    };
    let units = units(&models[0]).into_iter();
    units
        .map(|unit| line(unit.as_str(), forward(&unit)))
        .collect()
}

/// Arithmetic of one update.
pub(super) fn update_flops(config: &RunConfig, every: &Everything) -> Vec<Line> {
    let is = UpdateCost::of(&config.model, &shape_of(config));
    let all = UpdateCost::of(&every.model, &every.shape);
    vec![
        line("s_t, torso", [is.online, all.online]),
        line("s_t, C51 head", [is.head, all.head]),
        line("s_{t+n}, target network", [is.target, all.target]),
        line("s_{t+n}, online network", [is.double_dqn, all.double_dqn]),
        line("more states, torso", [is.states, all.states]),
        line("states, key encoder", [is.keys, all.keys]),
        line("psi and phi", [is.heads, all.heads]),
        line("scores", [is.scores, all.scores]),
    ]
}

/// Bytes of a transition, a batch whose rows have every state, and a broadcast. Compression and the socket's own are not counted.
pub(super) fn bytes(config: &RunConfig, every: &Everything) -> driml_model::Result<Vec<Line>> {
    let header = |run: &RunSpec| {
        BatchHeader::of(run, config.learner.batch_size).sampled_by(&config.replay.sampling)
    };
    let batch = |run: &RunSpec| header(run).payload_bytes() as u64;
    let numbers = |run: &RunSpec| {
        let without_states = BatchHeader {
            state_bytes: 0,
            stacked: None,
            ..header(run)
        };
        without_states.payload_bytes() as u64
    };
    let states = |run: &RunSpec| batch(run) - numbers(run);
    let first_states = |run: &RunSpec| {
        states(&RunSpec {
            horizon: Horizon::None,
            ..run.clone()
        })
    };
    let later_states = |run: &RunSpec| states(run) - first_states(run);
    let transition = |run: &RunSpec| (run.frame_bytes() + TRANSITION_BYTES) as u64;
    let of = |what: &str, count: &dyn Fn(&RunSpec) -> u64| {
        line(what, [&config.run, &every.run].map(count))
    };
    let broadcast = [
        config.weights_bytes()?,
        every.model.weights_bytes(StoredAs::F32)?,
    ];
    Ok(vec![
        of("a transition in a chunk", &transition),
        of("a transition in the replay", &replay_bytes_each),
        of(BATCH, &batch),
        of("  s_t and s_{t+n}", &first_states),
        of("  s_{t+k}", &later_states),
        of("  numbers", &numbers),
        line("a broadcast", broadcast.map(|bytes| bytes as u64)),
    ])
}
