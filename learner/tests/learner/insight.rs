//! The inspection of a trained network agrees with the loss that it was trained with.

use driml_learner::{Agent, Compute, Lambda, insight::Insight};

use crate::synthetic::{ALL_DIM, agent, random_batch};

fn insight(agent: &Agent) -> Insight {
    let (model, settings, online) = (agent.model(), agent.settings(), agent.online());
    Insight::new(model, settings, online, Compute::CPU, None).unwrap()
}

#[test]
fn distributions_have_the_network_s_values() {
    let (agent, rows) = (agent(ALL_DIM, 5), random_batch(4, 3));
    let insight = insight(&agent);
    let outputs = insight.evaluate(&rows.states_t).unwrap();
    assert_eq!(outputs.q_values, agent.q_values_t(&rows.batch()).unwrap());
    let support = agent.model().atoms_support();
    assert_eq!(outputs.probabilities.len(), 4 * 4 * support.len());
    let laws = outputs.probabilities.chunks(support.len());
    for (q, law) in outputs.q_values.iter().zip(laws) {
        let mean: f32 = law.iter().zip(&support).map(|(p, z)| p * z).sum();
        assert!((law.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        assert!((mean - q).abs() < 5e-5, "{mean} and {q}");
    }
}

/// The mean of -ln of the probabilities equals the loss of the same states.
#[test]
fn matches_are_what_the_loss_is_made_of() {
    let (agent, mut rows) = (agent(ALL_DIM, 5), random_batch(4, 3));
    rows.positive_valid.fill(1);
    let insight = insight(&agent);
    assert_eq!(insight.f3_shape(), Some((2, 3)));
    let [now, later] = [&rows.states_t, &rows.states_k].map(|it| insight.evaluate(it).unwrap());
    let matches = insight.local_matches(&now, &rows.action, &later).unwrap();
    let matches = matches.expect("this agent compares local features");
    assert_eq!(matches.len(), 4 * 2 * 3);
    let loss = -matches.iter().map(|p| p.ln()).sum::<f64>() / matches.len() as f64;
    let (name, wanted) = agent.gradients(&rows.batch()).unwrap().losses.auxiliary[0];
    assert_eq!(name, "dim_3t3");
    assert!((loss - f64::from(wanted)).abs() < 1e-5, "{loss}, {wanted}");
}

#[test]
fn an_agent_without_the_local_pair_has_no_map() {
    let lambda = Lambda {
        l3t3: 0.0,
        ..ALL_DIM
    };
    let (agent, rows) = (agent(lambda, 5), random_batch(4, 3));
    let insight = insight(&agent);
    let it = insight.evaluate(&rows.states_t).unwrap();
    assert_eq!(insight.f3_shape(), None);
    let matches = insight.local_matches(&it, &rows.action, &it).unwrap();
    assert_eq!(matches, None);
}
