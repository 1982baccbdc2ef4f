//! What a learned network makes of states: the return it expects, and which patches of a later state it would know again.
//! It learns nothing and chooses no action.

use candle_core::Tensor;
use driml_model::{Compute, Features, ModelConfig, Network, Parameters};

use crate::{
    agent::Agent,
    auxiliary::dim::{DIM, Dim, Vectors, dots_of},
    error::UpdateError,
    losses::c51::softmax,
    settings::LearnerSettings,
    tensors::{flat, states},
};

/// A learned network, to be asked.
#[derive(Debug)]
pub struct Insight {
    model: ModelConfig,
    network: Network,
    compute: Compute,
    /// The auxiliary loss, if it compares local features of s_t with local ones of s_{t+k}.
    local_dim: Option<Dim>,
}

/// What the network makes of a batch of states.
#[derive(Debug)]
pub struct Seen {
    /// Expected returns [B, A].
    pub q_values: Vec<f32>,
    /// Probabilities [B, A, N] of the returns at the atoms.
    pub probabilities: Vec<f32>,
    features: Features,
}

impl Insight {
    /// The network of `agent`, whose parameters it shares, computed as `compute` says; that is to be on the agent's device.
    pub fn of(agent: &Agent, compute: Compute) -> Result<Self, UpdateError> {
        Self::new(agent.model(), agent.settings(), agent.online(), compute)
    }

    /// The network with these parameters, learned with these settings; without DIM's heads it compares no features.
    pub fn new(
        model: &ModelConfig,
        settings: &LearnerSettings,
        parameters: &Parameters,
        compute: Compute,
    ) -> Result<Self, UpdateError> {
        let is_local = settings.auxiliary_loss.name() == DIM.name
            && settings.lambda.wanted()[0]
            && model.dim.psi3
            && model.dim.phi3;
        Ok(Self {
            model: model.clone(),
            network: Network::with_kernels(model, parameters, compute.kernels)?,
            compute,
            local_dim: is_local.then(|| Dim::new(&settings.auxiliary_settings())),
        })
    }

    /// Rows and columns of the local features that are compared; none if this agent compares none.
    pub fn local_shape(&self) -> Option<(usize, usize)> {
        let (rows, columns, _) = self.model.local_shape();
        self.local_dim.map(|_| (rows, columns))
    }

    /// What the network makes of states [B, H, W, C], of its input's size.
    pub fn look(&self, bytes: &[u8]) -> Result<Seen, UpdateError> {
        let features = self
            .network
            .features(&states(&self.model, bytes, &self.compute.device)?)?;
        let logits = self.network.logits(&features.f4)?;
        let q_values = self.network.q_values(&logits)?;
        let logits = flat(&logits)?;
        let mut probabilities = vec![0.0; logits.len()];
        let rows = probabilities.chunks_exact_mut(self.model.atoms);
        for (probabilities, logits) in rows.zip(logits.chunks_exact(self.model.atoms)) {
            softmax(logits, probabilities);
        }
        Ok(Seen {
            q_values: flat(&q_values)?,
            probabilities,
            features,
        })
    }

    /// Probabilities [B, L] with which local DIM, given the features of a location in state b of `now` and the action that was taken
    /// there, picks that location of the state that followed out of those of all B in `later`: what InfoNCE raises. 1 / B is chance;
    /// none where the agent's auxiliary loss is another.
    ///
    /// `later` holds s_{t+k} of the s_t in `now`, in the same order. Source: Mazoure et al. 2020, section 4; its negatives are a
    /// batch's other states.
    ///
    /// # Errors
    /// Batches of different lengths, or an action that there is not.
    pub fn local_matches(
        &self,
        now: &Seen,
        actions: &[u8],
        later: &Seen,
    ) -> Result<Option<Vec<f64>>, UpdateError> {
        let Some(dim) = self.local_dim else {
            return Ok(None);
        };
        let actions = Tensor::from_slice(actions, actions.len(), &self.compute.device)?;
        let only_local = [true, false, false, false];
        let (now, later) = (&now.features, &later.features);
        let vectors = Vectors::new(&self.network, now, later, &actions, only_local)?;
        let (Some(psi), Some(phi)) = (&vectors.psi[0], &vectors.phi[0]) else {
            return Ok(None);
        };
        let dots = dots_of(vectors.kernels, psi, phi)?;
        let scores = dim.scores(dots.width);
        let (locations, rows, _) = dots.dots.dims3()?;
        let dots = flat(&dots.dots)?;
        let mut matches = vec![0.0; rows * locations];
        for (index, candidates) in dots.chunks_exact(rows).enumerate() {
            let (location, row) = (index / rows, index % rows);
            let own = scores.score(candidates[row]);
            let others = candidates
                .iter()
                .map(|&dot| (scores.score(dot) - own).exp());
            matches[row * locations + location] = 1.0 / others.sum::<f64>();
        }
        Ok(Some(matches))
    }
}

