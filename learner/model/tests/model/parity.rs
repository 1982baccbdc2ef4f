//! Expected returns against the parity cases, which another framework computed in f64.
//! Losses, gradients and updates of the same cases are the learner's tests.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use driml_model::{
    ConvLayer, DimHeads, HeadConfig, ModelConfig, Network, Parameters, PolicyNetwork, Precision,
};
use serde_json::Value;

use crate::support::values;

fn cases() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/parity");
    let entries = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    entries
        .filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "safetensors")
        })
        .collect()
}

fn config(bytes: &[u8]) -> ModelConfig {
    let (_, metadata) = safetensors::SafeTensors::read_metadata(bytes).unwrap();
    let json: Value =
        serde_json::from_str(&metadata.metadata().as_ref().unwrap()["config"]).unwrap();
    let size = |value: &Value| usize::try_from(value.as_u64().unwrap()).unwrap();
    let (obs, model) = (&json["obs"], &json["model"]);
    let layer = |layer: &Value| ConvLayer {
        out: size(&layer[0]),
        kernel: size(&layer[1]),
        stride: size(&layer[2]),
    };
    ModelConfig {
        height: size(&obs["height"]),
        width: size(&obs["width"]),
        channels: size(&obs["channels"]),
        num_actions: size(&json["actions"]),
        atoms: size(&json["atoms"]),
        v_min: json["v_min"].as_f64().unwrap() as f32,
        v_max: json["v_max"].as_f64().unwrap() as f32,
        conv: model["conv"]
            .as_array()
            .unwrap()
            .iter()
            .map(layer)
            .collect(),
        hidden: size(&model["hidden"]),
        rkhs: size(&model["rkhs"]),
        action_embed: size(&model["action_embed"]),
        // What the cases have of heads differs; expected returns need none.
        dim: DimHeads::NONE,
        head: json.get("head").map_or(HeadConfig::PLAIN, |head| {
            serde_json::from_value(head.clone()).unwrap()
        }),
    }
}

fn online(tensors: &HashMap<String, Tensor>) -> HashMap<String, Tensor> {
    let named = |(name, tensor): (&String, &Tensor)| {
        name.strip_prefix("online.")
            .filter(|name| !name.starts_with("dim."))
            .map(|name| (name.to_owned(), tensor.clone()))
    };
    tensors.iter().filter_map(named).collect()
}

#[test]
fn expected_returns_match_every_case() {
    let cases = cases();
    assert!(!cases.is_empty());
    for path in cases {
        let bytes = std::fs::read(&path).unwrap();
        let config = config(&bytes);
        let tensors = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu).unwrap();
        let parameters = Parameters::from_tensors(&config, online(&tensors), &Device::Cpu).unwrap();
        let network = Network::new(&config, &parameters).unwrap();
        let frames = &tensors["input.frames_t"];
        let logits = network
            .logits(&network.features(frames).unwrap().f4)
            .unwrap();
        let wanted = values(&tensors["expect.q_values_t"]);
        let scale = wanted
            .iter()
            .fold(1.0f64, |scale, value| scale.max(value.abs()));
        let check = |what: &str, found: &[f64]| {
            assert_eq!(found.len(), wanted.len());
            for (found, wanted) in found.iter().zip(&wanted) {
                let error = (found - wanted).abs();
                assert!(
                    error < 2e-6 * scale,
                    "{what}, {}: {found}, wanted {wanted}",
                    path.display()
                );
            }
        };
        check("network", &values(&network.q_values(&logits).unwrap()));

        let weights = parameters.to_safetensors(|_| true).unwrap();
        let mut policy = PolicyNetwork::new(&config, &weights, Precision::F32).unwrap();
        let mut found = vec![0.0; wanted.len()];
        policy
            .q_values(
                &frames.flatten_all().unwrap().to_vec1::<u8>().unwrap(),
                &mut found,
            )
            .unwrap();
        check(
            "policy",
            &found
                .iter()
                .map(|&value| f64::from(value))
                .collect::<Vec<_>>(),
        );
    }
}
