//! What a checkpoint's networks say of themselves in safetensors' metadata, so that a file alone can be loaded elsewhere.
//! This program reads it to say which setting of a checkpoint differs; one without it is as good.

use driml_model::{InputSize, ModelConfig, TorsoName};
use driml_protocol::RunSpec;
use safetensors::{SafeTensorError, SafeTensors};
use serde::Serialize;
use serde_json::Value;

/// The metadata's one key.
pub const KEY: &str = "driml";
/// 1: the tables of the settings that a reader needs, under their names there.
const FORMAT: u32 = 1;
/// For a reader who has nothing but the file. More: `deploy/docs/src/reference/weights.md`.
const CONVENTIONS: &str = "Input: states u8 [B, height, width, channels] of [model], divided by 255; channels are the newest frame_stack \
    frames of [run], oldest first. Parameters have PyTorch's names and shapes: convolutions [out, in, k, k]TORSO; HEAD. \
    Atoms: v_min to v_max, evenly. Value of an action: sum of softmax(logits) * atoms.";

/// What the torso does, in [`CONVENTIONS`].
fn torso(model: &ModelConfig) -> String {
    let read = match model.torso {
        TorsoName::Nature => {
            return " without padding, each followed by ReLU; torso.fc takes their output as channel, row, column".into();
        }
        TorsoName::Impala => "ReLU of the last stage's output as channel, row, column",
        TorsoName::Impoola => "the mean over the locations of ReLU of the last stage's output",
    };
    format!(
        " with zero padding 1: a stage is conv, max pool 3x3 of stride 2 and padding 1, and x + conv2(ReLU(conv1(ReLU(x)))) for block1 \
         and block2; torso.fc takes {read}"
    )
}

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
        conventions: CONVENTIONS
            .replace("TORSO", &torso(model))
            .replace("HEAD", head(model)),
        model,
        input,
        run,
    };
    serde_json::to_string(&description).expect("plain values are JSON")
}

/// The description in a safetensors file; none if it has none.
///
/// # Errors
/// Not a whole safetensors file.
pub fn described(safetensors: &[u8]) -> Result<Option<Value>, SafeTensorError> {
    let (_, header) = SafeTensors::read_metadata(safetensors)?;
    let text = header.metadata().as_ref().and_then(|it| it.get(KEY));
    Ok(text.and_then(|it| serde_json::from_str(it).ok()))
}

/// The path of the first value that differs, under `name`, and both values.
pub(super) fn difference(
    name: &str,
    one: &Value,
    other: &Value,
) -> Option<(String, String, String)> {
    if one == other {
        return None;
    }
    if let (Value::Object(ones), Value::Object(others)) = (one, other) {
        let keys = ones.keys().chain(others.keys());
        let at = |key: &String| difference(&format!("{name}.{key}"), &one[key], &other[key]);
        return keys.into_iter().find_map(at);
    }
    Some((name.into(), one.to_string(), other.to_string()))
}
