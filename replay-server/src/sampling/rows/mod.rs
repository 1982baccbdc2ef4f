//! Which transitions are drawn as anchors: a file for each rule of `replay.sampling`.
//! What can be an anchor is decided in `episodes`; what is made of one, in `assemble`.

pub(crate) mod prioritised;
pub(crate) mod sampler;
mod sum_tree;
mod uniform;

use driml_protocol::{RunSpec, Sampling};

use crate::config::reach;
use prioritised::Priorities;
use sampler::RowSampler;
use uniform::Uniform;

/// The sampler of a ring of `capacity` transitions. An error gives the bytes that the system refuses to reserve.
pub(crate) fn sampler(
    sampling: &Sampling,
    spec: &RunSpec,
    capacity: u64,
) -> Result<Box<dyn RowSampler>, u64> {
    Ok(match sampling {
        Sampling::Uniform => Box::new(Uniform::default()),
        Sampling::Prioritised { alpha, .. } => {
            Box::new(Priorities::new(*alpha, capacity, reach(spec))?)
        }
    })
}
