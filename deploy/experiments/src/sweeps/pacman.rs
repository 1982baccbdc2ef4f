//! Fig. 3: ghosts that can be predicted more or less, and one lethal ghost of four that changes, with and without noise in
//! the walls. Runs are made by the engine in `sweep`; the picture is in `figure`, data and page in `report`.

mod figure;
mod report;
mod results;
mod settings;

use self::{results::Results, settings::NAME};
use crate::{
    cache::Session,
    flags::{PacmanArgs, this_command},
    page::Page,
    sweep::{plan::seed_by_seed, queue},
};

/// Runs the experiment.
pub(crate) fn run(args: &PacmanArgs) -> anyhow::Result<()> {
    let settings = settings::with_flags(args)?;
    let plans = seed_by_seed(&settings.points(), settings.seeds, |point, seed| {
        settings.plan(point, seed)
    });
    let units = plans.iter().map(|(_, plan)| plan.units).sum();
    let report = args.queue.report;
    let mut session = Session::open_queue(NAME, &args.flags, &settings, units, report)?;
    let swept = queue::make(&mut session, plans, settings.jobs, report)?;
    swept.check_any()?;
    let results = Results::read(settings, swept)?;
    session.figure("fig3", &figure::figure(&results))?;
    report::write_data(&session, &results)?;
    let (template, values) = (include_str!("pacman.md"), report::values(&results));
    let page = Page::new(template, values, &this_command(), args.flags.smoke);
    session.finish(&page)?;
    queue::check_made(&results.missing, report)
}
