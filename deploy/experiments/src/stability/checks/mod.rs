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

use super::property::Property;

/// All properties, in the order of the page. A share of what is below 1.2e-38 is one of that.
pub(super) const TABLE: [&[Property]; 13] = [
    c51::PROPERTIES,
    values::PROPERTIES,
    info_nce::PROPERTIES,
    optimiser::PROPERTIES,
    adam::PROPERTIES,
    products::PROPERTIES,
    update::PROPERTIES,
    augment::PROPERTIES,
    stored::PROPERTIES,
    affinity::PROPERTIES,
    sampling::PROPERTIES,
    replay::PROPERTIES,
    epsilon::PROPERTIES,
];
