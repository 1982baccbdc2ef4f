//! Who chooses actions: the network with epsilon-greedy exploration, or chance alone.
//! It does not know the schedule of epsilon nor where weights come from.

use driml_model::{Enlarge, ModelConfig, PolicyNetwork};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

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
    ) -> anyhow::Result<()>;
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
    ) -> anyhow::Result<()> {
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
    /// A policy with the weights of a safetensors file; `frame` is (height, width) of a state as it comes.
    ///
    /// # Errors
    /// Weights that do not fit the model.
    pub fn new(
        model: &ModelConfig,
        frame: (usize, usize),
        safetensors: &[u8],
    ) -> anyhow::Result<Self> {
        let input = (model.height, model.width);
        let enlarge = (frame != input)
            .then(|| Enlarge::new(frame, input, model.channels))
            .transpose()?;
        Ok(Self {
            network: PolicyNetwork::new(model, safetensors)?,
            enlarge,
            enlarged: Vec::new(),
            num_actions: u8::try_from(model.num_actions)?,
        })
    }

    /// Replaces the weights; on an error the old ones stay.
    ///
    /// # Errors
    /// Weights that do not fit the model.
    pub fn load(&mut self, safetensors: &[u8]) -> anyhow::Result<()> {
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
    ) -> anyhow::Result<()> {
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
