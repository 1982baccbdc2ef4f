//! The engine for experiments that consist of runs. `axes` spans the combinations; `plan` has the planned runs and their calls; `runs`
//! keeps each run beside the call that made it; `queue` makes the missing runs; `results` plays with their weights; `command` is
//! `driml sweep`. Each sweep that plans runs decides what they mean and what follows from all of them.

mod axes;
pub(crate) mod command;
mod plan;
mod queue;
mod results;
mod runs;

pub(crate) use self::{
    plan::{FinishedRun, PlannedRun, PointPlan, PointRun, TrainCall, install_worlds},
    queue::run_all,
    results::PlaySettings,
    runs::Runs,
};
