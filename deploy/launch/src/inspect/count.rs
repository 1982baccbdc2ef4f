//! Counts the rows of the table: parameters, FLOPs and bytes of a configuration, and of the same configuration with everything on.
//! The crates of the model and the learner compute what a layer or an update costs.

use driml_learner::{
    Lambda,
    auxiliary::loss::Passes,
    cost::{UpdateCost, UpdateShape},
};
use driml_model::{DimHeads, HeadConfig, LayerCost, ModelConfig, WeightDtype};
use driml_protocol::{BatchHeader, Horizon, RunSpec, TRANSITION_BYTES};
use driml_settings::{config::RunConfig, memory::replay_bytes_each};
use serde::Serialize;

pub(super) const EVERYTHING: &str = "the options of all agents at once: five heads of DIM and a key encoder, \
     a dueling head of noisy layers, four pairs of levels at five positives a row, augmented, double DQN, all weights broadcast as f32; frames whole, stacked and enlarged by the actors";
/// Positives of a row with everything on: those of the agent with the most, cpc.
const EVERYTHING_POSITIVES: usize = 5;
pub(super) const BATCH_NAME: &str = "a batch";

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Line {
    pub(crate) what: String,
    pub(crate) is: u64,
    pub(crate) everything: u64,
}

type Counts = Vec<(String, u64)>;

pub(super) struct CostCounter<'a> {
    config: &'a RunConfig,
    pub(super) model: ModelConfig,
    shape: UpdateShape,
    run: RunSpec,
    broadcast: usize,
}

impl<'a> CostCounter<'a> {
    pub(super) fn new(config: &'a RunConfig) -> driml_model::Result<Self> {
        Ok(Self {
            config,
            model: config.model.clone(),
            shape: UpdateShape::for_learner(&config.learner, config.run.horizon.positives()),
            run: config.run.clone(),
            broadcast: config.weights_bytes()?,
        })
    }

    /// The same world and sizes with everything on, which no agent has.
    pub(super) fn with_everything_on(config: &'a RunConfig) -> driml_model::Result<Self> {
        let (frame, input) = (config.world.frame_shape(), config.input);
        let model = ModelConfig {
            height: input.height as usize,
            width: input.width as usize,
            num_actions: config.world.num_actions(),
            dim: DimHeads::ALL,
            head: HeadConfig::RAINBOW,
            ..config.model.clone()
        };
        // The frames of a stack as one frame, of the size that the network takes.
        let run = RunSpec {
            frame_height: input.height,
            frame_width: input.width,
            frame_channels: frame.channels as u32 * config.run.frame_stack,
            frame_stack: 1,
            horizon: Horizon::All {
                k_max: EVERYTHING_POSITIVES as u32,
            },
            ..config.run.clone()
        };
        let shape = UpdateShape {
            rows: config.learner.batch_size.into(),
            every_action: true,
            double_dqn: true,
            passes: Passes {
                keys: 1,
                ..Passes::for_pairs(Lambda::ONES, EVERYTHING_POSITIVES, true)
            },
        };
        Ok(Self {
            config,
            broadcast: model.weights_bytes(WeightDtype::F32)?,
            model,
            shape,
            run,
        })
    }

    /// Scalars of all networks that the learner holds; `units` are those of the model that has the most.
    pub(super) fn parameters(&self, units: &[String]) -> Counts {
        let layers = self.model.layer_costs();
        let scalars = |part: &str| sum(&layers, part, |layer| layer.parameters);
        let mut counts = by_unit(units, scalars);
        let key = match self.shape.passes.keys {
            0 => 0,
            _ => scalars("torso") + scalars("dim.psi4"),
        };
        counts.push(("target network".into(), scalars("torso") + scalars("head")));
        counts.push(("key encoder".into(), key));
        counts
    }

    /// FLOPs of one decision of an actor, if the network decides and not chance.
    pub(super) fn decision_flops(&self) -> Counts {
        let layers = self.model.without_dim().layer_costs();
        let forward = |part: &str| sum(&layers, part, |layer| layer.forward);
        by_unit(&units(&self.model.without_dim()), forward)
    }

    pub(super) fn update_flops(&self) -> Counts {
        to_counts(UpdateCost::compute(&self.model, &self.shape).parts())
    }

    /// Bytes of a transition, of a batch whose rows have every state, and of a broadcast, without compression and socket overhead.
    pub(super) fn bytes(&self) -> Counts {
        let header = |run: &RunSpec| {
            let header = BatchHeader::largest(run, self.config.learner.batch_size);
            header.with_sampling(&self.config.replay.sampling)
        };
        let size = |header: BatchHeader| header.payload_bytes() as u64;
        let states = |run: &RunSpec| {
            let without_states = BatchHeader {
                state_bytes: 0,
                stacked: None,
                ..header(run)
            };
            size(header(run)) - size(without_states)
        };
        let run = &self.run;
        let (batch, all_states) = (size(header(run)), states(run));
        let first_states = states(&RunSpec {
            horizon: Horizon::None {},
            ..run.clone()
        });
        let transition = (run.frame_bytes() + TRANSITION_BYTES) as u64;
        to_counts([
            ("a transition in a chunk", transition),
            ("a transition in the replay", replay_bytes_each(run)),
            (BATCH_NAME, batch),
            ("  s_t and s_{t+n}", first_states),
            ("  s_{t+k}", all_states - first_states),
            ("  numbers", batch - all_states),
            ("a broadcast", self.broadcast as u64),
        ])
    }
}

fn sum(layers: &[LayerCost], part: &str, cost: fn(&LayerCost) -> u64) -> u64 {
    let of_part = layers.iter().filter(|layer| layer.is_in(part));
    of_part.map(cost).sum()
}

/// The units in which layers are shown: a residual block is one unit, and so is C51's head, of one layer or two.
pub(super) fn units(model: &ModelConfig) -> Vec<String> {
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

fn by_unit(units: &[String], count: impl Fn(&str) -> u64) -> Counts {
    units.iter().map(|it| (it.clone(), count(it))).collect()
}

fn to_counts<const N: usize>(counts: [(&str, u64); N]) -> Counts {
    counts.map(|(what, n)| (what.to_owned(), n)).into()
}
