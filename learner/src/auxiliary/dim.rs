//! Deep InfoMax: InfoNCE between features of (s_t, a_t) and of s_{t+k}, for up to four pairs of levels.
//! It holds no parameters (the model does) and masks rows only by `positive_valid`.

use candle_core::Tensor;
use driml_model::{DimHeads, Features, Kernels, Network};

use super::{
    loss::{AuxiliaryLoss, LossInputs, MenuItem, Passes, WeightedLoss},
    positives::Positives,
    settings::{AuxiliarySettings, Lambda},
};
use crate::{
    batch::Batch,
    deduplicate::StateBytes,
    error::Result,
    losses::{info_nce::info_nce_loss, scores::DotProducts},
};

/// The menu item of DIM.
pub const DIM: MenuItem = MenuItem {
    name: "dim",
    positives: Positives::One,
    loss_names: &NAMES,
    make: |settings| Ok(Box::new(Dim::new(settings)?)),
};

/// The name under which each pair's loss is reported, in the order of `settings::PAIRS`.
const NAMES: [&str; 4] = ["dim_3t3", "dim_3t4", "dim_4t3", "dim_4t4"];

/// The DIM loss's settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dim {
    /// Weights of the pairs.
    pub lambda: Lambda,
    /// Bound c of the scores' soft clip `c * tanh(x / c)`.
    pub tanh_clip: f64,
}

impl Dim {
    /// Creates the loss from settings; at least one lambda must be above 0.
    pub fn new(settings: &AuxiliarySettings<'_>) -> Result<Self> {
        settings.check_no_own_table()?;
        settings.check_any_pair_active()?;
        Ok(Self {
            lambda: settings.lambda,
            tanh_clip: settings.tanh_clip,
        })
    }

    /// Computes the losses of the pairs with a weight above 0.
    ///
    /// `features_t` of s_t, `features_k` of s_{t+k}, `action` [B], `valid` [B]: a row with 0 is neither anchor nor
    /// candidate. Source: Mazoure et al. 2020, section 4; InfoNCE, scale and clip are `losses::info_nce`'s.
    pub fn pair_losses(
        &self,
        network: &Network,
        features_t: &Features,
        features_k: &Features,
        action: &Tensor,
        valid: &[u8],
    ) -> Result<Vec<WeightedLoss>> {
        let active = self.lambda.active_pairs();
        let vectors = HeadVectors::new(network, features_t, features_k, action, active)?;
        let pairs = NAMES.into_iter().zip(self.lambda.values());
        let mut losses = Vec::new();
        for ((name, weight), dots) in pairs.zip(vectors.dot_products(active)?) {
            if let Some(dots) = dots {
                losses.push(WeightedLoss {
                    name,
                    weight,
                    loss: info_nce_loss(&dots, valid, self.tanh_clip, network.kernels())?,
                    dot_products: vec![dots],
                });
            }
        }
        Ok(losses)
    }
}

impl AuxiliaryLoss for Dim {
    fn heads(&self, action: bool) -> DimHeads {
        self.lambda.dim_heads(action)
    }

    fn passes(&self, positives: usize, augmented: bool) -> Passes {
        Passes::for_pairs(self.lambda, positives, augmented)
    }

    /// A row without a positive keeps its place with a blank state, so that anchors and candidates stay aligned. Its results are masked.
    fn later_states<'a>(&self, batch: &Batch<'a>, state_bytes: usize) -> Vec<StateBytes<'a>> {
        batch.positive_states(state_bytes)
    }

    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>> {
        let Some(later) = &inputs.features.later else {
            return Ok(Vec::new());
        };
        self.pair_losses(
            inputs.online,
            &inputs.features.anchors,
            later,
            &inputs.action()?,
            inputs.batch.positive_valid,
        )
    }
}

/// The heads' vectors of anchors (psi) and candidates (phi), from local features [B, L, R] and from global features [B, R]; `None` if
/// they are not compared.
#[derive(Clone, Debug)]
pub struct HeadVectors {
    /// The kernels that multiply the vectors.
    pub kernels: Kernels,
    /// Psi_3 and Psi_4 of the anchors.
    pub psi: [Option<Tensor>; 2],
    /// Phi_3 and Phi_4 of the candidates.
    pub phi: [Option<Tensor>; 2],
}

impl HeadVectors {
    /// Computes the vectors that the `active` pairs need; `network` has their heads.
    pub fn new(
        network: &Network,
        features_t: &Features,
        features_k: &Features,
        action: &Tensor,
        active: [bool; 4],
    ) -> Result<Self> {
        let heads = Lambda::heads_for_pairs(active, true);
        let psi3 = heads
            .psi3
            .then(|| network.psi3(features_t.require_f3()?, action));
        let phi3 = heads.phi3.then(|| network.phi3(features_k.require_f3()?));
        let psi4 = heads.psi4.then(|| network.psi4(&features_t.f4, action));
        let phi4 = heads.phi4.then(|| network.phi4(&features_k.f4));
        Ok(Self {
            kernels: network.kernels(),
            psi: [psi3.transpose()?, psi4.transpose()?],
            phi: [phi3.transpose()?, phi4.transpose()?],
        })
    }

    /// Dot products for the `active` pairs whose vectors exist, in the order of `settings::PAIRS`. Anchors and candidates are equally many.
    ///
    /// Local features are compared with local features of the same location, a global feature with every location.
    pub fn dot_products(&self, active: [bool; 4]) -> candle_core::Result<[Option<DotProducts>; 4]> {
        let mut dots = [const { None }; 4];
        for pair in (0..4).filter(|&pair| active[pair]) {
            if let (Some(psi), Some(phi)) = (&self.psi[pair / 2], &self.phi[pair % 2]) {
                dots[pair] = Some(dot(self.kernels, psi, phi)?);
            }
        }
        Ok(dots)
    }
}

/// Computes the dot products of `psi` of anchors and `phi` of candidates, each [B, L, R] or [B, R].
pub fn dot(kernels: Kernels, psi: &Tensor, phi: &Tensor) -> candle_core::Result<DotProducts> {
    Ok(DotProducts {
        values: kernels.dot_products(psi, phi)?,
        width: psi.dims()[psi.rank() - 1],
    })
}
