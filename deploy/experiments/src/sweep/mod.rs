//! The engine of whatever is made of runs: `axes` spans the combinations, `plan` has the runs and their calls, `runs` keeps each
//! run beside the call that made it, `queue` makes those that are missing, `results` plays with their weights; `command` is `driml sweep`.
//! What a run is for, and what follows from all of them, is for the sweep that plans it.

pub(crate) mod axes;
pub(crate) mod command;
pub(crate) mod plan;
pub(crate) mod queue;
pub(crate) mod results;
pub(crate) mod runs;
