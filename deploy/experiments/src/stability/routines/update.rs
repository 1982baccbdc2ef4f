//! Losses and gradients of a whole update, C51 with DIM: this project's kernels beside candle's own operations.

use driml_envs::WorldName;
use driml_learner::{
    Agent, Batch, Compute, EqualStates, Lambda, LearnerSettings, NetworkParameters,
    parity::deviation::{ErrorOfUpdate, REFERENCE},
};
use driml_machine::resources::Machine;
use driml_model::{ConvLayer, HeadConfig, ModelConfig, Parameters};
use driml_protocol::NO_ACTION;
use driml_settings::{
    presets,
    resolve::{Flags, Source, resolve},
};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    small,
};

const UPDATE: Routine = Routine {
    name: "whole update",
    range: "f32; weights, returns and supports of any size whose losses are finite",
};
const ACTIONS: usize = 4;
/// How far two ways of computing may be apart, each of which is right to half of it.
const APART: f64 = 2e-4;

/// What an update computes with, beside its weights and rows.
struct Setting {
    /// What initial weights are multiplied by.
    scale: f32,
    support: (f32, f32),
    tanh_clip: f64,
    /// The size of returns.
    returns: f32,
    /// Different states at most.
    distinct: usize,
}

impl Setting {
    fn drawn(scale: f32, rng: &mut ChaCha8Rng) -> Self {
        let supports = [
            (-10.0, 10.0),
            (0.0, 1e-3),
            (1000.0, 1001.0),
            (-1e6, 1e6),
            (-1e30, 1e30),
        ];
        Self {
            scale,
            support: supports[rng.random_range(0..5)],
            tanh_clip: [1e-30, 1e-3, 1.0, 20.0, 1e9, 1e30][rng.random_range(0..6)],
            returns: [0.0, 1e-40, 1.0, 1e6, 1e30, 3e38][rng.random_range(0..6)],
            distinct: [1, 4, usize::MAX][rng.random_range(0..3)],
        }
    }

    fn shown(&self) -> String {
        let Self {
            scale,
            support,
            tanh_clip,
            returns,
            distinct,
        } = self;
        let equal = match *distinct {
            usize::MAX => String::new(),
            count => format!(", different states: {count}"),
        };
        format!(
            "weights x {scale:e}, support {support:?}, tanh_clip {tanh_clip:e}, returns within {returns:e}{equal}"
        )
    }
}

fn settings() -> anyhow::Result<LearnerSettings> {
    let world: WorldName = "chain".parse()?;
    let source = Source::Layers(&presets::PRESETS[0], world, "driml-fix");
    let settings = resolve(&source, &Flags::default(), &Machine::this())?;
    Ok(LearnerSettings {
        lambda: Lambda {
            l3t3: 0.5,
            l3t4: 0.5,
            l4t3: 0.5,
            l4t4: 1.0,
        },
        ..settings.learner.update
    })
}

fn model(settings: &LearnerSettings, (v_min, v_max): (f32, f32)) -> ModelConfig {
    let layer = |out, kernel, stride| ConvLayer {
        out,
        kernel,
        stride,
    };
    ModelConfig {
        height: 20,
        width: 20,
        channels: 2,
        num_actions: ACTIONS,
        atoms: 51,
        v_min,
        v_max,
        conv: vec![layer(8, 4, 2), layer(8, 3, 1)],
        hidden: 32,
        rkhs: 16,
        action_embed: 4,
        dim: settings.dim_heads(ACTIONS),
        head: HeadConfig::PLAIN,
    }
}

/// Initial weights times the scale.
fn weights(model: &ModelConfig, scale: f32, rng: &mut ChaCha8Rng) -> anyhow::Result<Parameters> {
    let drawn = Parameters::init(model, rng, &candle_core::Device::Cpu)?;
    let mut values = small::values(model, &drawn)?;
    values.iter_mut().for_each(|value| *value *= scale);
    Ok(small::parameters(model, &values)?)
}

/// The planes of a batch whose rows have every state.
struct Planes {
    states: [Vec<u8>; 3],
    action: Vec<u8>,
    next_action: Vec<u8>,
    n_step_return: Vec<f32>,
    bootstrap_discount: Vec<f32>,
    positive_valid: Vec<u8>,
}

impl Planes {
    fn drawn(model: &ModelConfig, setting: &Setting, rng: &mut ChaCha8Rng) -> Self {
        let rows = rng.random_range(2..24);
        let len = model.frame_len();
        let drawn: Vec<Vec<u8>> = (0..setting.distinct.min(3 * rows))
            .map(|_| (0..len).map(|_| rng.random()).collect())
            .collect();
        let mut states = || -> Vec<u8> {
            let each = (0..rows).map(|_| &drawn[rng.random_range(0..drawn.len())][..]);
            each.collect::<Vec<_>>().concat()
        };
        let states = [states(), states(), states()];
        let mut each = |draw: &dyn Fn(&mut ChaCha8Rng) -> u8| -> Vec<u8> {
            (0..rows).map(|_| draw(rng)).collect()
        };
        let action = |rng: &mut ChaCha8Rng| rng.random_range(0..ACTIONS as u8);
        Self {
            states,
            action: each(&action),
            next_action: each(&|rng| match rng.random_bool(0.1) {
                true => NO_ACTION,
                false => action(rng),
            }),
            positive_valid: each(&|rng| rng.random_bool(0.8).into()),
            n_step_return: (0..rows)
                .map(|_| setting.returns * rng.random_range(-1.0..1.0))
                .collect(),
            bootstrap_discount: (0..rows)
                .map(|_| [0.0, 0.93, 1.0][rng.random_range(0..3)])
                .collect(),
        }
    }

