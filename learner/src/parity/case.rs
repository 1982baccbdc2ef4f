//! A parity case as its file gives it: settings, inputs, parameters and expectations, all checked.
//! It computes nothing.

use std::{
    cell::RefCell,
    collections::{BTreeMap, BTreeSet, HashMap},
    io,
    path::PathBuf,
};

use candle_core::{DType, Device, Tensor};
use driml_model::{ConvLayer, DimHeads, HeadConfig, HeadNoise, ModelConfig};
use driml_protocol::NO_ACTION;
use safetensors::SafeTensors;
use serde::Deserialize;

use crate::{
    auxiliary::{Objective, dim::DIM, positives::Positives, settings::Lambda},
    batch::Batch,
    error::UpdateError,
    noise::UpdateNoise,
    optimiser::adam::AdamSettings,
    settings::LearnerSettings,
};

/// Why a case could not be checked.
#[derive(Debug, thiserror::Error)]
pub enum ParityError {
    /// The file could not be read.
    #[error("cannot read {file}: {source}")]
    Read {
        /// The case's file.
        file: PathBuf,
        /// What the file system said.
        source: io::Error,
    },
    /// The file was read, but cannot be checked.
    #[error("{file}: {why}")]
    InFile {
        /// The case's file.
        file: PathBuf,
        /// What is wrong with it.
        why: Box<ParityError>,
    },
    /// Not a safetensors file, or not all of one.
    #[error("not a whole safetensors file: {0}")]
    Format(String),
    /// The metadata key `config` is missing or says nothing usable.
    #[error("metadata key `config`: {0}")]
    Config(String),
    /// A tensor is missing, or is not what it must be.
    #[error("tensor {name}: {why}")]
    Tensor {
        /// Its name in the file.
        name: String,
        /// What is wrong with it.
        why: String,
    },
    /// The update refused the case.
    #[error(transparent)]
    Update(#[from] UpdateError),
    /// The model refused the case's parameters.
    #[error(transparent)]
    Model(#[from] driml_model::ModelError),
    /// The tensor library refused.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

/// The metadata key `config` of a case: sizes and settings of the update that the reference computed.
#[derive(Debug, Deserialize)]
struct Config {
    obs: Observation,
    actions: usize,
    atoms: usize,
    v_min: f32,
    v_max: f32,
    double_dqn: bool,
    /// Not there: DIM, or none if all lambdas are 0.
    objective: Option<Objective>,
    /// Not there: with the action, where there is DIM.
    condition_on_action: Option<bool>,
    lambda: Lambda,
    tanh_clip: f64,
    max_grad_norm: f64,
    adam: AdamSettings,
    /// Pace of the key encoder; not there for an objective without one.
    key_tau: Option<f64>,
    model: Sizes,
    /// Not there: one linear layer.
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
struct Sizes {
    conv: Vec<(usize, usize, usize)>,
    hidden: usize,
    rkhs: usize,
    action_embed: usize,
}

/// One case: a batch, all parameters before the update, and every tensor that must come out.
pub(super) struct Case {
    config: Config,
    pub(super) settings: LearnerSettings,
    pub(super) rows: usize,
    positives: usize,
    frames: [Vec<u8>; 3],
    anchors: Option<Vec<u8>>,
    action: Vec<u8>,
    next_action: Vec<u8>,
    n_step_return: Vec<f32>,
    bootstrap_discount: Vec<f32>,
    positive_valid: Vec<u8>,
    /// Not there: the rows are not weighted.
    importance_weight: Option<Vec<f32>>,
    tensors: BTreeMap<String, Tensor>,
    /// Expectations that were asked for.
    used: RefCell<BTreeSet<String>>,
}

impl Case {
    pub(super) fn parse(bytes: &[u8]) -> Result<Self, ParityError> {
        let format = |why: String| ParityError::Format(why);
        let (_, header) =
            SafeTensors::read_metadata(bytes).map_err(|why| format(why.to_string()))?;
        let text = header
            .metadata()
            .as_ref()
            .and_then(|metadata| metadata.get("config"));
        let text = text.ok_or_else(|| ParityError::Config("it is missing".to_owned()))?;
        let config: Config =
            serde_json::from_str(text).map_err(|why| ParityError::Config(why.to_string()))?;
        let tensors: BTreeMap<String, Tensor> =
            candle_core::safetensors::load_buffer(bytes, &Device::Cpu)
                .map_err(|why| format(why.to_string()))?
                .into_iter()
                .collect();
        let by_lambda = if config.lambda.wanted().contains(&true) {
            Objective::of(&DIM)
        } else {
            Objective::NONE
        };
        let objective = config.objective.unwrap_or(by_lambda);
        // The one number of its own that an objective in the cases has.
        let own = config.key_tau.map(|key_tau| {
            let table = toml::Table::from_iter([("key_tau".to_owned(), key_tau.into())]);
            (objective.name().to_owned(), table.into())
        });
        let settings = LearnerSettings {
            double_dqn: config.double_dqn,
            objective,
            condition_on_action: config.condition_on_action.unwrap_or(true),
            lambda: config.lambda,
            tanh_clip: config.tanh_clip,
            max_grad_norm: config.max_grad_norm,
            adam: config.adam,
            // One update: the target network does not move.
            target_period_updates: u64::MAX,
            target_tau: 1.0,
            average_tau: None,
            own: own.into_iter().collect(),
        };
        let mut case = Self {
            rows: 0,
            positives: 0,
            frames: Default::default(),
            anchors: None,
            action: Vec::new(),
            next_action: Vec::new(),
            n_step_return: Vec::new(),
            bootstrap_discount: Vec::new(),
            positive_valid: Vec::new(),
            importance_weight: None,
            used: RefCell::default(),
            config,
            settings,
            tensors,
        };
        case.read_inputs()?;
        Ok(case)
    }

    fn read_inputs(&mut self) -> Result<(), ParityError> {
        let Observation {
            height,
            width,
            channels,
        } = self.config.obs;
        self.rows = self.tensor("input.action")?.elem_count();
        let rows = self.rows;
        let state = [rows, height, width, channels];
        let bytes = |name: &str, shape: &[usize]| -> Result<Vec<u8>, ParityError> {
            let tensor = self.input(name, DType::U8, shape)?;
            Ok(tensor.flatten_all()?.to_vec1()?)
        };
        let (mut positives, mut anchors) = (1, None);
        let (states_k, valid) = if self.settings.objective.positives() == Positives::OtherView {
            anchors = Some(bytes("input.view_query", &state)?);
            (bytes("input.view_key", &state)?, vec![1; rows])
        } else {
            // [B] where a row has one positive, else [P, B].
            let dims = self.tensor("input.positive_valid")?.dims();
            let several = if dims.len() > 1 { &dims[..1] } else { &[] };
            positives = several.iter().product();
            let later = [several, &state[..]].concat();
            let valid = [several, &[rows]].concat();
            (
                bytes("input.frames_k", &later)?,
                bytes("input.positive_valid", &valid)?,
            )
        };
        let states_t = bytes("input.frames_t", &state)?;
        let states_n = bytes("input.frames_n", &state)?;
        self.frames = [states_t, states_k, states_n];
        (self.positives, self.anchors, self.positive_valid) = (positives, anchors, valid);
        let actions: Vec<i64> = self.input("input.action", DType::I64, &[rows])?.to_vec1()?;
        let action = |action: i64| {
            u8::try_from(action)
                .ok()
                .filter(|&action| action != NO_ACTION)
        };
        let narrowed: Option<Vec<u8>> = actions.iter().map(|&a| action(a)).collect();
        self.action = narrowed.ok_or_else(|| ParityError::Tensor {
            name: "input.action".to_owned(),
            why: format!("its actions {actions:?} are not all in 0..255"),
        })?;
        self.next_action = vec![NO_ACTION; rows];
        self.n_step_return = self
            .input("input.n_step_return", DType::F32, &[rows])?
            .to_vec1()?;
        self.bootstrap_discount = self
            .input("input.bootstrap_discount", DType::F32, &[rows])?
            .to_vec1()?;
        let name = "input.importance_weight";
        if self.tensors.contains_key(name) {
            let weights = self.input(name, DType::F32, &[rows])?.to_vec1()?;
            self.importance_weight = Some(weights);
        }
        Ok(())
    }

    pub(super) fn model(&self, dim: DimHeads) -> ModelConfig {
        let Config {
            obs,
            actions,
            atoms,
            v_min,
            v_max,
            model,
            head,
            ..
        } = &self.config;
        let conv = |&(out, kernel, stride): &(usize, usize, usize)| ConvLayer {
            out,
            kernel,
            stride,
        };
        ModelConfig {
            height: obs.height,
            width: obs.width,
            channels: obs.channels,
            num_actions: *actions,
            atoms: *atoms,
            v_min: *v_min,
            v_max: *v_max,
            conv: model.conv.iter().map(conv).collect(),
            hidden: model.hidden,
            rkhs: model.rkhs,
            action_embed: model.action_embed,
            dim,
            head: *head,
        }
    }

    /// The noise that the case gives for noisy layers, made of its normal numbers.
    pub(super) fn noise(&self, model: &ModelConfig) -> Result<UpdateNoise, ParityError> {
        let of = |who: &str| {
            HeadNoise::of_normals(model, |layer, side, len| {
                let name = format!("noise.{who}.{layer}.{side}");
                let tensor = self.input(&name, DType::F32, &[len])?;
                Ok::<_, ParityError>(tensor.to_dtype(DType::F64)?.to_vec1()?)
            })
        };
        Ok(UpdateNoise {
            online: of("online")?,
            choice: of("choice")?,
            target: of("target")?,
        })
    }

    pub(super) fn batch(&self) -> Batch<'_> {
        let [states_t, states_k, states_n] = &self.frames;
        Batch {
            rows: self.rows,
            states_t,
            anchors: self.anchors.as_deref(),
            positives: self.positives,
            states_k,
            states_n,
            action: &self.action,
            next_action: &self.next_action,
            n_step_return: &self.n_step_return,
            bootstrap_discount: &self.bootstrap_discount,
            positive_valid: &self.positive_valid,
            importance_weight: self.importance_weight.as_deref(),
        }
    }

    /// The online parameters, without their prefix.
    pub(super) fn online(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.tensors
            .iter()
            .filter_map(|(name, tensor)| Some((name.strip_prefix("online.")?, tensor)))
    }

    /// The parameters under `prefix` that `model` builds: heads that no lambda uses are left out.
    pub(super) fn parameters(&self, prefix: &str, model: &ModelConfig) -> HashMap<String, Tensor> {
        let DimHeads {
            psi3,
            phi3,
            psi4,
            phi4,
            action,
        } = model.dim;
        let unused = |name: &str| {
            [
                ("psi3", psi3),
                ("phi3", phi3),
                ("psi4", psi4),
                ("phi4", phi4),
                ("action", action),
            ]
            .iter()
            .any(|(part, built)| !built && name.starts_with(&format!("dim.{part}.")))
        };
        let named = self
            .tensors
            .iter()
            .filter_map(|(name, t)| Some((name.strip_prefix(prefix)?, t)));
        named
            .filter(|(name, _)| !unused(name))
            .map(|(name, t)| (name.to_owned(), t.clone()))
            .collect()
    }

    /// The values of `expect.<name>`, as f64.
    pub(super) fn expected(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>, ParityError> {
        let name = format!("expect.{name}");
        let tensor = self.tensor(&name)?;
        if tensor.dims() != shape {
            let why = format!("its shape is {:?}, not {shape:?}", tensor.dims());
            return Err(ParityError::Tensor { name, why });
        }
        let values = tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1()?;
        self.used.borrow_mut().insert(name);
        Ok(values)
    }

    /// An expectation that nothing was compared with must not pass as met.
    pub(super) fn check_all_expectations_used(&self) -> Result<(), ParityError> {
        let used = self.used.borrow();
        match self
            .tensors
            .keys()
            .find(|name| name.starts_with("expect.") && !used.contains(*name))
        {
            None => Ok(()),
            Some(name) => Err(ParityError::Tensor {
                name: name.clone(),
                why: "this expectation is not known here".to_owned(),
            }),
        }
    }

    fn tensor(&self, name: &str) -> Result<&Tensor, ParityError> {
        let missing = || ParityError::Tensor {
            name: name.to_owned(),
            why: "it is missing".to_owned(),
        };
        self.tensors.get(name).ok_or_else(missing)
    }

    fn input(&self, name: &str, dtype: DType, shape: &[usize]) -> Result<&Tensor, ParityError> {
        let tensor = self.tensor(name)?;
        if tensor.dtype() != dtype || tensor.dims() != shape {
            return Err(ParityError::Tensor {
                name: name.to_owned(),
                why: format!(
                    "it is {:?} {:?}, not {dtype:?} {shape:?}",
                    tensor.dtype(),
                    tensor.dims()
                ),
            });
        }
        Ok(tensor)
    }
}
