//! Counts the operations of one update, by part, from the network's layers and the auxiliary loss's passes through them.
//! It measures nothing; `driml bench learner` measures speed.

use driml_model::{LayerCost, ModelConfig};

use crate::{auxiliary::loss::Passes, config::Config};

/// How an update uses its networks, and for how many rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UpdateShape {
    /// Rows of the batch, B.
    pub rows: u64,
    /// Whether the C51 head computes the distributions of all actions in s_t. The loss reads only that of the taken action.
    pub every_action: bool,
    /// Whether the online network chooses the action in s_{t+n}.
    pub double_dqn: bool,
    /// The auxiliary loss's passes through the networks.
    pub passes: Passes,
}

impl UpdateShape {
    /// The shape for a learner with these settings, if the replay server serves `positives` later states per row. An auxiliary loss with
    /// invalid settings counts as no passes.
    pub fn for_learner(learner: &Config, positives: usize) -> Self {
        let passes = learner.update.make_auxiliary_loss().map_or_else(
            |_| Passes::default(),
            |loss| loss.passes(positives, learner.augment.is_some()),
        );
        Self {
            rows: learner.batch_size.into(),
            every_action: false,
            double_dqn: learner.update.double_dqn,
            passes,
        }
    }
}

/// Operations of one update, for all rows, by part: the multiplications and additions of matrix products alone, each counted as one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UpdateCost([(&'static str, u64); 8]);

impl UpdateCost {
    /// The cost of an update of `shape` with the network `model`.
    pub fn compute(model: &ModelConfig, shape: &UpdateShape) -> Self {
        let layers = model.layer_costs();
        let sum = |parts: &[&str], cost: fn(&LayerCost) -> u64| -> u64 {
            let of_parts = |layer: &&LayerCost| parts.iter().any(|part| layer.is_in(part));
            layers.iter().filter(of_parts).map(cost).sum()
        };
        let forward = |parts: &[&str]| sum(parts, |layer| layer.forward);
        let learning = |parts: &[&str]| sum(parts, |layer| layer.forward + layer.backward);
        let (rows, passes) = (shape.rows, shape.passes);
        let actions = if shape.every_action {
            1
        } else {
            model.num_actions as u64
        };
        let (height, width, _) = model.f3_shape();
        let matrices = passes.local_scores * (height * width) as u64 + passes.global_scores;
        // The forward product and the gradients of both operands; keys have no gradient.
        let products = if passes.keys > 0 { 2 } else { 3 };
        let value = rows * forward(&["torso", "head"]);
        let choice = value * u64::from(shape.double_dqn);
        // A loss's extra layers count once per row.
        let loss_layers = model.loss_layers.iter().map(|it| learning(&[&it.prefix()]));
        let heads = passes.psi * learning(&["dim.psi3", "dim.psi4", "dim.action"])
            + passes.phi * learning(&["dim.phi3", "dim.phi4"])
            + loss_layers.sum::<u64>();
        let states = passes.states * learning(&["torso"]);
        let keys = passes.keys * forward(&["torso", "dim.psi4"]);
        let scores = products * matrices * rows * rows * model.embedding_dim as u64;
        // Forward and backward, but for the target network, the choice of an action by double DQN, and keys.
        Self([
            ("s_t, torso", rows * learning(&["torso"])),
            ("s_t, C51 head", rows * learning(&["head"]) / actions),
            // Rows that do not bootstrap count here, although an update skips them.
            ("s_{t+n}, target network", value),
            ("s_{t+n}, online network", choice),
            // Augmented states and positives.
            ("more states, torso", rows * states),
            ("states, key encoder", rows * keys),
            ("psi and phi", rows * heads),
            // Dot products of all pairs of rows, and their gradients.
            ("scores", 2 * scores),
        ])
    }

    /// All parts, with their names in a table.
    pub const fn parts(&self) -> [(&'static str, u64); 8] {
        self.0
    }

    /// The sum of all parts.
    pub fn total(&self) -> u64 {
        self.0.iter().map(|it| it.1).sum()
    }
}

#[cfg(test)]
mod tests {
    use driml_model::{ConvLayer, DimHeads};

