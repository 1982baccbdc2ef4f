//! Products of the network in f32 and bf16, held to sums of products in float64.
//! The kernels themselves are the model's; what they are made of is tested there, against the stock ones.

mod convolutions;
mod dense;
mod spoilt;
mod sums;

use driml_model::Precision;

use crate::stability::check::{Context, Row};

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    for precision in Precision::ALL {
        rows.extend(dense::check(context, precision)?);
        rows.extend(convolutions::check(context, precision)?);
        rows.extend(spoilt::check(context, precision)?);
    }
    Ok(rows)
}
