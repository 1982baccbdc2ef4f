//! How far ahead a positive lies: one file a rule.
//! It does not know the ring: the actions of one window come in, k comes out.

pub mod affinity;
pub mod all;
pub mod fixed;
pub mod nhg;
pub mod uniform;

use driml_protocol::Horizon;
use rand::Rng;

pub use affinity::Affinity;

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