    fn batch(&self) -> Batch<'_> {
        let [states_t, states_k, states_n] = &self.states;
        Batch {
            rows: self.action.len(),
            states_t,
            anchors: None,
            positives: 1,
            states_k,
            states_n,
            action: &self.action,
            next_action: &self.next_action,
            n_step_return: &self.n_step_return,
            bootstrap_discount: &self.bootstrap_discount,
            positive_valid: &self.positive_valid,
            importance_weight: None,
        }
    }
}

/// Errors of one update, the larger of those with equal states each and once: of the loss, as a share of 1 + loss, and of all
/// gradients together, as a share of their norm; none of the gradient where of two values that are nearly the same another is the
/// larger, after which the target is another too.
fn errors(setting: &Setting, rng: &mut ChaCha8Rng) -> anyhow::Result<(f64, Option<f64>)> {
    let settings = LearnerSettings {
        tanh_clip: setting.tanh_clip,
        ..settings()?
    };
    let model = model(&settings, setting.support);
    let online = weights(&model, setting.scale, rng)?;
    let target = weights(&model, setting.scale, rng)?.without_dim()?;
    let agent_on = |compute: &Compute| -> anyhow::Result<Agent> {
        let parameters = NetworkParameters {
            online: online.copy()?,
            target: target.copy()?,
            key: None,
        };
        let settings = settings.clone();
        Ok(Agent::from_parameters(
            model.clone(),
            settings,
            compute,
            parameters,
        )?)
    };
    let (mut agent, reference) = (agent_on(&Compute::CPU)?, agent_on(&REFERENCE)?);
    let planes = Planes::drawn(&model, setting, rng);
    let (mut loss, mut gradient) = (0.0, Some(0.0));
    for equal_states in [EqualStates::Each, EqualStates::Once] {
        agent = agent.with_equal_states(equal_states);
        let found = ErrorOfUpdate::of(&agent, &planes.batch(), &reference)?;
        let share = found.reference_loss.abs() / (1.0 + found.reference_loss.abs());
        loss = larger(loss, found.loss * share);
        let of_gradient = (found.same_next_action == 1.0).then_some(found.gradient);
        gradient = gradient.zip(of_gradient).map(|(a, b)| larger(a, b));
    }
    Ok((loss, gradient))
}

/// The larger; NaN is the largest.
fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || a > b { a } else { b }
}

/// The median; none of no errors.
fn median(mut errors: Vec<f64>) -> Option<f64> {
    errors.sort_by(f64::total_cmp);
    errors.get(errors.len() / 2).copied()
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut losses = Row::new(
        UPDATE,
        "our kernels beside candle's operations: initial weights times 1e-6 to 100; returns 0 to 3e38; supports 1e-3 to 2e30 wide; tanh_clip 1e-30 to 1e30; one state, four or all that differ, equal ones computed each and once",
        "difference of the losses, as a share of 1 + loss",
        APART,
    );
    let mut gradients = Row::new(
        UPDATE,
        "the same, each size of weights",
        // Not of each case: where states are equal, or losses saturate, a gradient's terms cancel, and its norm is that of rounding.
        "median difference of the gradients, as a share of their norm; that of one case has no bound",
        APART,
    );
    for scale in [1e-6, 1e-3, 0.1, 1.0, 3.0, 10.0, 100.0] {
        let mut found = Vec::new();
        context.draw(0.0015, |_, rng| {
            let setting = Setting::drawn(scale, rng);
            let (loss, gradient) = errors(&setting, rng)?;
            losses.see(loss, || setting.shown());
            found.extend(gradient);
            Ok(())
        })?;
        // Of a few cases none may have a gradient that can be compared.
        if let Some(error) = median(found) {
            gradients.see(error, || format!("weights x {scale:e}"));
        }
        context.progress.advance(0)?;
    }
    Ok(vec![losses, gradients])
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn rows_of_equal_states_are_computed_once_and_differ_from_each_in_rounding_alone() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for distinct in [1, 4] {
            let setting = Setting {
                scale: 1.0,
                support: (-10.0, 10.0),
                tanh_clip: 20.0,
                returns: 1.0,
                distinct,
            };
            let model = model(&settings().unwrap(), setting.support);
            let planes = Planes::drawn(&model, &setting, &mut rng);
            let mut states: Vec<&[u8]> = planes
                .states
                .iter()
                .flat_map(|it| it.chunks(model.frame_len()))
                .collect();
            let count = states.len();
            states.sort_unstable();
            states.dedup();
            assert!(states.len() <= distinct && EqualStates::pays(count - states.len(), count));
            let (loss, gradient) = errors(&setting, &mut rng).unwrap();
            assert!(
                loss < 1e-4 && gradient.is_none_or(|it| it < 1e-2),
                "{loss} {gradient:?}"
            );
        }
    }
}
