//! How far ahead a positive lies: a line a rule, and a file for the adaptive one.
//! It does not know the ring: the actions of one window come in, k comes out.

pub mod affinity;
pub mod nhg;

use driml_protocol::Horizon;
use rand::Rng;

pub use affinity::Affinity;

/// Draws k for an anchor whose next `actions.len()` states lie in its episode and level.
///
/// `actions` are a_t, .., a_{t+H-1} with H = min(k_max, steps left), at least one. Result in 1..=H, of several positives the
/// furthest; `None` where none is served.
/// Source: Mazoure et al. 2020, Deep Reinforcement and InfoMax Learning.
pub(crate) fn draw_k(
    horizon: Horizon,
    affinity: &Affinity,
    actions: &[u8],
    rng: &mut impl Rng,
) -> Option<u32> {
    let steps_left = actions.len() as u32;
    assert!(steps_left > 0, "an anchor with a positive has a successor");
    match horizon {
        Horizon::None {} => None,
        // DRIML-fix, and CPC, which has a positive for each k up to the furthest.
        Horizon::Fixed { k } | Horizon::All { k_max: k } => Some(k.min(steps_left)),
        // DRIML-randk.
        Horizon::Uniform { k_max } => Some(rng.random_range(1..=k_max.min(steps_left))),
        Horizon::Nhg { k_max } => {
            let walk = &actions[..actions.len().min(k_max as usize)];
            Some(nhg::draw_k(affinity, walk, rng))
        }
    }
}
