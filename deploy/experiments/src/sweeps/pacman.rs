//! Fig. 3: ghosts that can be predicted more or less, and one lethal ghost of four that changes, with and without noise in
//! the walls. Whole runs through all processes; the picture is in `figure`, data and page in `report`.

mod figure;
mod plans;
mod report;
mod results;
mod settings;

use driml_machine::error::usage;

use self::{
    results::Results,
    settings::{NAME, with_flags},
};
use crate::{
    flags::{PacmanArgs, command_line},
    queue,
    runs::PlannedRun,
    session::Session,
};

/// Runs the experiment.
///
/// # Errors
/// Names that nothing has, a folder of other settings, an interrupt, a file system that refuses.
pub(super) fn run(args: &PacmanArgs) -> anyhow::Result<()> {
    let settings = with_flags(args)?;
    let plans = settings.plans();
    let units = plans.iter().map(|(_, _, plan)| plan.units).sum();
    let report_only = args.queue.report;
    let mut session = Session::open_queue(NAME, &args.flags, &settings, units, report_only)?;
    let runs: Vec<PlannedRun> = plans.iter().map(|(_, _, plan)| plan.clone()).collect();
    let ran = queue::run_all(&mut session, &runs, settings.jobs, report_only)?;
    let mut results = Results {
        command: command(args, &session),
        smoke: args.flags.smoke,
        settings,
        runs: Vec::new(),
        missing: Vec::new(),
    };
    for ((kind, seed, plan), ran) in plans.into_iter().zip(ran) {
        match ran {
            Some(ran) => results.runs.push((kind, seed, ran)),
            None => results.missing.push(plan.name),
        }
    }
    if results.runs.is_empty() {
        return Err(usage!("no run is finished yet: there is nothing to report").into());
    }
    report::report(session, &results)?;
    queue::check_made(&results.missing, report_only)
}

fn command(args: &PacmanArgs, session: &Session) -> String {
    let mut words = command_line(NAME, &args.flags, session.folder());
    if !args.agents.is_empty() {
        words += &format!(" --agents {}", args.agents.join(","));
    }
    let numbers = [
        ("--frames", args.frames),
        ("--episodes-per-task", args.episodes_per_task),
        ("--jobs", args.queue.jobs.map(u64::from)),
    ];
    for (flag, number) in numbers {
        if let Some(number) = number {
            words += &format!(" {flag} {number}");
        }
    }
    for set in &args.queue.sets {
        words += &format!(" --set '{set}'");
    }
    words
}
