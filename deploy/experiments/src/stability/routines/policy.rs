//! The action of largest value, as an actor chooses it.
//! Exploration is not here: it never looks at a value.

use driml_model::{ModelConfig, ModelError, PolicyNetwork, Precision, StoredAs};
use rand::Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{finites, shown},
    small,
};

const GREEDY: Routine = Routine {
    name: "greedy action",
    range: "weights finite; 1 to 255 actions",
};

/// A network of two atoms on [-1, 1], whose parameters are four of the torso, then weights and biases of the head.
fn config(num_actions: usize) -> ModelConfig {
    ModelConfig {
        num_actions,
        ..small::config(2, 1, (-1.0, 1.0))
    }
}

fn network(config: &ModelConfig, values: &[f32]) -> anyhow::Result<PolicyNetwork> {
    let parameters = small::parameters(config, values)?;
    let bytes = parameters.to_safetensors_as(StoredAs::F32, |_| true)?;
    Ok(PolicyNetwork::new(config, &bytes, Precision::F32)?)
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let extreme = "drawn logits to 3.4e38, among them equal ones; all 1e38, all -1e38, all 0";
    let mut choice = Row::new(
        GREEDY,
        extreme,
        "how far the value of the action is below the largest, whose f32 may be the same",
        f32::EPSILON.into(),
    );
    let mut ties = Row::new(
        GREEDY,
        extreme,
        "actions of which a lower one has the same logits",
        0.0,
    );
    let mut refused = Row::new(
        GREEDY,
        "weights that take a value beyond 3.4e38 in some rows of a batch",
        "batches that are not refused with the number of the first such row, or refused without one",
        0.0,
    );
    context.draw(0.05, |number, rng| {
        let num_actions = rng.random_range(1..=255usize);
        let config = config(num_actions);
        let len = small::len(&config);
        let logits = match number {
            0 => vec![1e38; num_actions],
            1 => vec![-1e38; num_actions],
            2 => vec![0.0; num_actions],
            _ => finites(num_actions, rng),
        };
        // The logits of an action are biases alone: 0 and this one.
        let mut values = vec![0.0; len];
        let biases = values[len - 2 * num_actions..].chunks_exact_mut(2);
        for (biases, &logit) in biases.zip(&logits) {
            biases[1] = logit;
        }
        let rows = rng.random_range(1..70usize);
        let mut actions = vec![0u8; rows];
        network(&config, &values)?.greedy_actions(&vec![255; rows], &mut actions)?;
        // -1 + 2 / (1 + exp(-logit)).
        let value = |action: usize| (f64::from(logits[action]) / 2.0).tanh();
        let most = (0..num_actions)
            .map(value)
            .fold(f64::NEG_INFINITY, f64::max);
        for action in actions.iter().map(|&action| usize::from(action)) {
            let input = || format!("action {action}, logits {}", shown(&logits));
            choice.see(most - value(action), input);
            ties.must(!logits[..action].contains(&logits[action]), input);
        }

        // Twice the pixel's share of 255 times a weight of 3.4e38, where the pixel is not black.
        let mut values = vec![0.0; len];
        (values[0], values[2]) = (1.0, 2.0);
        values[4 + rng.random_range(0..2 * num_actions)] = f32::MAX;
        let frames: Vec<u8> = (0..rows)
            .map(|_| if rng.random_bool(0.05) { 255 } else { 0 })
            .collect();
        let found = network(&config, &values)?.greedy_actions(&frames, &mut actions);
        let first = frames.iter().position(|&pixel| pixel != 0);
        let right = match (&found, first) {
            (Ok(()), None) => true,
            (Err(ModelError::NotFinite { row }), Some(first)) => *row == first,
            _ => false,
        };
        refused.must(right, || {
            format!("{rows} rows, the first {first:?}: {found:?}")
        });
        Ok(())
    })?;
    Ok(vec![choice, ties, refused])
}
