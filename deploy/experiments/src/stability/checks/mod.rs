//! The table of properties, with a file for each family of routines: the inputs of each routine, and the reference it is compared with.
//! References are written independently of the routine. A bound is a constant of the routine where the routine has one.

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

/// Returns all properties in the order of the page. Relative errors of values below 1.2e-38 are relative to 1.2e-38.
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
