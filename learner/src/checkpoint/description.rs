//! What a checkpoint's networks say of themselves in safetensors' metadata, so that a file alone can be loaded elsewhere.
//! Nothing of this program reads it: a checkpoint without it is as good.

use driml_model::{InputSize, ModelConfig};
use driml_protocol::RunSpec;
use serde::Serialize;

/// The metadata's one key.
pub(super) const KEY: &str = "driml";
/// 1: the tables of the settings that a reader needs, under their names there.
const FORMAT: u32 = 1;
/// For a reader who has nothing but the file. More: `deploy/python/weights.md`.
const CONVENTIONS: &str = "Input: states u8 [B, height, width, channels] of [model], divided by 255; channels are the newest frame_stack \
    frames of [run], oldest first. Parameters have PyTorch's names and shapes: convolutions [out, in, k, k] without padding, each \
    followed by ReLU; torso.fc takes their output as channel, row, column; HEAD. \
    Atoms: v_min to v_max, evenly. Value of an action: sum of softmax(logits) * atoms.";

/// What the C51 head does, in [`CONVENTIONS`].
const fn head(model: &ModelConfig) -> &'static str {
    match (model.head.dueling, model.head.noisy_sigma.is_some()) {
        (false, false) => "head takes ReLU of that and gives [actions, atoms] logits",
        (false, true) => {
            "head, a noisy layer whose means (weight_mu, bias_mu) evaluate, takes ReLU of that and gives [actions, atoms] logits"
        }
        (true, false) => {
            "head.value [atoms] and head.advantage [actions, atoms] take ReLU of that; logits are value + advantage - mean of advantage over the actions"
        }
        (true, true) => {
            "head.value [atoms] and head.advantage [actions, atoms], noisy layers whose means (weight_mu, bias_mu) evaluate, take ReLU of that; \
             logits are value + advantage - mean of advantage over the actions"
        }
    }
}

#[derive(Serialize)]
struct Description<'a> {
    format: u32,
    conventions: String,
    model: &'a ModelConfig,
    input: &'a InputSize,
    run: &'a RunSpec,
}

/// The description of a run's networks, JSON.
pub fn describe(run: &RunSpec, model: &ModelConfig, input: &InputSize) -> String {
    let description = Description {
        format: FORMAT,
        conventions: CONVENTIONS.replace("HEAD", head(model)),
        model,
        input,
        run,
    };
    serde_json::to_string(&description).expect("plain values are JSON")
}
