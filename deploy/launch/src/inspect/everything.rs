//! The same world and sizes with everything on: what the second column counts, the cost of an agent that leaves nothing out.
//! No agent is configured so.

use driml_learner::{Lambda, auxiliary::loss::Passes, cost::UpdateShape};
use driml_model::{DimHeads, HeadConfig, ModelConfig};
use driml_protocol::{Horizon, RunSpec};
use driml_settings::config::RunConfig;

/// What the second column stands for.
pub(super) const EVERYTHING: &str = "all that the agents of the menu have, at once: five heads of DIM and a key encoder, \
     a dueling head of noisy layers, four pairs of levels at five positives a row, augmented, double DQN, all weights broadcast as f32; frames whole, stacked and enlarged where they are made";

/// Positives of a row if everything is on: those of the agent that has most, cpc.
const EVERY_POSITIVES: usize = 5;

/// Rainbow's; no size depends on it.
const NOISY_SIGMA: f64 = 0.5;

/// The same world and sizes with everything on.
pub(super) struct Everything {
    pub(super) model: ModelConfig,
    pub(super) shape: UpdateShape,
    pub(super) run: RunSpec,
}

impl Everything {
    pub(super) fn of(config: &RunConfig) -> Self {
        let (frame, input) = (config.world.frame_shape(), config.input);
        let model = ModelConfig {
            height: input.height as usize,
            width: input.width as usize,
            num_actions: config.world.num_actions(),
            dim: DimHeads {
                psi3: true,
                phi3: true,
                psi4: true,
                phi4: true,
                action: true,
            },
            head: HeadConfig {
                dueling: true,
                noisy_sigma: Some(NOISY_SIGMA),
            },
            ..config.model.clone()
        };
        // A stack's frames as one, of the size that the network takes.
        let run = RunSpec {
            frame_height: input.height,
            frame_width: input.width,
            frame_channels: frame.channels as u32 * config.run.frame_stack,
            frame_stack: 1,
            horizon: Horizon::All {
                k_max: EVERY_POSITIVES as u32,
            },
            ..config.run.clone()
        };
        let shape = UpdateShape {
            rows: config.learner.batch_size.into(),
            every_action: true,
            double_dqn: true,
            passes: Passes {
                keys: 1,
                ..Passes::of_pairs(Lambda::EVERY, EVERY_POSITIVES, true)
            },
        };
        Self { model, shape, run }
    }
}
