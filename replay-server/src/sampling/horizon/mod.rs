//! The rules that draw k, the distance from an anchor to its positive: a match arm per rule, and a file for the adaptive one.
//! They do not know the ring: they get the actions of one window and return k.

pub mod affinity;
pub mod nhg;

use driml_protocol::Horizon;
use rand::Rng;

pub use affinity::Affinity;

/// Draws k for an anchor whose next `actions.len()` states lie in its episode and level.
///
/// `actions` are a_t, .., a_{t+H-1} with H = min(k_max, steps left). Result in 1..=H, the furthest of several positives; 0 if H is 0
/// or no positive is served.
/// Source: Mazoure et al. 2020, Deep Reinforcement and InfoMax Learning.
pub(crate) fn draw_k(
    horizon: Horizon,
    affinity: &Affinity,
    actions: &[u8],
    rng: &mut impl Rng,
) -> u32 {
    let furthest = actions.len() as u32;
    if furthest == 0 {
        return 0;
    }
    match horizon {
        Horizon::None {} => 0,
        // DRIML-fix, and CPC, which has a positive for each k up to the furthest.
        Horizon::Fixed { .. } | Horizon::All { .. } => furthest,
        // DRIML-randk.
        Horizon::Uniform { .. } => rng.random_range(1..=furthest),
        Horizon::Nhg { .. } => nhg::draw_k(affinity, actions, rng),
    }
}
