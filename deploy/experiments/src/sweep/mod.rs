//! The engine for experiments that consist of runs. `axes` spans the combinations; `plan` has the planned runs and their calls; `runs`
//! keeps each run beside the call that made it; `queue` makes the missing runs; `results` plays with their weights; `command` is
//! `driml sweep`. Each sweep that plans runs decides what they mean and what follows from all of them.

pub(crate) mod axes;
pub(crate) mod command;
pub(crate) mod plan;
pub(crate) mod queue;
pub(crate) mod results;
pub(crate) mod runs;
