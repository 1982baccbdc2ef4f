//! Every number of the presets and where it comes from, a second time: a preset that changes a number must change it here
//! too, and say why. `chain` and `smoke` are left out: their numbers are this project's own, for tests.
//! That later layers win, and which games an `[[only]]` block names, is tested with `presets`.

use std::collections::BTreeMap;

use driml_envs::WorldName;
use toml::{Table, Value};

use super::{AGENTS, BASE, Layer, PRESETS, world_layer};
use crate::menu::comments;

/// A setting, its value as TOML, and words that its preset must have beside it; none for names.
///
/// "paper" is the appendix of Mazoure et al. 2020, most of it the table of parameters; "code" what its authors published; "ours"
/// neither.
type Pinned = (&'static str, &'static str, &'static str);

/// By layer; `only N:` stands before the settings of a layer's block that holds in some worlds.
#[rustfmt::skip]
const PINNED: &[(&str, &[Pinned])] = &[
    ("base", &[
        ("run.seed", "1", "ours"),
        ("run.n_step", "7", "paper"),
        ("run.gamma", "0.99", "paper"),
        ("run.timeout", r#""terminal""#, "code"),
        ("actor.steps_per_chunk", "16", "ours"),
        ("actor.round_transitions_max", "1024", "ours"),
        ("actor.chunks_in_flight_max", "4", "ours"),
        ("actor.actions", r#""all""#, "paper"),
        ("actor.precision", r#""f32""#, "ours"),
        ("actor.epsilon_start", "0.1", "paper"),
        ("actor.epsilon_end", "0.01", "paper"),
        ("actor.epsilon_decay_frames", "100000", "paper"),
        ("actor.ack_timeout_ms", "10000", "ours"),
        ("actor.unreachable_max_ms", "300000", "ours"),
        ("replay.capacity_transitions", "1000000", "paper"),
        ("replay.shards", "1", "ours"),
        ("replay.sampling.rule", r#""uniform""#, "paper"),
        ("replay.compression", r#""none""#, "ours"),
        ("replay.replay_ratio", "8.0", "code"),
        ("replay.warmup_transitions", "1000", "paper"),
        ("replay.slack_transitions", "256", "ours"),
        ("replay.transitions_max", "200000", "ours"),
        ("transport.shared_memory", "true", "ours"),
        ("learner.batch_size", "256", "code"),
        ("learner.precision", r#""f32""#, "ours"),
        ("learner.equal_states", r#""once""#, "ours"),
        ("learner.batches_in_flight", "2", "ours"),
        ("learner.publish_as", r#""f32""#, "ours"),
        ("learner.publish_period_updates", "8", "ours"),
        ("learner.checkpoint_period_updates", "1000", "ours"),
        ("learner.checkpoints_kept", "3", "ours"),
        ("learner.unreachable_max_ms", "300000", "ours"),
        ("learner.update.double_dqn", "false", "paper"),
        ("learner.update.tanh_clip", "20.0", "code"),
        ("learner.update.max_grad_norm", "10.0", "paper"),
        ("learner.update.target_period_updates", "312", "code"),
        ("learner.update.target_tau", "0.95", "paper"),
        ("learner.update.adam.lr", "0.00025", "paper"),
        ("learner.update.adam.beta1", "0.9", "code"),
        ("learner.update.adam.beta2", "0.999", "code"),
        ("learner.update.adam.eps", "3.90625e-05", "code"),
        ("model.conv", "[{ out = 32, kernel = 8, stride = 4 }, { out = 64, kernel = 4, stride = 2 }, { out = 64, kernel = 3, stride = 1 }]", "Mnih et al. 2015"),
        ("model.hidden", "512", "paper"),
        ("model.atoms", "51", "paper"),
        ("model.v_min", "-10.0", "Bellemare et al. 2017"),
        ("model.v_max", "10.0", "Bellemare et al. 2017"),
        ("model.rkhs", "512", "paper"),
        ("model.action_embed", "64", "paper"),
    ]),
    ("world/procgen", &[
        ("run.frame_stack", "1", "paper"),
        ("input.height", "64", "the engine's own"),
        ("input.width", "64", "the engine's own"),
        ("world.distribution_mode", r#""easy""#, "code"),
        ("world.num_levels", "500", "paper"),
        ("world.start_level", "0", "paper"),
        ("world.use_sequential_levels", "true", "code"),
        ("world.paint_vel_info", "true", "code"),
        ("world.use_backgrounds", "true", "Procgen's default"),
        ("world.center_agent", "true", "Procgen's default"),
        ("world.restrict_themes", "false", "Procgen's default"),
        ("world.frame_side", "64", "the engine's own"),
        ("world.grey", "false", "the engine's own"),
        ("learner.update.lambda.3t3", "0.0", "paper"),
        ("learner.update.lambda.3t4", "0.0", "paper"),
        ("learner.update.lambda.4t3", "0.0", "paper"),
        ("learner.update.lambda.4t4", "1.0", "paper"),
    ]),
    ("variant/exact", &[
        ("actor.precision", r#""f32""#, "ours"),
        ("learner.precision", r#""f32""#, "ours"),
        ("learner.publish_as", r#""f32""#, "ours"),
    ]),
    ("variant/balanced", &[
        ("actor.precision", r#""bf16""#, "prices.rs"),
        ("learner.precision", r#""f32""#, "ours"),
        ("learner.publish_as", r#""f16""#, "prices.rs"),
    ]),
    ("variant/fast", &[
        ("actor.precision", r#""bf16""#, "prices.rs"),
        ("learner.precision", r#""bf16""#, "prices.rs"),
        ("learner.publish_as", r#""f16""#, "prices.rs"),
    ]),
    ("world/mspacman", &[
        ("run.frame_stack", "4", "paper"),
        ("input.height", "84", "paper"),
        ("input.width", "84", "paper"),
        ("world.epsilon", "0.0", "paper"),
        ("world.switch_probability", "0.25", "ours"),
        ("world.lethal", "[true, true, true, true]", "paper"),
        ("world.boost_steps", "10", "paper"),
        ("world.step_limit", "500", "ours"),
        ("world.reward_pellet", "0.1", "ours"),
        ("world.reward_boost", "0.1", "ours"),
        ("world.reward_ghost", "0.5", "ours"),
        ("world.reward_death", "-1.0", "ours"),
        ("world.reward_cleared", "1.0", "ours"),
        ("learner.update.lambda.3t3", "1.0", "paper"),
        ("learner.update.lambda.3t4", "0.0", "paper"),
        ("learner.update.lambda.4t3", "0.0", "paper"),
        ("learner.update.lambda.4t4", "1.0", "paper"),
    ]),
    ("world/ising", &[
        ("run.frame_stack", "1", "paper"),
        ("input.height", "84", "paper"),
        ("input.width", "84", "paper"),
        ("world.lattice_size", "84", "paper"),
        ("world.patch_size", "42", "paper"),
        ("world.temperature", "0.4", "paper"),
        ("world.boundary", r#""periodic""#, "ours"),
        ("world.sweeps_per_step", "1", "ours"),
        ("world.episode_steps", "32", "ours"),
        ("learner.update.lambda.3t3", "1.0", "paper"),
        ("learner.update.lambda.3t4", "0.0", "paper"),
        ("learner.update.lambda.4t3", "0.0", "paper"),
        ("learner.update.lambda.4t4", "0.0", "paper"),
    ]),
    ("world/exec", &[
        ("run.frame_stack", "4", "Mnih et al. 2015"),
        ("world.start_timeout_ms", "120000", "ours"),
        ("world.step_timeout_ms", "60000", "ours"),
        ("learner.update.lambda.3t3", "0.0", "paper"),
        ("learner.update.lambda.3t4", "0.0", ""),
        ("learner.update.lambda.4t3", "0.0", ""),
        ("learner.update.lambda.4t4", "1.0", "paper"),
    ]),
    ("agent/c51", &[
        ("run.horizon.rule", r#""none""#, ""),
        ("learner.update.objective", r#""none""#, ""),
        ("learner.update.condition_on_action", "false", ""),
        ("learner.update.lambda.3t3", "0.0", ""),
        ("learner.update.lambda.3t4", "0.0", ""),
        ("learner.update.lambda.4t3", "0.0", ""),
        ("learner.update.lambda.4t4", "0.0", ""),
        ("learner.affinity.estimator", r#""none""#, ""),
    ]),
    ("agent/rainbow", &[
        ("run.horizon.rule", r#""none""#, ""),
        ("actor.epsilon_start", "0.0", "Hessel et al. 2018"),
        ("actor.epsilon_end", "0.0", "Hessel et al. 2018"),
        ("replay.sampling.rule", r#""prioritised""#, "Schaul et al. 2016"),
        ("replay.sampling.alpha", "0.5", "Hessel et al. 2018"),
        ("replay.sampling.beta_start", "0.4", "Hessel et al. 2018"),
        ("replay.sampling.beta_end", "1.0", "Hessel et al. 2018"),
        ("model.head.dueling", "true", "Wang et al. 2016"),
        ("model.head.noisy_sigma", "0.5", "Fortunato et al. 2018"),
        ("learner.update.double_dqn", "true", "van Hasselt et al. 2016"),
        ("learner.update.objective", r#""none""#, ""),
        ("learner.update.condition_on_action", "false", ""),
        ("learner.update.lambda.3t3", "0.0", ""),
        ("learner.update.lambda.3t4", "0.0", ""),
        ("learner.update.lambda.4t3", "0.0", ""),
        ("learner.update.lambda.4t4", "0.0", ""),
        ("learner.affinity.estimator", r#""none""#, ""),
    ]),
    ("agent/driml-fix", &[
        ("run.horizon.rule", r#""fixed""#, "paper"),
        ("run.horizon.k", "1", "paper"),
        ("learner.update.objective", r#""dim""#, ""),
        ("learner.update.condition_on_action", "true", "paper"),
        ("learner.affinity.estimator", r#""none""#, ""),
        ("only 0: run.horizon.rule", r#""fixed""#, "paper"),
        ("only 0: run.horizon.k", "5", "paper"),
        ("only 1: learner.augment.crop_side", "0.8", "paper"),
        ("only 1: learner.augment.brightness", "0.4", "paper"),
        ("only 1: learner.augment.contrast", "0.4", "paper"),
        ("only 1: learner.augment.saturation", "0.4", "paper"),
        ("only 1: learner.augment.hue", "0.4", "paper"),
    ]),
    ("agent/driml-ada", &[
        ("run.horizon.rule", r#""nhg""#, "paper"),
        ("run.horizon.k_max", "5", "paper"),
        ("learner.update.objective", r#""dim""#, ""),
        ("learner.update.condition_on_action", "true", "paper"),
        ("learner.affinity.estimator", r#""learned""#, "paper"),
        ("learner.affinity.alphabet", r#""raw""#, "code"),
        ("learner.affinity.learned.hidden", "32", "ours"),
        ("learner.affinity.learned.lr", "0.002", "ours"),
        ("learner.affinity.learned.beta1", "0.9", "PyTorch"),
        ("learner.affinity.learned.beta2", "0.999", "PyTorch"),
        ("learner.affinity.learned.eps", "1e-08", "PyTorch"),
        ("learner.affinity.learned.keep", "0.9", "code"),
        ("learner.affinity.exact.decay", "0.999", "ours"),
        ("learner.affinity.exact.smoothing", "1.0", "ours"),
    ]),
    ("agent/driml-randk", &[
        ("run.horizon.rule", r#""uniform""#, "paper"),
        ("run.horizon.k_max", "5", "paper"),
        ("learner.update.objective", r#""dim""#, ""),
        ("learner.update.condition_on_action", "true", "paper"),
        ("learner.affinity.estimator", r#""none""#, ""),
    ]),
    ("agent/driml-noact", &[
        ("run.horizon.rule", r#""fixed""#, "paper"),
        ("run.horizon.k", "1", "paper"),
        ("learner.update.objective", r#""dim""#, ""),
        ("learner.update.condition_on_action", "false", "paper"),
        ("learner.affinity.estimator", r#""none""#, ""),
        ("only 0: run.horizon.rule", r#""fixed""#, "paper"),
        ("only 0: run.horizon.k", "5", "paper"),
    ]),
    ("agent/cpc", &[
        ("run.horizon.rule", r#""all""#, "paper"),
        ("run.horizon.k_max", "5", "paper"),
        ("learner.update.objective", r#""cpc""#, ""),
        ("learner.update.condition_on_action", "false", "van den Oord et al. 2018"),
        ("learner.update.lambda.3t3", "0.0", "van den Oord et al. 2018"),
        ("learner.update.lambda.3t4", "0.0", ""),
        ("learner.update.lambda.4t3", "0.0", ""),
        ("learner.update.lambda.4t4", "1.0", "paper"),
        ("learner.affinity.estimator", r#""none""#, ""),
    ]),
    ("agent/curl", &[
        ("run.horizon.rule", r#""none""#, "Srinivas et al. 2020"),
        ("learner.update.objective", r#""curl""#, ""),
        ("learner.update.condition_on_action", "false", "Srinivas et al. 2020"),
        ("learner.update.lambda.3t3", "0.0", "a crop moves every location"),
        ("learner.update.lambda.3t4", "0.0", ""),
        ("learner.update.lambda.4t3", "0.0", ""),
        ("learner.update.lambda.4t4", "1.0", "Srinivas et al. 2020"),
        ("learner.update.curl.key_tau", "0.001", "Srinivas et al. 2020"),
        ("learner.augment.crop_side", "0.8", "paper"),
        ("learner.augment.brightness", "0.4", "paper"),
        ("learner.augment.contrast", "0.4", "paper"),
        ("learner.augment.saturation", "0.4", "paper"),
        ("learner.augment.hue", "0.4", "paper"),
        ("learner.affinity.estimator", r#""none""#, ""),
    ]),
    ("variant/paper-observation", &[
        ("input.height", "104", "paper"),
        ("input.width", "80", "paper"),
    ]),
    ("variant/tuned", &[
        ("actor.envs", "64", "tuned"),
        ("actor.epsilon_start", "1.0", "tuned"),
        ("actor.epsilon_end", "0.02", "tuned"),
        ("actor.epsilon_decay_frames", "250000", "tuned"),
        ("actor.precision", "\"auto\"", "ours"),
        ("replay.replay_ratio", "2.0", "tuned"),
        ("replay.transitions_max", "800000", "tuned"),
        ("learner.batch_size", "128", "tuned"),
        ("learner.precision", "\"auto\"", "ours"),
        ("learner.update.target_period_updates", "1", "tuned"),
        ("learner.update.target_tau", "0.01", "tuned"),
        ("learner.update.average_tau", "0.001", "tuned"),
        ("learner.update.adam.lr", "0.0005", "tuned"),
    ]),
    ("variant/split", &[
        ("world.use_sequential_levels", "false", "an episode ends with its level"),
    ]),
];

/// Layers of which nothing is pinned.
const OWN: [&str; 2] = ["world/chain", "variant/smoke"];

fn all_layers() -> BTreeMap<&'static str, Layer> {
    let agents = AGENTS.iter().map(|agent| agent.layer);
    // A command is no world's name; any one stands for all.
    let exec = "exec:true".parse().unwrap();
    let worlds = WorldName::all().chain([exec]).map(world_layer);
    let variants = PRESETS
        .iter()
        .flat_map(|preset| preset.layers.iter().copied());
    let all = agents.chain(worlds).chain(variants).chain([BASE]);
    all.map(|layer| (layer.name, layer)).collect()
}

/// The settings of a table with their dotted paths, after `before`.
fn leaves(table: &Table, before: &str, found: &mut BTreeMap<String, String>) {
    for (key, value) in table {
        match value {
            Value::Table(inner) => leaves(inner, &format!("{before}{key}."), found),
            other => {
                found.insert(format!("{before}{key}"), other.to_string());
            }
        }
    }
}

/// A number as it was written, or as TOML writes it: the same for the same number.
fn canonical(value: &str) -> String {
    let table: Table = format!("it = {value}").parse().unwrap();
    table["it"].to_string()
}

#[test]
fn every_number_is_the_one_that_its_source_has() {
    let layers = all_layers();
    let names: Vec<_> = PINNED.iter().map(|(name, _)| *name).chain(OWN).collect();
    assert!(
        layers.keys().all(|name| names.contains(name)),
        "{:?}",
        layers.keys()
    );
    for (name, pinned) in PINNED {
        let (everywhere, blocks) = layers[name].read();
        let mut found = BTreeMap::new();
        leaves(&everywhere, "", &mut found);
        for (number, block) in blocks.iter().enumerate() {
            leaves(&block.set, &format!("only {number}: "), &mut found);
        }
        let pinned: BTreeMap<_, _> = pinned
            .iter()
            .map(|(key, value, _)| ((*key).to_owned(), canonical(value)))
            .collect();
        assert_eq!(found, pinned, "{name}");
    }
}

#[test]
fn every_number_has_its_source_beside_it() {
    let layers = all_layers();
    for (name, pinned) in PINNED {
        let parts: Vec<_> = layers[name].text.split("[[only]]").map(comments).collect();
        for (key, _, source) in *pinned {
            let (part, path) = match key.strip_prefix("only ") {
                None => (0, (*key).to_owned()),
                Some(rest) => {
                    let (number, path) = rest.split_once(": ").unwrap();
                    (number.parse::<usize>().unwrap() + 1, format!("set.{path}"))
                }
            };
            // A table on one line has one comment.
            let around = |known: &str| path == known || path.starts_with(&format!("{known}."));
            let comment = parts[part].iter().find(|(known, _)| around(known));
            let comment = comment.map_or("", |(_, comment)| comment);
            assert!(
                comment.contains(source),
                "{name}: {key}: {comment:?} does not say {source:?}"
            );
        }
    }
}
