//! The table of properties, a file a family: which inputs a routine gets, and the reference it is held to.
//! References are written without a look at the routine. A bound is a constant of the routine wherever it has one.

mod adam;
mod affinity;
mod augment;
mod c51;
mod epsilon;
mod info_nce;
mod optimiser;
mod products;
mod replay;
mod sampling;
mod stored;
mod update;
mod values;

use super::property::{Property, Settings};

/// All properties, in the order of the page. A share of what is below 1.2e-38 is one of that.
pub(super) fn table(settings: &Settings) -> Vec<Property> {
    let families = [
        c51::properties(),
        values::properties(),
        info_nce::properties(),
        optimiser::properties(),
        adam::properties(settings),
        products::properties(),
        update::properties(),
        augment::properties(),
        stored::properties(),
        affinity::properties(settings),
        sampling::properties(),
        replay::properties(),
        epsilon::properties(),
    ];
    families.into_iter().flatten().collect()
}
