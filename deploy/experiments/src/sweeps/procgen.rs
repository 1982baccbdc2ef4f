//! Table 1: agents on Procgen's games beside a random policy and the paper's numbers.
//! Runs are made by the engine in `sweep`; what they gave is in `results`, figure and page in `report`.

mod report;
mod results;
mod settings;

use driml_launch::evaluate::Levels;

use self::{
    results::{Game, Scored},
    settings::{NAME, Settings, short},
};
use super::published::Published;
use crate::{
    cache::Session,
    flags::{ProcgenArgs, this_command},
    page::Page,
    sweep::{
        plan::{Swept, seed_by_seed},
        queue,
    },
};

/// Makes the runs, plays with them, and writes the table, the figure and the page.
pub(crate) fn run(args: &ProcgenArgs) -> anyhow::Result<()> {
    let settings = Settings::of(args)?;
    let plans = seed_by_seed(&settings.points(), settings.seeds, |point, seed| {
        settings.plan(point, seed)
    });
    let play = settings.play(Levels::Train);
    // Each run's agent plays, and a random policy beside it.
    let units = plans.len() as u64 * (settings.frames + 2 * play.units);
    let report = args.queue.report;
    let mut session = Session::open_queue(NAME, &args.flags, &settings, units, report)?;
    let swept = queue::make(&mut session, plans, settings.jobs, report)?;
    swept.check_any()?;
    let Swept { made, missing } = swept;
    let mut scored = Vec::new();
    for made in made {
        let (name, world) = (&made.plan.name, short(&made.point.world));
        let greedy = play.greedy(&mut session, &format!("{name}-greedy"), &made.run)?;
        let random = play.random(&mut session, &format!("{world}-at-random"), &made.run)?;
        scored.push(Scored {
            greedy: greedy.unwrap_or_default(),
            random,
            made,
        });
    }
    let published = Published::read();
    session.csv("table", &results::data(&scored, &published)?)?;
    let games = Game::all(&settings, &scored, &published);
    session.figure("curves", &report::figure(&settings, &games)?)?;
    let over_games = report::over_games(&mut session, &settings, &games, &published)?;
    let mut values = report::page(&settings, &games, &missing);
    values
        .set("count", scored.len())
        .set("planned", scored.len() + missing.len())
        .set("over_games", over_games);
    let template = include_str!("procgen.md");
    session.finish(&Page::new(
        template,
        values,
        &this_command(),
        args.flags.smoke,
    ))?;
    queue::check_made(&missing, report)
}
