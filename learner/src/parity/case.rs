//! Reads a parity case from its file: settings, inputs, parameters and expectations, all checked.
//! It computes nothing.

use std::{
    cell::RefCell,
    collections::{BTreeMap, BTreeSet, HashMap},
};

use anyhow::{Context, Result, bail, ensure};
use candle_core::{DType, Device, Tensor, WithDType};
use driml_model::{ConvLayer, DimHeads, HeadConfig, HeadNoise, ModelConfig, TorsoName};
use driml_protocol::NO_ACTION;
use safetensors::SafeTensors;
use serde::Deserialize;

use crate::{
    auxiliary::{AuxiliaryKind, dim::DIM, positives::Positives, settings::Lambda},
    batch::OwnedBatch,
    losses_and_gradients::UpdateNoise,
    optimiser::adam::AdamSettings,
    settings::UpdateSettings,
    tensors::to_vec_f64,
};

/// The metadata key `config` of a case: sizes and settings of the update that the reference computed.
#[derive(Debug, Deserialize)]
struct Config {
    obs: Observation,
    actions: usize,
    atoms: usize,
    v_min: f32,
    v_max: f32,
    double_dqn: bool,
    /// If absent: DIM, or no auxiliary loss if all lambdas are 0.
    #[serde(rename = "objective")]
    auxiliary_loss: Option<AuxiliaryKind>,
    /// If absent: true if there is an auxiliary loss.
    condition_on_action: Option<bool>,
    lambda: Lambda,
    tanh_clip: f64,
    max_grad_norm: f64,
    adam: AdamSettings,
    /// `key_tau` of the auxiliary loss; absent for a loss without a key encoder.
    key_tau: Option<f64>,
    model: ModelSizes,
    /// If absent: one linear layer.
    #[serde(default)]
    head: HeadConfig,
}

#[derive(Debug, Deserialize)]
struct Observation {
    height: usize,
    width: usize,
    channels: usize,
}

#[derive(Debug, Deserialize)]
struct ModelSizes {
    /// If absent: `nature`.
    #[serde(default)]
    torso: TorsoName,
    #[serde(default)]
    conv: Vec<ConvLayer>,
    #[serde(default)]
    channels: Vec<usize>,
    hidden: usize,
    #[serde(rename = "rkhs")]
    embedding_dim: usize,
    action_embed: usize,
}

/// One case: a batch, all parameters before the update, and every expected tensor.
pub(super) struct Case {
    config: Config,
    pub(super) settings: UpdateSettings,
    pub(super) inputs: OwnedBatch,
    tensors: Tensors,
    /// Names of expectations that nothing was compared with yet.
    unused: RefCell<BTreeSet<String>>,
}

impl Case {
    pub(super) fn parse(bytes: &[u8]) -> Result<Self> {
        let cut = "not a whole safetensors file";
        let (_, header) = SafeTensors::read_metadata(bytes).context(cut)?;
        let metadata = header.metadata().as_ref();
        let text = metadata.and_then(|metadata| metadata.get("config"));
        let text = text.context("the metadata key `config` is missing")?;
        let config: Config = serde_json::from_str(text).context("metadata key `config`")?;
        let tensors = candle_core::safetensors::load_buffer(bytes, &Device::Cpu).context(cut)?;
        let tensors = Tensors(tensors.into_iter().collect());
        let settings = config.settings();
        let expectations = tensors.0.keys().filter(|name| name.starts_with("expect."));
        Ok(Self {
            inputs: read_inputs(&tensors, &config.obs, &settings)?,
            unused: RefCell::new(expectations.cloned().collect()),
            config,
            settings,
            tensors,
        })
    }

    pub(super) fn model(&self, dim: DimHeads) -> ModelConfig {
        let it = &self.config;
        ModelConfig {
            height: it.obs.height,
            width: it.obs.width,
            input_channels: it.obs.channels,
            num_actions: it.actions,
            atoms: it.atoms,
            v_min: it.v_min,
            v_max: it.v_max,
            torso: it.model.torso,
            conv: it.model.conv.clone(),
            channels: it.model.channels.clone(),
            scale_blocks: false,
            hidden: it.model.hidden,
            embedding_dim: it.model.embedding_dim,
            action_embed: it.model.action_embed,
            dim,
            loss_layers: vec![],
            head: it.head,
        }
    }

    /// The noise of the noisy layers, made from the normal numbers in the case.
    pub(super) fn noise(&self, model: &ModelConfig) -> Result<UpdateNoise> {
        let head_noise = |network: &str| {
            HeadNoise::from_normals(model, |layer, side, len| {
                let name = format!("noise.{network}.{layer}.{side}");
                let normals = self.tensors.read::<f32>(&name, DType::F32, &[len])?;
                Ok::<_, anyhow::Error>(normals.into_iter().map(f64::from).collect())
            })
        };
        Ok(UpdateNoise {
            online: head_noise("online")?,
            double_dqn: head_noise("choice")?,
            target: head_noise("target")?,
        })
    }

