//! Errors of an update change nothing.
//! `served` checks the requirements on a batch from the replay server.

use candle_core::{Device, Tensor};
use driml_learner::{Agent, Batch, OwnedBatch, UpdateError};
use driml_model::{Compute, WeightDtype};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::synthetic::{
    ALL_DIM, CANDLE, NO_DIM, agent, agent_on, change_parameters, check_says, model, new_agent,
    random_batch, settings,
};

/// Makes an update that fails, checks that every weight keeps its bits, and returns the error.
fn failure(agent: &mut Agent, batch: &Batch<'_>) -> UpdateError {
    let bits = |agent: &Agent| -> Vec<u32> {
        let all = agent.online().iter().chain(agent.target().iter());
        all.flat_map(|(_, var)| var.flatten_all().unwrap().to_vec1::<f32>().unwrap())
            .map(f32::to_bits)
            .collect()
    };
    let before = bits(agent);
    let error = agent.update(batch).unwrap_err();
    assert!(before == bits(agent) && agent.updates() == 0, "{error}");
    error
}

/// With double DQN, the online network overflows on s_{t+n} but not on s_t, and the target network on neither.
#[test]
fn a_next_state_whose_values_overflow_is_an_error_that_changes_nothing() {
    let mut settings = settings(NO_DIM);
    settings.double_dqn = true;
    let agent = new_agent(model(NO_DIM), settings, &Compute::CPU, 16);
    // The features of black states depend on the biases alone.
    let mut agent = change_parameters(agent, |name, values| {
        if name.starts_with("torso") && name.ends_with("weight") {
            values.iter_mut().for_each(|v| *v = v.abs() * 1e15);
        }
    });
    let mut rows = random_batch(4, 18);
    rows.states_t.fill(0);
    let error = failure(&mut agent, &rows.batch());
    check_says(error, &["the online network's value of an s_{t+n}"]);
}

#[test]
fn a_target_network_that_overflows_is_an_error_that_changes_nothing() {
    let (mut agent, rows) = (agent(NO_DIM, 16), random_batch(4, 18));
    let weight = agent.target().get("torso.conv1.weight").unwrap();
    let large = Tensor::full(1e38f32, weight.dims(), &Device::Cpu).unwrap();
    weight.set(&large).unwrap();
    check_says(failure(&mut agent, &rows.batch()), &["target network"]);
}

#[test]
fn a_bad_batch_is_an_error_that_changes_nothing() {
    let (mut agent, good) = (agent(ALL_DIM, 19), random_batch(5, 20));
    let mut says = |change: fn(&mut OwnedBatch), said: &str| {
        let mut rows = good.clone();
        change(&mut rows);
        let error = failure(&mut agent, &rows.batch());
        assert!(matches!(error, UpdateError::Batch(_)), "{error}");
        check_says(error, &[said]);
    };
    says(|rows| rows.action[3] = 4, "row 3");
    says(|rows| rows.next_action[2] = 17, "row 2");
    says(|rows| rows.n_step_return[1] = f32::NAN, "row 1");
    says(|rows| rows.n_step_return[1] = f32::INFINITY, "row 1");
    says(|rows| rows.bootstrap_discount[1] = 1.5, "row 1");
    says(|rows| rows.bootstrap_discount[1] = f32::NAN, "row 1");
    says(|rows| rows.states_t.truncate(7), "states_t");
    says(|rows| rows.states_k.truncate(7), "states_k");
    says(|rows| rows.positive_valid.clear(), "0 positives a row");
    says(|rows| *rows = OwnedBatch::default(), "no rows");
}

#[test]
fn arithmetic_that_is_not_finite_is_an_error_that_changes_nothing() {
    let rows = random_batch(5, 21);
    for (compute, poisoned) in [
        (&Compute::CPU, "torso.conv1.weight"),
        (&Compute::CPU, "head.bias"),
        (&Compute::CPU, "dim.psi3.out.weight"),
        (&Compute::CPU, "dim.phi4.hidden.bias"),
        (&CANDLE, "head.bias"),
    ] {
        let mut agent = change_parameters(agent_on(compute, ALL_DIM, 22), |name, values| {
            if name == poisoned {
                values[0] = f32::NAN;
            }
        });
        let error = failure(&mut agent, &rows.batch());
        let is_named = matches!(error, UpdateError::NonFinite { .. });
        assert!(is_named, "{poisoned}: {error}");
    }
}

/// An agent whose parameter `name` became infinite in its last step, and the result of that step.
pub(crate) fn diverged_agent(compute: &Compute, name: &str) -> (Agent, Result<f64, UpdateError>) {
    let mut settings = settings(ALL_DIM);
    settings.adam.lr = 1e33;
    let mut agent = new_agent(model(ALL_DIM), settings, compute, 1);
    let computed = agent.gradients(&random_batch(6, 31).batch()).unwrap();
    let gradient = computed.gradients.get(name).unwrap();
    // The largest finite numbers, so that the next step overflows.
    let direction = gradient.sign().unwrap().affine(-f64::from(f32::MAX), 0.0);
    let var = agent.online().get(name).unwrap();
    var.set(&direction.unwrap()).unwrap();
    let result = agent.apply(&computed.gradients);
    (agent, result)
}

#[test]
fn parameters_that_a_step_took_beyond_the_finite_numbers_are_not_published() {
    for name in ["torso.conv1.weight", "torso.fc.bias", "head.weight"] {
        let (agent, said) = diverged_agent(&Compute::CPU, name);
        let said = said.unwrap_err();
        assert!(matches!(said, UpdateError::Diverged { .. }), "{said}");
        let beyond = format!("update 1 made {name} infinite or NaN");
        check_says(said, &[&beyond, "newest checkpoint"]);
        let refused = |agent: &Agent| agent.weights(WeightDtype::F32).unwrap_err();
        check_says(refused(&agent), &[name, "inf"]);
        // With candle's operations, the error shows only when the weights are exported.
        let (agent, said) = diverged_agent(&CANDLE, name);
        said.unwrap();
        check_says(refused(&agent), &[name, "inf"]);
    }
}

#[test]
fn a_model_whose_heads_the_lambdas_do_not_use_is_refused() {
    let rng = &mut ChaCha8Rng::seed_from_u64(23);
    let error =
        Agent::new(model(ALL_DIM), settings(NO_DIM), &Compute::CPU, rng).expect_err("unused heads");
    assert!(matches!(error, UpdateError::Settings(_)), "{error}");
}
