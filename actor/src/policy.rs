//! The policies that choose actions: the network with epsilon-greedy exploration, and uniformly random actions.
//! They do not know the schedule of epsilon, nor where weights come from.

use driml_model::{ModelConfig, PolicyNetwork, Precision, Resizer};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::error::ActError;

/// Chooses one action for each of N states.
pub trait Policy: Send {
    /// Writes actions [N] for `states` [N, H, W, C * stack]; each is random with probability `epsilon`.
    fn act(
        &mut self,
        states: &[u8],
        epsilon: f64,
        rng: &mut ChaCha8Rng,
        actions: &mut [u8],
    ) -> Result<(), ActError>;
}

/// Draws actions uniformly, whatever the state.
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

/// Takes the action with the highest expected return of the C51 network, apart from epsilon and the noise of noisy layers.
///
/// Draws first which actions are random. States with a random action do not pass through the network.
pub struct NetworkPolicy {
    network: PolicyNetwork,
    enlarge: Option<Resizer>,
    num_actions: u8,
    has_noise: bool,
    /// Reused buffers: the environments in which the network chooses the action; their states, if these are not all;
    /// those states enlarged, if the network's input is larger; and the chosen actions.
    greedy_envs: Vec<usize>,
    states: Vec<u8>,
    enlarged: Vec<u8>,
    greedy: Vec<u8>,
}

impl NetworkPolicy {
    /// Creates a policy with the weights of a safetensors file. `enlarge` resizes states to the network's input; `None`
    /// if the sizes are equal. The network computes its products in `precision`.
    pub fn new(
        model: &ModelConfig,
        enlarge: Option<Resizer>,
        safetensors: &[u8],
        precision: Precision,
    ) -> Result<Self, ActError> {
        Ok(Self {
            network: PolicyNetwork::new(model, safetensors, precision)?,
            enlarge,
            num_actions: u8::try_from(model.num_actions).expect("a valid model has at most 255"),
            has_noise: false,
            greedy_envs: Vec::new(),
            states: Vec::new(),
            enlarged: Vec::new(),
            greedy: Vec::new(),
        })
    }

    /// Turns on exploration by the network's noisy layers, if it has any. Each step draws new noise, the same for all
    /// environments, as they pass through the network together. Without noise, the layers use their mean weights.
    ///
    /// Source: Fortunato et al. 2018, section 3.2 (a) and algorithm 1: a new sample before every action.
    #[must_use]
    pub const fn with_noise(mut self) -> Self {
        self.has_noise = true;
        self
    }

    /// Replaces the weights; on an error the old ones stay.
    pub fn set_weights(&mut self, safetensors: &[u8]) -> Result<(), ActError> {
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
        self.greedy_envs.clear();
        for (env, action) in actions.iter_mut().enumerate() {
            if rng.random_bool(epsilon) {
                *action = rng.random_range(0..self.num_actions);
            } else {
                self.greedy_envs.push(env);
            }
        }
        let count = self.greedy_envs.len();
        let mut input = states;
        if count < actions.len() {
            let state_bytes = states.len() / actions.len();
            self.states.clear();
            for &env in &self.greedy_envs {
                let state = &states[env * state_bytes..][..state_bytes];
                self.states.extend_from_slice(state);
            }
            input = &self.states;
        }
        if let Some(enlarge) = &self.enlarge {
            self.enlarged.resize(count * enlarge.output_bytes(), 0);
            enlarge.apply(input, &mut self.enlarged);
            input = &self.enlarged;
        }
        if self.has_noise && count > 0 {
            self.network.draw_noise(rng);
        }
        self.greedy.resize(count, 0);
        self.network.greedy_actions(input, &mut self.greedy)?;
        for (&env, &action) in self.greedy_envs.iter().zip(&self.greedy) {
            actions[env] = action;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use driml_model::{Compute, ConvLayer, HeadConfig, Parameters};
    use rand::SeedableRng;

    use super::*;

    const ACTIONS: usize = 5;
    const STATES: usize = 4000;

    fn model() -> ModelConfig {
        ModelConfig {
            height: 4,
            width: 4,
            num_actions: ACTIONS,
            atoms: 5,
            conv: vec![ConvLayer::new(2, 2, 2)],
            hidden: 4,
            ..ModelConfig::small().without_dim()
        }
    }

    fn policy_with(head: HeadConfig, seed: u64) -> NetworkPolicy {
        let model = ModelConfig { head, ..model() };
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let weights = Parameters::init(&model, rng, &Compute::CPU.device).unwrap();
        let weights = weights.to_safetensors(|_| true).unwrap();
        NetworkPolicy::new(&model, None, &weights, Precision::F32).unwrap()
    }

    /// The actions and the random numbers drawn are the same as if the network chose in every state before random actions replaced some.
    #[test]
    fn states_in_which_chance_decides_need_no_network() {
        let rng = &mut ChaCha8Rng::seed_from_u64(3);
        let states: Vec<u8> = (0..16 * STATES).map(|_| rng.random()).collect();
        // Weights that do not prefer one action in every state.
        let decides = |seed| {
            let mut policy = policy_with(HeadConfig::PLAIN, seed);
            let mut greedy = vec![0; STATES];
            policy.network.greedy_actions(&states, &mut greedy).unwrap();
            let differ = greedy.iter().any(|&action| action != greedy[0]);
            differ.then_some((policy, greedy))
        };
        let (mut policy, greedy) = (1..100).find_map(decides).unwrap();
        for epsilon in [0.0, 0.01, 0.5, 1.0] {
            let mut overruled = greedy.clone();
            let mut separate = rng.clone();
            for action in &mut overruled {
                if separate.random_bool(epsilon) {
                    *action = separate.random_range(0..ACTIONS as u8);
                }
            }
            let mut actions = vec![0; STATES];
            policy.act(&states, epsilon, rng, &mut actions).unwrap();
            assert_eq!(actions, overruled);
            assert_eq!(rng.random::<u64>(), separate.random::<u64>());
            assert_eq!(policy.greedy.len(), policy.greedy_envs.len());
            let share = policy.greedy.len() as f64 / STATES as f64;
            assert!((share - (1.0 - epsilon)).abs() < 0.03, "{share}");
        }
    }

    /// Noise is drawn in every step, from the generator that is saved with the world; without `with_noise` the means act.
    #[test]
    fn noisy_layers_explore_without_epsilon_and_evaluation_has_no_noise() {
        let head = HeadConfig {
            dueling: true,
            noisy_sigma: Some(3.0),
        };
        let states: Vec<u8> = (0..16 * 8).map(|i| (i * 37 % 251) as u8).collect();
        let steps = |policy: &mut NetworkPolicy, rng: &mut ChaCha8Rng| {
            let mut steps = vec![vec![0; 8]; 50];
            for actions in &mut steps {
                policy.act(&states, 0.0, rng, actions).unwrap();
            }
            steps
        };
        let mut means = policy_with(head, 1);
        let greedy = steps(&mut means, &mut ChaCha8Rng::seed_from_u64(1));
        assert!(greedy.iter().all(|actions| *actions == greedy[0]));
        let mut noisy = policy_with(head, 1).with_noise();
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let first = steps(&mut noisy, rng);
        let others = first.iter().filter(|actions| **actions != greedy[0]);
        assert!(others.count() > 25, "{first:?}");
        // The noise depends on the generator's state alone, not on earlier noise.
        let mut again = policy_with(head, 1).with_noise();
        let saved = rng.clone();
        let second = steps(&mut noisy, rng);
        assert_eq!(steps(&mut again, &mut saved.clone()), second);
        assert_ne!(first, second);
    }
}
