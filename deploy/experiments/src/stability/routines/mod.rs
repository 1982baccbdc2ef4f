//! The routines that are held to their promises, a file a family, and the menu of them.
//! Each file has its own references in float64, written without a look at the routine; what is promised comes from the routine.

mod adam;
mod affinity;
mod augment;
mod capacity;
mod counters;
mod gradients;
mod horizon;
mod info_nce;
mod ising;
mod losses;
mod policy;
mod prioritised;
mod products;
pub(super) mod refused;
mod replays;
mod returns;
mod stored;
mod target;
mod update;
mod values;
mod walk;

use super::check::{Context, Row};

/// What checks a family.
pub(super) type Check = fn(&mut Context<'_>) -> anyhow::Result<Vec<Row>>;

/// Each family: its name, about the share of the time that it takes, and its check. The order is the page's.
pub(super) const MENU: [(&str, u64, Check); 21] = [
    ("projection", 4, losses::projection),
    ("softmax", 1, losses::softmax),
    ("kl", 2, losses::kl),
    ("values", 2, values::check),
    ("clip", 1, info_nce::clip),
    ("info-nce", 4, info_nce::check),
    ("gradients", 3, gradients::check),
    ("adam", 12, adam::check),
    ("target", 6, target::check),
    ("products", 8, products::check),
    ("update", 8, update::check),
    ("augment", 2, augment::check),
    ("stored", 1, stored::check),
    ("affinity", 12, affinity::check),
    ("horizon", 8, horizon::check),
    ("prioritised", 3, prioritised::check),
    ("returns", 3, returns::check),
    ("capacity", 1, capacity::check),
    ("counters", 2, counters::check),
    ("random-walk", 4, walk::check),
    ("ising", 4, ising::check),
];
