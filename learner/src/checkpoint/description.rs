//! The description of a checkpoint's networks in safetensors' metadata, so that another program can load a single file.
//! This program reads it only to report which setting of a checkpoint differs. A checkpoint without a description loads too.

use driml_model::{InputSize, ModelConfig};
use driml_protocol::RunSpec;
use safetensors::{SafeTensorError, SafeTensors};
use serde::Serialize;
use serde_json::Value;

/// The only key in the metadata.
pub const METADATA_KEY: &str = "driml";
/// 1: the tables of the settings that a reader needs, under their names in the settings.
const FORMAT: u32 = 1;
/// For a reader who has nothing but the file. More: `deploy/docs/src/reference/weights.md`.
const CONVENTIONS: &str = "Input: states u8 [B, height, width, channels] of [model], divided by 255; channels are the newest frame_stack \
    frames of [run], oldest first. Parameters have PyTorch's names and shapes: convolutions [out, in, k, k] TORSO; HEAD. \
    Atoms: v_min to v_max, evenly. Value of an action: sum of softmax(logits) * atoms.";

/// The text about the C51 head in [`CONVENTIONS`].
const fn head_convention(model: &ModelConfig) -> &'static str {
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

/// Returns the description of a run's networks as JSON.
pub fn describe(run: &RunSpec, model: &ModelConfig, input: &InputSize) -> String {
    let description = Description {
        format: FORMAT,
        conventions: CONVENTIONS
            .replace("TORSO", &model.torso.describe())
            .replace("HEAD", head_convention(model)),
        model,
        input,
        run,
    };
    serde_json::to_string(&description).expect("plain values are JSON")
}

/// Reads the description in a safetensors file; `None` if the file has none.
pub fn read_description(safetensors: &[u8]) -> Result<Option<Value>, SafeTensorError> {
    let (_, header) = SafeTensors::read_metadata(safetensors)?;
    let metadata = header.metadata().as_ref();
    let text = metadata.and_then(|it| it.get(METADATA_KEY));
    Ok(text.and_then(|it| serde_json::from_str(it).ok()))
}
