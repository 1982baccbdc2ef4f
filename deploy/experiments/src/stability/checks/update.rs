//! Loss and gradients of a whole update, C51 with DIM: this project's kernels compared with candle's operations.

use candle_core::Device;
use driml_learner::{
    Agent, Compute, NetworkParameters, OwnedBatch, UpdateSettings,
    parity::deviation::{REFERENCE, UpdateDeviation},
};
use driml_machine::resources::Machine;
use driml_model::{ModelConfig, Parameters};
use driml_protocol::NO_ACTION;
use driml_settings::flags::resolve_names;

use crate::{small, stability::property::*};

/// The largest allowed difference of two ways to compute an update. Each of them may be wrong by half of it.
const ERROR_MAX: f64 = 2e-4;

const UPDATES: &str = "our kernels beside candle's operations: initial weights times 1e-6 to 100; returns 0 to 3e38; supports 1e-3 to 2e30 wide; tanh_clip 1e-30 to 1e30; one state, four or all that differ, equal ones computed each and once";

pub(super) fn properties() -> Vec<Property> {
    let finite = "f32; weights, returns and supports of any size whose losses are finite";
    vec![
        Property::new("whole update", finite)
            .promise("the loss, as a share of 1 + loss", ERROR_MAX)
            .promise("gradients, as a share of their norm, median", ERROR_MAX)
            .check(UPDATES, Listed, check),
    ]
}

const ACTIONS: usize = 4;

/// Settings of a small network in which all four pairs of DIM have a weight.
const SETS: &str = "learner.update.lambda.3t3=0.5 learner.update.lambda.3t4=0.5 learner.update.lambda.4t3=0.5 model.hidden=32 \
                    model.embedding_dim=16 model.action_embed=4 model.conv=[{out=8,kernel=4,stride=2},{out=8,kernel=3,stride=1}]";

/// The settings of an update besides its weights and rows.
#[derive(Debug)]
struct Setting {
    /// The factor for the initial weights.
    scale: f32,
    support: (f32, f32),
    tanh_clip: f64,
    returns: f32,
    /// The largest number of different states.
    distinct: usize,
}

impl Setting {
    fn draw(scale: f32, rng: &mut ChaCha8Rng) -> Self {
        let supports = [
            (-10.0, 10.0),
            (0.0, 1e-3),
            (1000.0, 1001.0),
            (-1e6, 1e6),
            (-1e30, 1e30),
        ];
        Self {
            scale,
            support: one_of(&supports, rng),
            tanh_clip: one_of(&[1e-30, 1e-3, 1.0, 20.0, 1e9, 1e30], rng),
            returns: one_of(&[0.0, 1e-40, 1.0, 1e6, 1e30, 3e38], rng),
            distinct: one_of(&[1, 4, usize::MAX], rng),
        }
    }

    /// Creates two agents with the same scaled initial weights: one with our kernels, one with candle's.
    fn agents(&self, rng: &mut ChaCha8Rng) -> anyhow::Result<[Agent; 2]> {
        let sets: Vec<_> = SETS.split(' ').collect();
        let run = resolve_names("paper", "chain", "driml-fix", &sets, &Machine::detect())?;
        let model = ModelConfig {
            height: 20,
            width: 20,
            input_channels: 2,
            num_actions: ACTIONS,
            v_min: self.support.0,
            v_max: self.support.1,
            ..run.model
        };
        let settings = UpdateSettings {
            tanh_clip: self.tanh_clip,
            ..run.learner.update
        };
        let mut draw = || -> anyhow::Result<Parameters> {
            let drawn = Parameters::init(&model, rng, &Device::Cpu)?;
            let values = small::scalars(&model, &drawn)?.into_iter();
            let scaled: Vec<f32> = values.map(|value| value * self.scale).collect();
            Ok(small::parameters(&model, &scaled)?)
        };
        let (online, target) = (draw()?, draw()?.without_dim()?);
        let agent = |compute: &Compute| {
            let parameters = NetworkParameters {
                online: online.clone(),
                target: target.clone(),
                key_encoder: None,
            };
            Agent::from_parameters(model.clone(), settings.clone(), compute, parameters)
        };
        Ok([agent(&Compute::CPU)?, agent(&REFERENCE)?])
    }

