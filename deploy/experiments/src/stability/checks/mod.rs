//! The checks of the properties, a file a family: which inputs a routine gets, and the reference it is held to.
//! References are written without a look at the routine.

pub(super) mod adam;
pub(super) mod affinity;
pub(super) mod augment;
pub(super) mod c51;
pub(super) mod counters;
pub(super) mod info_nce;
pub(super) mod optimiser;
pub(super) mod products;
pub(super) mod refused;
pub(super) mod replay;
pub(super) mod sampling;
pub(super) mod stored;
pub(super) mod update;
pub(super) mod values;
pub(super) mod worlds;