#[cfg(test)]
mod tests {
    use driml_model::{PolicyNetwork, Precision};
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    use super::*;
    use crate::Lambda;

    const MODEL: &str = "height = 10\nwidth = 12\ninput_channels = 2\nnum_actions = 3\natoms = 5\nv_min = -1.0\n\
        v_max = 1.0\nconv = [{ out = 4, kernel = 4, stride = 2 }]\nhidden = 8\nembedding_dim = 8\naction_embed = 2\n\
        dim = { psi3 = false, phi3 = false, psi4 = false, phi4 = false, action = false }";
    const UPDATE: &str = "double_dqn = false\nauxiliary_loss = \"dim\"\ncondition_on_action = true\ntanh_clip = 20.0\n\
        lambda = { 3t3 = 0.0, 3t4 = 0.0, 4t3 = 0.0, 4t4 = 1.0 }\nmax_grad_norm = 10.0\ntarget_period_updates = 312\n\
        target_tau = 0.95\nadam = { lr = 1e-3, beta1 = 0.9, beta2 = 0.999, eps = 1e-8 }";

    fn agent(lambda: Lambda) -> Agent {
        let settings: LearnerSettings = toml::from_str(UPDATE).unwrap();
        let settings = LearnerSettings { lambda, ..settings };
        let dim = settings.dim_heads(3);
        let model: ModelConfig = toml::from_str(MODEL).unwrap();
        let model = ModelConfig { dim, ..model };
        let rng = &mut ChaCha8Rng::seed_from_u64(5);
        Agent::new(model, settings, &Compute::CPU, rng).unwrap()
    }

    fn bytes(from: usize) -> Vec<u8> {
        (0..4 * 240)
            .map(|i| ((i + from) * 37 % 251) as u8)
            .collect()
    }

    #[test]
    fn distributions_have_the_values_that_the_network_acts_on() {
        let agent = agent(Lambda::EVERY);
        let insight = Insight::of(&agent, Compute::CPU).unwrap();
        let seen = insight.look(&bytes(0)).unwrap();
        assert_eq!((seen.q_values.len(), seen.probabilities.len()), (12, 60));
        let support = agent.model().atoms_support();
        for (q, probabilities) in seen.q_values.iter().zip(seen.probabilities.chunks(5)) {
            let mean: f32 = probabilities.iter().zip(&support).map(|(p, z)| p * z).sum();
            assert!((probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
            assert!((mean - q).abs() < 1e-5, "{mean} and {q}");
        }
        let weights = agent.weights().unwrap();
        let mut acts = PolicyNetwork::new(agent.model(), &weights, Precision::F32).unwrap();
        let mut values = [0.0; 12];
        acts.q_values(&bytes(0), &mut values).unwrap();
        for (value, q) in values.iter().zip(&seen.q_values) {
            assert!((value - q).abs() < 1e-5);
        }
    }

    /// The mean of -ln of the probabilities is the loss that `Dim` reports for the same states.
    #[test]
    fn matches_are_what_the_loss_is_made_of() {
        let agent = agent(Lambda::EVERY);
        let insight = Insight::of(&agent, Compute::CPU).unwrap();
        assert_eq!(insight.local_shape(), Some((4, 5)));
        let (now, later) = (insight.look(&bytes(0)), insight.look(&bytes(7)));
        let (now, later) = (now.unwrap(), later.unwrap());
        let actions = [0u8, 2, 1, 1];
        let matches = insight
            .local_matches(&now, &actions, &later)
            .unwrap()
            .unwrap();
        assert_eq!(matches.len(), 4 * 20);
        let loss = -matches.iter().map(|p| p.ln()).sum::<f64>() / 80.0;
        let dim = Dim::new(&agent.settings().auxiliary_settings());
        let actions = Tensor::from_slice(&actions, 4, &candle_core::Device::Cpu).unwrap();
        let network = Network::new(agent.model(), agent.online()).unwrap();
        let losses = dim.pair_losses(&network, &now.features, &later.features, &actions, &[1; 4]);
        let wanted: f32 = losses.unwrap()[0].as_ref().unwrap().to_scalar().unwrap();
        assert!(
            (loss - f64::from(wanted)).abs() < 1e-5,
            "{loss} and {wanted}"
        );
    }

    #[test]
    fn an_agent_without_the_local_pair_has_no_map() {
        let lambda = Lambda {
            l3t3: 0.0,
            ..Lambda::EVERY
        };
        let agent = agent(lambda);
        let insight = Insight::of(&agent, Compute::CPU).unwrap();
        let seen = insight.look(&bytes(0)).unwrap();
        assert_eq!(insight.local_shape(), None);
        assert_eq!(insight.local_matches(&seen, &[0; 4], &seen).unwrap(), None);
    }
}
