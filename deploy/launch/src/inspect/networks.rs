//! The networks: scalars of their layers, why each is there, and the arithmetic of one decision.
//! What an update does with them is in `update`.

use driml_actor::Schedule;
use driml_learner::{auxiliary::settings::PAIRS, cost::UpdateShape};
use driml_model::{DimHeads, LayerCost, ModelConfig};
use driml_settings::config::RunConfig;

use super::{everything::Everything, line::Line};

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

/// Scalars of all networks that the learner holds.
pub(super) fn parameters(config: &RunConfig, every: &Everything) -> Vec<Line> {
    let (layers, all) = (config.model.layer_costs(), every.model.layer_costs());
    let scalars = |layers: &[LayerCost], part: &str| sum(layers, part, |layer| layer.parameters);
    let unit = |name: String| {
        let (is, everything) = (scalars(&layers, &name), scalars(&all, &name));
        let why = why_layer(config, &name);
        Line::new(name, is, everything, why)
    };
    let mut lines: Vec<Line> = units(&every.model).into_iter().map(unit).collect();
    let value = |layers| scalars(layers, "torso") + scalars(layers, "head");
    lines.push(Line::new(
        "target network",
        value(&layers),
        value(&all),
        "torso and head again: s_{t+n} is judged by weights that stand still",
    ));
    let shape = UpdateShape::of(&config.learner, config.run.horizon.positives());
    let key = |layers| scalars(layers, "torso") + scalars(layers, "dim.psi4");
    lines.push(if shape.passes.keys > 0 {
        Line::new(
            "key encoder",
            key(&layers),
            key(&all),
            "the objective compares with a moving average of torso and psi4",
        )
    } else {
        let why = "not built: the objective has no key encoder, only curl has";
        Line::new("key encoder", 0, key(&all), why)
    });
    lines
}

fn why_layer(config: &RunConfig, name: &str) -> String {
    let model = &config.model;
    let update = &config.learner.update;
    let (wanted, heads) = (update.lambda.wanted(), model.dim);
    let pairs = |of: [usize; 2]| {
        let on: Vec<_> = of.iter().filter(|&&pair| wanted[pair]).collect();
        if on.is_empty() {
            let [a, b] = of.map(|pair| PAIRS[pair]);
            format!("not built: lambda {a} and {b} are 0")
        } else {
            let on: Vec<_> = on.into_iter().map(|&pair| PAIRS[pair]).collect();
            format!("lambda {} above 0", on.join(" and "))
        }
    };
    let objective = update.objective.name();
    let of_pairs = |exists: bool, of: [usize; 2]| match (exists, pairs(of)) {
        (false, why) if !why.starts_with("not") => {
            format!("not built: {objective} has no use for it")
        }
        (_, why) => why,
    };
    match name {
        "torso.fc" => format!("f4, {} numbers of the last map", model.hidden),
        "head" => {
            let all = config.world.num_actions();
            let of = if model.num_actions == all {
                String::new()
            } else {
                format!(" of {all} (actor.actions)")
            };
            let (actions, atoms) = (model.num_actions, model.atoms);
            let what = match model.head.dueling {
                true => "the state's value, and the advantage of ",
                false => "",
            };
            let noisy = match model.head.noisy_sigma {
                Some(_) => "; noisy: a scale beside each mean",
                None => "",
            };
            format!("C51: {what}{actions} actions{of}, {atoms} atoms each{noisy}")
        }
        "dim.action" if heads.embeds_action() => "psi is given a_t (condition_on_action)".into(),
        "dim.action" if heads == DimHeads::NONE => "not built: there is no psi".into(),
        "dim.action" if model.num_actions == 1 => "not built: there is one action".into(),
        "dim.action" => "not built: psi is not given a_t (condition_on_action)".into(),
        "dim.psi3" => of_pairs(heads.psi3, [0, 1]),
        "dim.phi3" => of_pairs(heads.phi3, [0, 2]),
        "dim.psi4" => of_pairs(heads.psi4, [2, 3]),
        "dim.phi4" => of_pairs(heads.phi4, [1, 3]),
        conv => {
            let number = conv
                .strip_prefix("torso.conv")
                .and_then(|it| it.parse().ok());
            let shape = number.and_then(|n: usize| model.conv_shapes().into_iter().nth(n - 1));
            shape.map_or_else(String::new, |it| {
                format!(
                    "{}x{}x{} to {}x{}x{}, kernel {}, stride {}",
                    it.height,
                    it.width,
                    it.channels_in,
                    it.out_height(),
                    it.out_width(),
                    it.channels_out,
                    it.kernel,
                    it.stride
                )
            })
        }
    }
}

/// Share of all decisions that the network takes, of the others chance does; of the first actor, over the frames of the run.
fn decided_share(config: &RunConfig) -> f64 {
    const POINTS: u64 = 1000;
    let Ok(schedule) = Schedule::new(&config.actor, 0) else {
        return 1.0;
    };
    // Half a step in, where a falling epsilon has its mean.
    let frames =
        (0..POINTS).map(|i| (2 * i + 1) as f64 / (2 * POINTS) as f64 * config.frames() as f64);
    let random: f64 = frames.map(|frames| schedule.epsilon(frames as u64)).sum();
    1.0 - random / POINTS as f64
}

/// Arithmetic of one decision of an actor.
pub(super) fn decision_flops(config: &RunConfig, every: &Everything) -> Vec<Line> {
    let layers = config.model.without_dim().layer_costs();
    let all = every.model.without_dim().layer_costs();
    let forward = |layers: &[LayerCost], part: &str| sum(layers, part, |layer| layer.forward);
    let share = 100.0 * decided_share(config);
    let lines = units(&config.model.without_dim()).into_iter().map(|name| {
        let why = match name.as_str() {
            "head" => "Q of every action, of which the largest is taken".into(),
            "torso.conv1" => {
                format!("for {share:.1}% of states; in the others chance decides (epsilon)")
            }
            _ => String::new(),
        };
        let (is, everything) = (forward(&layers, &name), forward(&all, &name));
        Line::new(name, is, everything, why)
    });
    lines.collect()
}
