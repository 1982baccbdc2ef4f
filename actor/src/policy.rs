//! Who chooses actions: the network with epsilon-greedy exploration, or chance alone.
//! It does not know the schedule of epsilon nor where weights come from.

use driml_model::{Enlarge, ModelConfig, PolicyNetwork, Precision};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::error::ActError;

/// Chooses one action for each of N states.
pub trait Policy: Send {
    /// Writes actions [N] for `states` [N, H, W, C * stack]; each is random with probability `epsilon`.
    ///
    /// # Errors
    /// The network failed on these states.
    fn act(
        &mut self,
        states: &[u8],
        epsilon: f64,
        rng: &mut ChaCha8Rng,
        actions: &mut [u8],
    ) -> Result<(), ActError>;
}

/// Uniform over the actions, whatever the state.
#[derive(Debug)]
pub struct RandomPolicy {
    num_actions: u8,
}

impl RandomPolicy {
    /// A policy over `0..num_actions`.
    pub const fn new(num_actions: u8) -> Self {
        Self { num_actions }
    }
}

impl Policy for RandomPolicy {
    fn act(
        &mut self,
        _states: &[u8],
        _epsilon: f64,
        rng: &mut ChaCha8Rng,
        actions: &mut [u8],
    ) -> Result<(), ActError> {
        actions.fill_with(|| rng.random_range(0..self.num_actions));
        Ok(())
    }
}

/// Greedy in the expected return of the C51 network, but for epsilon.
pub struct NetworkPolicy {
    network: PolicyNetwork,
    enlarge: Option<Enlarge>,
    enlarged: Vec<u8>,
    num_actions: u8,
}

impl NetworkPolicy {
    /// A policy with the weights of a safetensors file; `frame` is (height, width) of a state as it comes. Its products are
    /// computed in `precision`.
    ///
    /// # Errors
    /// Weights that do not fit the model.
    pub fn new(
        model: &ModelConfig,
        frame: (usize, usize),
        safetensors: &[u8],
        precision: Precision,
    ) -> Result<Self, ActError> {
        let input = (model.height, model.width);
        let enlarge = (frame != input)
            .then(|| Enlarge::new(frame, input, model.channels))
            .transpose()?;
        Ok(Self {
            network: PolicyNetwork::new(model, safetensors, precision)?,
            enlarge,
            enlarged: Vec::new(),
            num_actions: u8::try_from(model.num_actions).map_err(|_| ActError::TooManyActions {
                actions: model.num_actions,
            })?,
        })
    }

    /// Replaces the weights; on an error the old ones stay.
    ///
    /// # Errors
    /// Weights that do not fit the model.
    pub fn load(&mut self, safetensors: &[u8]) -> Result<(), ActError> {
        Ok(self.network.load(safetensors)?)
    }
}

impl Policy for NetworkPolicy {
    fn act(
        &mut self,
        states: &[u8],
        epsilon: f64,
        rng: &mut ChaCha8Rng,
        actions: &mut [u8],
    ) -> Result<(), ActError> {
        let input = match &self.enlarge {
            None => states,
            Some(enlarge) => {
                self.enlarged
                    .resize(actions.len() * enlarge.output_bytes(), 0);
                enlarge.apply(states, &mut self.enlarged);
                &self.enlarged
            }
        };
        self.network.greedy_actions(input, actions)?;
        for action in actions {
            if rng.random_bool(epsilon) {
                *action = rng.random_range(0..self.num_actions);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use driml_model::{Compute, ConvLayer, DimHeads, Parameters};
    use rand::SeedableRng;

    use super::*;

    const ACTIONS: usize = 5;
    const STATES: usize = 4000;

    fn policy() -> NetworkPolicy {
        let model = ModelConfig {
            height: 4,
            width: 4,
            channels: 1,
            num_actions: ACTIONS,
            atoms: 5,
            v_min: -1.0,
            v_max: 1.0,
            conv: vec![ConvLayer {
                out: 2,
                kernel: 2,
                stride: 2,
            }],
            hidden: 4,
            rkhs: 4,
            action_embed: 4,
            dim: DimHeads::NONE,
        };
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let weights = Parameters::init(&model, rng, &Compute::CPU.device).unwrap();
        let weights = weights.to_safetensors(|_| true).unwrap();
        NetworkPolicy::new(&model, (4, 4), &weights, Precision::F32).unwrap()
    }

    /// How often each action is chosen in `STATES` equal states.
    fn counts(policy: &mut dyn Policy, epsilon: f64) -> [usize; ACTIONS] {
        let rng = &mut ChaCha8Rng::seed_from_u64(2);
        let mut actions = vec![0; STATES];
        policy
            .act(&[9; 16 * STATES], epsilon, rng, &mut actions)
            .unwrap();
        let mut counts = [0; ACTIONS];
        actions
            .iter()
            .for_each(|&action| counts[usize::from(action)] += 1);
        counts
    }

    /// Chi-square against these shares, four degrees of freedom: above 18.5 once in a thousand.
    fn check_shares(counts: [usize; ACTIONS], shares: [f64; ACTIONS]) {
        let squares = counts.iter().zip(shares).map(|(&count, share)| {
            let expected = share * STATES as f64;
            (count as f64 - expected).powi(2) / expected
        });
        let chi_square: f64 = squares.sum();
        assert!(chi_square < 18.5, "{counts:?}, not {shares:?}");
    }

    #[test]
    fn each_action_is_random_with_probability_epsilon_and_else_greedy() {
        let mut policy = policy();
        let greedy = counts(&mut policy, 0.0);
        let best = greedy.iter().position(|&count| count > 0).unwrap();
        assert_eq!(greedy[best], STATES);
        for epsilon in [0.1, 0.5, 1.0] {
            // Chance may choose the greedy action too.
            let mut shares = [epsilon / ACTIONS as f64; ACTIONS];
            shares[best] += 1.0 - epsilon;
            check_shares(counts(&mut policy, epsilon), shares);
        }
    }

    #[test]
    fn the_random_policy_knows_no_epsilon() {
        let shares = [0.2; ACTIONS];
        check_shares(counts(&mut RandomPolicy::new(ACTIONS as u8), 0.0), shares);
    }
}
