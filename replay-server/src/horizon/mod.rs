//! How far ahead a positive lies: one file a rule, and the affinity that the adaptive rule walks along.
//! It does not know the ring: the actions of one window come in, k comes out.

pub mod all;
pub mod fixed;
pub mod nhg;
pub mod uniform;

use driml_protocol::{AffinityUpdate, CodecError, Horizon};
use rand::Rng;

/// Draws k for an anchor whose next `actions.len()` states lie in its episode and level.
///
/// `actions` are a_t, .., a_{t+H-1} with H = min(k_max, steps left), at least one. Result in 1..=H, of several positives the
/// furthest; `None` where none is served.
/// Source: Mazoure et al. 2020, Deep Reinforcement and InfoMax Learning.
pub fn draw_k(
    horizon: Horizon,
    affinity: &Affinity,
    actions: &[u8],
    rng: &mut impl Rng,
) -> Option<u32> {
    let steps_left = actions.len() as u32;
    assert!(steps_left > 0, "an anchor with a positive has a successor");
    match horizon {
        Horizon::None => None,
        Horizon::Fixed { k } => Some(fixed::draw_k(k, steps_left)),
        Horizon::Uniform { k_max } => Some(uniform::draw_k(k_max, steps_left, rng)),
        Horizon::Nhg { k_max } => Some(nhg::draw_k(
            affinity,
            &actions[..actions.len().min(k_max as usize)],
            rng,
        )),
        Horizon::All { k_max } => Some(all::furthest(k_max, steps_left)),
    }
}

/// A[i, j]: how strongly action j is expected after action i; rows are softmaxes.
#[derive(Clone, Debug, PartialEq)]
pub struct Affinity {
    version: u64,
    /// Whether the next matrix is newer whatever its version: it comes from another learner.
    from_another: bool,
    num_actions: u32,
    matrix: Vec<f32>,
}

impl Affinity {
    /// Before the learner's first: the softmax of zeros, 1 / `num_actions` everywhere, version 0.
    pub fn uniform(num_actions: u32) -> Self {
        let n = num_actions as usize;
        Self {
            version: 0,
            from_another: false,
            num_actions,
            matrix: vec![1.0 / num_actions as f32; n * n],
        }
    }

    /// The matrices that come from now on are another learner's, which counts its versions from an earlier update.
    pub fn expect_another_source(&mut self) {
        self.from_another = true;
    }

    /// Takes a newer matrix; one that is not newer is ignored.
    ///
    /// # Errors
    /// A matrix of another size, or with an entry that is no probability.
    pub fn update(&mut self, update: &AffinityUpdate) -> Result<(), CodecError> {
        update.validate(self.num_actions)?;
        if update.version > self.version || self.from_another {
            self.version = update.version;
            self.from_another = false;
            self.matrix.copy_from_slice(&update.matrix);
        }
        Ok(())
    }

    /// Version in use; 0 is the uniform one.
    pub const fn version(&self) -> u64 {
        self.version
    }

    /// A[from, to].
    pub fn get(&self, from: u8, to: u8) -> f32 {
        self.matrix[usize::from(from) * self.num_actions as usize + usize::from(to)]
    }
}