    use super::*;
    use crate::auxiliary::settings::Lambda;

    /// Input 6 x 6 x 1, local features 2 x 2 x 3, 5 values in f4, embedding_dim 4, 2 actions of 3 atoms.
    fn model(dim: DimHeads) -> ModelConfig {
        ModelConfig {
            height: 6,
            width: 6,
            num_actions: 2,
            atoms: 3,
            conv: vec![ConvLayer::new(3, 4, 2)],
            hidden: 5,
            embedding_dim: 4,
            dim,
            ..ModelConfig::small()
        }
    }

    #[test]
    fn an_update_of_a_small_network_is_counted_as_by_hand() {
        let (conv, fc, head) = (2 * 4 * 3 * 16, 2 * 12 * 5, 2 * 5 * 6);
        let value = conv + fc + head;
        let c51 = UpdateShape {
            rows: 10,
            every_action: false,
            double_dqn: false,
            passes: Passes::default(),
        };
        let counts = |model: &ModelConfig, shape: &UpdateShape| {
            let parts = UpdateCost::compute(model, shape).parts();
            parts.map(|it| it.1)
        };
        // The input needs no gradient.
        let torso = 10 * (2 * conv + 3 * fc);
        // One of the two actions.
        let plain: [u64; 8] = [torso, 10 * 3 * head / 2, 10 * value, 0, 0, 0, 0, 0];
        assert_eq!(counts(&model(DimHeads::NONE), &c51), plain);

        let lambda = Lambda::from_values([1.0, 0.0, 0.0, 1.0]);
        let passes = Passes::for_pairs(lambda, 2, true);
        let dim = UpdateShape {
            every_action: true,
            double_dqn: true,
            passes,
            ..c51
        };
        // Forward alone. Psi receives features and the action's embedding, which is computed once for all four locations.
        let action = (2 * 2 * 2, 2 * (2 * 2 + 2 * 2));
        let psi3 = 2 * (2 * (4 * 3 * 4 + 2 * 4) + 4 * 4 * 4);
        let phi3 = 2 * (2 * (4 * 3 * 4) + 4 * 4 * 4);
        let psi4 = 2 * (2 * (5 * 4 + 2 * 4) + 4 * 4);
        let phi4 = 2 * (2 * (5 * 4) + 4 * 4);
        let heads = 3 * (action.0 + psi3 + psi4) + 2 * action.1 + 2 * 3 * (phi3 + phi4);
        // Two positives, at four locations and of the global features.
        let scores = 3 * 2 * 2 * (4 + 1) * 10 * 10 * 4;
        let (head, value) = (10 * 3 * head, 10 * value);
        // Two positives and the augmented s_t.
        let expected: [u64; 8] = [torso, head, value, value, 3 * torso, 0, 10 * heads, scores];
        let model = model(lambda.dim_heads(true));
        assert_eq!(counts(&model, &dim), expected);
        let total = UpdateCost::compute(&model, &dim).total();
        assert_eq!(total, expected.iter().sum::<u64>());
    }

    #[test]
    fn a_key_is_encoded_forward_alone() {
        let heads = DimHeads {
            psi4: true,
            ..DimHeads::NONE
        };
        let shape = UpdateShape {
            rows: 10,
            every_action: false,
            double_dqn: false,
            passes: Passes {
                states: 1,
                keys: 1,
                psi: 1,
                global_scores: 1,
                ..Passes::default()
            },
        };
        let psi4 = 2 * (2 * 5 * 4 + 4 * 4);
        let [.., keys, heads, scores] = UpdateCost::compute(&model(heads), &shape).parts();
        assert_eq!(keys.1, 10 * (2 * 4 * 3 * 16 + 2 * 12 * 5 + psi4));
        assert_eq!(heads.1, 10 * 3 * psi4);
        assert_eq!(scores.1, 2 * 2 * 10 * 10 * 4);
    }
}