    /// The tensors whose names begin with `prefix`, by the rest of their names: `online.` are the parameters before the update.
    pub(super) fn tensors_under<'a>(
        &'a self,
        prefix: &'a str,
    ) -> impl Iterator<Item = (&'a str, &'a Tensor)> {
        let all = self.tensors.0.iter();
        all.filter_map(move |(name, tensor)| Some((name.strip_prefix(prefix)?, tensor)))
    }

    /// The parameters under `prefix` that `model` builds: heads that no lambda uses are left out.
    pub(super) fn parameters(&self, prefix: &str, model: &ModelConfig) -> HashMap<String, Tensor> {
        let shapes = model.parameter_shapes().into_iter();
        let built: BTreeSet<_> = shapes.map(|it| it.0).collect();
        let named = self.tensors_under(prefix);
        let named = named.filter(|(name, _)| built.contains(*name));
        named
            .map(|(name, it)| (name.to_owned(), it.clone()))
            .collect()
    }

    /// The values of `expect.<name>`, as f64. Marks the expectation as used.
    pub(super) fn expected(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let name = format!("expect.{name}");
        let tensor = self.tensors.get(&name)?;
        let found = tensor.dims();
        ensure!(
            found == shape,
            "tensor {name}: its shape is {found:?}, not {shape:?}"
        );
        self.unused.borrow_mut().remove(&name);
        Ok(to_vec_f64(tensor)?)
    }

    /// Checks that every expectation was used: one that nothing was compared with must not pass as met.
    pub(super) fn check_all_expectations_used(&self) -> Result<()> {
        match self.unused.borrow().first() {
            Some(name) => bail!("tensor {name}: this expectation is not known here"),
            None => Ok(()),
        }
    }
}

impl Config {
    fn settings(&self) -> UpdateSettings {
        let default_loss = if self.lambda.active_pairs().contains(&true) {
            AuxiliaryKind::from_item(&DIM)
        } else {
            AuxiliaryKind::NONE
        };
        let auxiliary_loss = self.auxiliary_loss.unwrap_or(default_loss);
        // The loss's own table, of which cases have this one setting.
        let own = self.key_tau.map(|key_tau| {
            let table = toml::Table::from_iter([("key_tau".to_owned(), key_tau.into())]);
            (auxiliary_loss.name().to_owned(), table.into())
        });
        UpdateSettings {
            double_dqn: self.double_dqn,
            auxiliary_loss,
            condition_on_action: self
                .condition_on_action
                .unwrap_or(auxiliary_loss != AuxiliaryKind::NONE),
            lambda: self.lambda,
            tanh_clip: self.tanh_clip,
            max_grad_norm: self.max_grad_norm,
            adam: self.adam,
            // One update: the target network does not move.
            target_period_updates: u64::MAX,
            target_tau: 1.0,
            average_tau: None,
            own: own.into_iter().collect(),
        }
    }
}

fn read_inputs(
    tensors: &Tensors,
    obs: &Observation,
    settings: &UpdateSettings,
) -> Result<OwnedBatch> {
    let rows = tensors.get("input.action")?.elem_count();
    let state = [rows, obs.height, obs.width, obs.channels];
    let bytes = |name: &str, shape: &[usize]| tensors.read::<u8>(name, DType::U8, shape);
    let floats = |name: &str| tensors.read::<f32>(name, DType::F32, &[rows]);
    let mut anchors = None;
    let (states_k, positive_valid) = if settings.auxiliary_loss.positives() == Positives::OtherView
    {
        anchors = Some(bytes("input.view_query", &state)?);
        (bytes("input.view_key", &state)?, vec![1; rows])
    } else {
        // [B] if a row has one positive, else [P, B].
        let dims = tensors.get("input.positive_valid")?.dims();
        let positive_dims = if dims.len() > 1 { &dims[..1] } else { &[] };
        let states_k = bytes("input.frames_k", &[positive_dims, &state[..]].concat())?;
        let valid = bytes("input.positive_valid", &[positive_dims, &[rows]].concat())?;
        (states_k, valid)
    };
    let actions = tensors.read::<i64>("input.action", DType::I64, &[rows])?;
    let to_action = |&action: &i64| u8::try_from(action).ok().filter(|it| *it != NO_ACTION);
    let action: Option<Vec<u8>> = actions.iter().map(to_action).collect();
    let weight = "input.importance_weight";
    let is_weighted = tensors.0.contains_key(weight);
    Ok(OwnedBatch {
        states_t: bytes("input.frames_t", &state)?,
        anchors,
        states_k,
        states_n: bytes("input.frames_n", &state)?,
        action: action.with_context(|| {
            format!("tensor input.action: its actions {actions:?} are not all in 0..255")
        })?,
        next_action: vec![NO_ACTION; rows],
        n_step_return: floats("input.n_step_return")?,
        bootstrap_discount: floats("input.bootstrap_discount")?,
        positive_valid,
        importance_weight: is_weighted.then(|| floats(weight)).transpose()?,
    })
}

struct Tensors(BTreeMap<String, Tensor>);

impl Tensors {
    fn get(&self, name: &str) -> Result<&Tensor> {
        let missing = || format!("tensor {name}: it is missing");
        self.0.get(name).with_context(missing)
    }

    /// The values of a tensor of this type and shape.
    fn read<T: WithDType>(&self, name: &str, dtype: DType, shape: &[usize]) -> Result<Vec<T>> {
        let tensor = self.get(name)?;
        let (found, dims) = (tensor.dtype(), tensor.dims());
        ensure!(
            found == dtype && dims == shape,
            "tensor {name}: it is {found:?} {dims:?}, not {dtype:?} {shape:?}"
        );
        Ok(tensor.flatten_all()?.to_vec1()?)
    }
}
