//! Errors of an update change nothing.
//! What a batch from the replay server must be is `served`'s.

use std::collections::HashMap;

use candle_core::{Device, Tensor};
use driml_learner::{Agent, OwnedBatch, UpdateError};
use driml_model::Compute;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::synthetic::{
    ALL_DIM, CANDLE, NO_DIM, agent, agent_on, changed, model, random_batch, settings, values,
};

/// Double DQN, where the online network overflows on s_{t+n} and not on s_t, and the target network on neither.
#[test]
fn a_next_state_whose_values_overflow_is_an_error_that_changes_nothing() {
    let mut settings = settings(NO_DIM);
    settings.double_dqn = true;
    let rng = &mut ChaCha8Rng::seed_from_u64(16);
    let agent = Agent::new(model(NO_DIM), settings, &Compute::CPU, rng).unwrap();
    // Black states have features of the biases alone.
    let mut agent = changed(&agent, |name, values| {
        if name.starts_with("torso") && name.ends_with("weight") {
            values.iter_mut().for_each(|v| *v = v.abs() * 1e15);
        }
    });
    let mut rows = random_batch(4, 18);
    rows.states_t.fill(0);
    let before = values(agent.online());
    let error = agent.update(&rows.batch()).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("the online network's value of an s_{t+n}"),
        "{error}"
    );
    assert_eq!(values(agent.online()), before);
    assert_eq!(agent.updates(), 0);
}

#[test]
fn a_target_network_that_overflows_is_an_error_that_changes_nothing() {
    let (mut agent, rows) = (agent(NO_DIM, 16), random_batch(4, 18));
    let weight = agent.target().get("torso.conv1.weight").unwrap();
    let large = Tensor::full(1e38f32, weight.dims(), &Device::Cpu).unwrap();
    weight.set(&large).unwrap();
    let before = values(agent.online());
    let error = agent.update(&rows.batch()).unwrap_err().to_string();
    assert!(error.contains("target network"), "{error}");
    assert_eq!(values(agent.online()), before);
}

#[test]
fn a_bad_batch_is_an_error_that_changes_nothing() {
    let mut agent = agent(ALL_DIM, 19);
    let before = values(agent.online());
    let good = random_batch(5, 20);
    let mut refused = |change: fn(&mut OwnedBatch), said: &str| {
        let mut rows = good.clone();
        change(&mut rows);
        let error = agent.update(&rows.batch()).expect_err(said);
        assert!(
            matches!(error, UpdateError::Batch(_)) && error.to_string().contains(said),
            "{error}"
        );
    };
    refused(|rows| rows.action[3] = 4, "row 3");
    refused(|rows| rows.next_action[2] = 17, "row 2");
    refused(|rows| rows.n_step_return[1] = f32::NAN, "row 1");
    refused(|rows| rows.n_step_return[1] = f32::INFINITY, "row 1");
    refused(|rows| rows.bootstrap_discount[1] = 1.5, "row 1");
    refused(|rows| rows.bootstrap_discount[1] = f32::NAN, "row 1");
    refused(|rows| rows.states_t.truncate(7), "states_t");
    refused(|rows| rows.states_k.truncate(7), "states_k");
    let mut batch = good.batch();
    batch.positive_valid = &[];
    let error = agent.update(&batch).unwrap_err().to_string();
    assert!(error.contains("positive_valid"), "{error}");
    (batch.positives, batch.states_k, batch.positive_valid) = (0, &[], &[]);
    assert!(agent.update(&batch).is_err());
    batch.rows = 0;
    assert!(agent.update(&batch).is_err());
    assert_eq!(values(agent.online()), before);
    assert_eq!(agent.updates(), 0);
}