    fn batch(&self, state_len: usize, rng: &mut ChaCha8Rng) -> OwnedBatch {
        let rows = rng.random_range(2..24);
        let distinct = self.distinct.min(3 * rows);
        let state = |_| (0..state_len).map(|_| rng.random()).collect();
        let states: Vec<Vec<u8>> = (0..distinct).map(state).collect();
        let any_states = |rng: &mut ChaCha8Rng| {
            let each = (0..rows).map(|_| &states[rng.random_range(0..distinct)][..]);
            each.collect::<Vec<_>>().concat()
        };
        let actions = |none: f64, rng: &mut ChaCha8Rng| {
            let action = |_| match rng.random_bool(none) {
                true => NO_ACTION,
                false => rng.random_range(0..ACTIONS as u8),
            };
            (0..rows).map(action).collect()
        };
        OwnedBatch {
            states_t: any_states(rng),
            states_k: any_states(rng),
            states_n: any_states(rng),
            action: actions(0.0, rng),
            next_action: actions(0.1, rng),
            n_step_return: (0..rows)
                .map(|_| self.returns * rng.random_range(-1.0..1.0))
                .collect(),
            bootstrap_discount: (0..rows).map(|_| one_of(&[0.0, 0.93, 1.0], rng)).collect(),
            positive_valid: (0..rows).map(|_| rng.random_bool(0.8).into()).collect(),
            ..OwnedBatch::default()
        }
    }
}

/// Returns the error of a loss as a share of 1 + |loss|, because the loss may be 0.
const fn loss_error(own: f64, reference: f64) -> f64 {
    (own - reference).abs() / (1.0 + reference.abs())
}

/// Returns the median (the larger of two middle values), or NaN if any value is NaN; `None` without values.
fn median(mut errors: Vec<f64>) -> Option<f64> {
    errors.sort_by(f64::total_cmp);
    let nan = errors.iter().find(|it| it.is_nan());
    nan.or_else(|| errors.get(errors.len() / 2)).copied()
}

fn check(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let scale = cases.one_of(&[1e-6, 1e-3, 0.1, 1.0, 3.0, 10.0, 100.0]);
    let mut gradients = Vec::new();
    for _ in 0..cases.draw_count(0.0015) {
        let setting = Setting::draw(scale, &mut cases.rng);
        let [mut agent, reference] = setting.agents(&mut cases.rng)?;
        let batch = setting.batch(agent.model().frame_len(), &mut cases.rng);
        // The errors with and without deduplication of equal states; the larger counts.
        let (mut loss, mut gradient) = (Vec::new(), Vec::new());
        for deduplicate in [false, true] {
            agent = agent.with_deduplication(deduplicate);
            let found = UpdateDeviation::new(&agent, &batch.batch(), &reference)?;
            loss.push(loss_error(found.own_loss, found.reference_loss));
            // `None` if two nearly equal values swap their order: then the next action and the target differ, so gradients do too.
            gradient.push((found.same_next_action == 1.0).then_some(found.gradient));
        }
        cases.record_errors(format_args!("{setting:?}"), [max_error(loss)])?;
        let gradient: Option<Vec<f64>> = gradient.into_iter().collect();
        gradients.extend(gradient.map(max_error));
    }
    // Only the median counts: if states are equal or losses saturate, the terms of a gradient cancel and only rounding remains.
    // With few cases there may be none with comparable gradients.
    let input = format_args!("weights x {scale:e}");
    cases.record_errors(input, [None, median(gradients)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gradient_that_is_not_a_number_and_a_loss_of_0_have_an_error_too() {
        assert_eq!(loss_error(1e-9, 0.0), 1e-9);
        assert_eq!(median(vec![0.3, 0.1, 0.2]), Some(0.2));
        assert_eq!(median(vec![]), None);
        let found = median(vec![0.3, f64::NAN, 0.2, 0.1]);
        assert!(found.is_some_and(f64::is_nan), "{found:?}");
    }
}
