//! Inspects a trained network: which return it expects in a state, and which locations of a later state it recognises.
//! It trains nothing and chooses no action.

use candle_core::Tensor;
use driml_model::{Compute, Features, ModelConfig, Network, Parameters, Resizer};

use crate::{
    auxiliary::dim::{DIM, HeadVectors},
    error::Result,
    losses::{c51::softmax, scores::ScoreClip},
    settings::UpdateSettings,
    tensors::{states_tensor, to_vec_f32},
};

/// A trained network to inspect.
#[derive(Debug)]
pub struct Insight {
    model: ModelConfig,
    network: Network,
    compute: Compute,
    /// Resizes states to the network's input; `None` if they have its size.
    enlarge: Option<Resizer>,
    /// Bound of the scores' soft clip, if the auxiliary loss compares local features of s_t with local ones of s_{t+k}.
    local_clip: Option<f64>,
}

/// The network's outputs for a batch of states.
#[derive(Debug)]
pub struct NetworkOutputs {
    /// Expected returns [B, A].
    pub q_values: Vec<f32>,
    /// Probabilities [B, A, N] of the returns at the atoms.
    pub probabilities: Vec<f32>,
    features: Features,
}

impl Insight {
    /// Inspects a network with these parameters, which it shares, trained with these settings. Without DIM's local heads it compares no
    /// features. `compute` is on the parameters' device; `enlarge` resizes states to the network's input, `None` if they have its size.
    pub fn new(
        model: &ModelConfig,
        settings: &UpdateSettings,
        parameters: &Parameters,
        compute: Compute,
        enlarge: Option<Resizer>,
    ) -> Result<Self> {
        let is_local = settings.auxiliary_loss.name() == DIM.name
            && settings.lambda.active_pairs()[0]
            && model.dim.psi3
            && model.dim.phi3;
        Ok(Self {
            model: model.clone(),
            network: Network::new(model, parameters, compute.kernels)?,
            compute,
            enlarge,
            local_clip: is_local.then_some(settings.tanh_clip),
        })
    }

    /// Rows and columns of the local features that are compared; `None` if the agent does not compare local features.
    pub fn f3_shape(&self) -> Option<(usize, usize)> {
        let (rows, columns, _) = self.model.f3_shape();
        self.local_clip.map(|_| (rows, columns))
    }

    /// Computes the network's outputs for states [B, H, W, C].
    pub fn evaluate(&self, states: &[u8]) -> Result<NetworkOutputs> {
        let enlarged = self.enlarge.as_ref().map(|it| it.resized(states));
        let input = enlarged.as_deref().unwrap_or(states);
        let states = states_tensor(&self.model, input, &self.compute.device)?;
        let features = self.network.features(&states)?;
        let logits = self.network.logits(&features.f4, None)?;
        let q_values = self.network.q_values(&logits)?;
        let logits = to_vec_f32(&logits)?;
        let mut probabilities = vec![0.0; logits.len()];
        let rows = probabilities.chunks_exact_mut(self.model.atoms);
        for (probabilities, logits) in rows.zip(logits.chunks_exact(self.model.atoms)) {
            softmax(logits, probabilities);
        }
        Ok(NetworkOutputs {
            q_values: to_vec_f32(&q_values)?,
            probabilities,
            features,
        })
    }

    /// Probabilities [B, L], which InfoNCE raises, that local DIM identifies the state that followed; 1 / B is chance. DIM is given the
    /// features of location l in state b of `now` and the action taken there, and picks among location l of all B states in `later`.
    /// `None` if the agent does not compare local features.
    ///
    /// `later` holds s_{t+k} of the s_t in `now`, in the same order. Source: Mazoure et al. 2020, section 4, where the negatives are a
    /// batch's other states.
    pub fn local_matches(
        &self,
        now: &NetworkOutputs,
        actions: &[u8],
        later: &NetworkOutputs,
    ) -> Result<Option<Vec<f64>>> {
        let Some(tanh_clip) = self.local_clip else {
            return Ok(None);
        };
        let actions = Tensor::from_slice(actions, actions.len(), &self.compute.device)?;
        let only_local = [true, false, false, false];
        let (now, later) = (&now.features, &later.features);
        let vectors = HeadVectors::new(&self.network, now, later, &actions, only_local)?;
        let [Some(dots), ..] = vectors.dot_products(only_local)? else {
            return Ok(None);
        };
        let clip = ScoreClip::new(dots.width, tanh_clip);
        let (locations, rows, _) = dots.values.dims3()?;
        let dots = to_vec_f32(&dots.values)?;
        let mut matches = vec![0.0; rows * locations];
        for (index, candidates) in dots.chunks_exact(rows).enumerate() {
            let (location, row) = (index / rows, index % rows);
            let own = clip.score(candidates[row]);
            let others = candidates.iter().map(|&dot| (clip.score(dot) - own).exp());
            matches[row * locations + location] = 1.0 / others.sum::<f64>();
        }
        Ok(Some(matches))
    }
}
