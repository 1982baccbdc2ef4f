//! Table 1: agents on Procgen's games beside a random policy and the paper's numbers.
//! Runs are made by the engine in `sweep`; data, figure and page are in `report`.

mod report;
mod settings;

use driml_launch::evaluate::Levels;

use self::{
    report::Scored,
    settings::{NAME, Settings},
};
use crate::{
    cache::Session,
    flags::ProcgenArgs,
    sweep::{
        plan::{self, Swept},
        queue,
    },
};

/// Makes the runs, plays with them, and writes the table, the figure and the page.
pub(crate) fn run(args: &ProcgenArgs) -> anyhow::Result<()> {
    let settings = Settings::of(args)?;
    let plans = (1..=settings.seeds).flat_map(|seed| settings.plans(seed));
    let plans: Vec<_> = plans.collect();
    let play = settings.play(Levels::Train);
    // Each run's agent plays, and a random policy beside it.
    let units = plans.len() as u64 * 2 * play.units;
    let report = args.queue.report;
    queue::install(&plans, report)?;
    let mut session = Session::open(NAME, &args.flags, &settings, units, report)?;
    let swept = queue::make(&mut session, plans, settings.jobs, report)?;
    swept.check_any(report)?;
    let Swept { made, missing } = swept;
    let mut scored = Vec::new();
    for made in made {
        let (name, game) = (&made.plan.name, &made.point.game);
        let greedy = play.greedy(&mut session, &format!("{name}-greedy"), &made.run)?;
        let random = play.random(&mut session, &format!("{game}-at-random"), &made.run)?;
        scored.push(Scored::new(made, &greedy.unwrap_or_default(), &random));
    }
    report::write_data(&session, &scored)?;
    session.figure("curves", &report::figure(&settings, &scored)?)?;
    let over_games = report::over_games(&mut session, &settings, &scored)?;
    let values = report::values(&settings, &scored, &over_games, &missing);
    session.finish(include_str!("procgen.md.j2"), values)?;
    plan::check_made(&missing, report)
}
