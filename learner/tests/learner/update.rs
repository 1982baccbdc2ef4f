//! Properties of every update, and state that no update may touch.
//! `parity` compares with outside numbers; at extreme inputs, the property "whole update" of `driml experiment stability` does.

use driml_learner::{UpdateNoise, UpdateSettings};
use driml_model::{Compute, HeadConfig, ModelConfig};

use crate::synthetic::{
    ALL_DIM, CANDLE, NO_DIM, agent, agent_on, check_says, model, new_agent, random_batch, settings,
    values,
};

#[test]
fn gradients_hold_nothing_of_the_pass_that_they_come_from() {
    let agent = agent_on(&CANDLE, NO_DIM, 1);
    let computed = agent.gradients(&random_batch(4, 1).batch()).unwrap();
    for (name, _) in agent.online().iter() {
        let gradient = computed.gradients.get(name).unwrap();
        assert!(!gradient.track_op(), "{name}");
    }
}

#[test]
fn learners_of_one_process_do_not_touch_each_other() {
    // The agents share the thread pool: a thread that waits for one agent's products may run a whole update of the other.
    const UPDATES: u64 = 12;
    let learned = |lambda| {
        let mut agent = agent(lambda, 1);
        for seed in 0..UPDATES {
            agent.update(&random_batch(64, seed).batch()).unwrap();
        }
        values(agent.online())
    };
    let alone = [learned(ALL_DIM), learned(NO_DIM)];
    std::thread::scope(|scope| {
        let start = |i: usize| scope.spawn(move || learned([ALL_DIM, NO_DIM][i % 2]));
        let all: Vec<_> = (0..16).map(start).collect();
        for (i, learner) in all.into_iter().enumerate() {
            let learned = learner.join().expect("no learner is refused or panics");
            assert!(learned == alone[i % 2], "learner {i} learnt something else");
        }
    });
}

/// Each of the three networks has its own noise in every update, a function of the seed and the number of the update.
#[test]
fn noise_is_drawn_anew_for_each_update_and_each_network() {
    let settings = UpdateSettings {
        double_dqn: true,
        ..settings(NO_DIM)
    };
    let rows = random_batch(6, 2);
    let agent = |head, seed: u8| {
        let model = ModelConfig {
            head,
            ..model(NO_DIM)
        };
        new_agent(model, settings.clone(), &Compute::CPU, 1).with_noise_seed([seed; 32])
    };
    let [mut one, mut same, other] = [1, 1, 2].map(|seed| agent(HeadConfig::RAINBOW, seed));
    let first = one.noise();
    assert!(first.online.is_some() && first.online != first.double_dqn);
    assert!(first.target != first.online && first.target != first.double_dqn);
    assert!(same.noise() == first && other.noise() != first);
    for _ in 0..2 {
        one.update(&rows.batch()).unwrap();
        same.update(&rows.batch()).unwrap();
    }
    assert!(one.noise() != first && one.noise() == same.noise());
    assert_eq!(values(one.online()), values(same.online()));
    // The means alone, or another noise, give another loss.
    let means = one.gradients_with(&rows.batch(), &UpdateNoise::default());
    let (noisy, means) = (one.gradients(&rows.batch()).unwrap(), means.unwrap());
    assert_ne!(noisy.losses.c51_kl, means.losses.c51_kl);
    assert!(means.gradients.get("head.value.weight_sigma").is_none());
    let plain = agent(HeadConfig::PLAIN, 1);
    assert_eq!(plain.noise(), UpdateNoise::default());
    let refused = plain.gradients_with(&rows.batch(), &first).unwrap_err();
    check_says(refused, &["without noisy layers"]);
}