#[test]
fn arithmetic_that_is_not_finite_is_an_error_that_changes_nothing() {
    let rows = random_batch(5, 21);
    let bits = |agent: &Agent| -> HashMap<String, Vec<u32>> {
        let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect();
        let all = values(agent.online()).into_iter();
        all.map(|(name, values)| (name, bits(values))).collect()
    };
    for (compute, poisoned) in [
        (&Compute::CPU, "torso.conv1.weight"),
        (&Compute::CPU, "head.bias"),
        (&Compute::CPU, "dim.psi3.out.weight"),
        (&Compute::CPU, "dim.phi4.hidden.bias"),
        (&CANDLE, "head.bias"),
    ] {
        let mut agent = agent_on(compute, ALL_DIM, 22);
        let var = agent.online().get(poisoned).unwrap();
        let mut values: Vec<f32> = var.flatten_all().unwrap().to_vec1().unwrap();
        values[0] = f32::NAN;
        var.set(&Tensor::from_vec(values, var.dims(), &Device::Cpu).unwrap())
            .unwrap();
        let before = bits(&agent);
        let error = agent.update(&rows.batch()).expect_err(poisoned);
        assert!(
            matches!(error, UpdateError::NonFinite { .. }),
            "{poisoned}: {error}"
        );
        assert!(before == bits(&agent) && agent.updates() == 0);
    }
}

/// A learner whose step size is `lr`.
fn fast(compute: &Compute, lr: f64) -> Agent {
    let mut settings = settings(ALL_DIM);
    settings.adam.lr = lr;
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    Agent::new(model(ALL_DIM), settings, compute, rng).unwrap()
}

#[test]
fn a_step_size_beyond_the_finite_numbers_is_an_error_that_changes_nothing() {
    for compute in [&Compute::CPU, &CANDLE] {
        let mut agent = fast(compute, 1e38);
        let before = values(agent.online());
        let error = agent.update(&random_batch(6, 30).batch()).unwrap_err();
        let said = "a step of Adam with lr = 1e38 is not finite";
        assert!(error.to_string().contains(said), "{error}");
        assert_eq!(values(agent.online()), before);
        assert_eq!(agent.updates(), 0);
        agent.weights().unwrap();
    }
}

/// A learner whose parameter `name` a step has just taken beyond the finite numbers, and what that step said.
pub(crate) fn diverged(compute: &Compute, name: &str) -> (Agent, Result<f64, UpdateError>) {
    let mut agent = fast(compute, 3e37);
    let evaluation = agent.evaluate(&random_batch(6, 31).batch()).unwrap();
    let gradient = evaluation.gradients.get(name).unwrap();
    // As large as numbers get; the next step works again.
    let direction = gradient.sign().unwrap().affine(-f64::from(f32::MAX), 0.0);
    let var = agent.online().get(name).unwrap();
    var.set(&direction.unwrap()).unwrap();
    let said = agent.apply(&evaluation.gradients);
    (agent, said)
}

#[test]
fn parameters_that_a_step_took_beyond_the_finite_numbers_are_not_published() {
    for name in ["torso.conv1.weight", "torso.fc.bias", "head.weight"] {
        let (agent, said) = diverged(&Compute::CPU, name);
        let said = said.unwrap_err();
        assert!(matches!(said, UpdateError::Diverged { .. }), "{said}");
        let said = said.to_string();
        assert!(
            said.contains(&format!("update 1 took {name} beyond"))
                && said.contains("newest checkpoint"),
            "{said}"
        );
        let said = agent.weights().unwrap_err().to_string();
        assert!(said.contains(name) && said.contains("inf"), "{said}");
        // Elsewhere than on the CPU it shows when the weights are asked for.
        let (agent, said) = diverged(&CANDLE, name);
        said.unwrap();
        let said = agent.weights().unwrap_err().to_string();
        assert!(said.contains(name) && said.contains("inf"), "{said}");
    }
}

#[test]
fn a_model_whose_heads_the_lambdas_do_not_use_is_refused() {
    let rng = &mut ChaCha8Rng::seed_from_u64(23);
    let error =
        Agent::new(model(ALL_DIM), settings(NO_DIM), &Compute::CPU, rng).expect_err("unused heads");
    assert!(matches!(error, UpdateError::Settings(_)), "{error}");
}
