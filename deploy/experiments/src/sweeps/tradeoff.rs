//! `driml tradeoff`: what each dial that buys speed costs in accuracy, and the other way round, from short trainings of whole runs,
//! one dial turned at a time, and benches of single updates beside them.
//! The menu of dials is in `dials`, what fits a budget in `plan`, data, figures and page in `report`.

mod cells;
mod dials;
mod equal_time;
mod exactness;
mod figures;
mod held;
mod page;
mod plan;
mod report;
mod results;
mod settings;
mod speed;

use std::{collections::BTreeMap, time::Instant};

use driml_launch::{
    console::{self, print},
    evaluate::Levels,
};
use driml_machine::{error::usage, units::rough_duration};

use self::{
    dials::Point,
    plan::{Candidate, Cost},
    results::{LevelOf, PointResult, Results, SeedResult},
    settings::{Common, Settings},
    speed::{Effort, Speed},
};
use crate::{
    cache::{self, Session},
    flags::{TradeoffArgs, this_command},
    stats::Spread,
    sweep::{
        plan::{Made, Planned as PlannedAt, Swept},
        queue,
        results::Played,
        runs::Runs,
    },
};

/// The piece that lists the calls.
const CALLS: &str = "calls";
/// Seeds up to which finished runs are looked for.
const SEEDS_FOUND_MAX: u32 = 64;
/// A piece of measuring as a share of a run's work; only the estimate of the time left depends on it.
const PIECE_SHARE: u64 = 20;
/// What a run takes beside its updates and actions, as a factor: replay, messages, waiting for one another.
const OVERHEAD: f64 = 1.3;
/// Seconds that processes take to start, and to save and end.
const START_SECONDS: f64 = 4.0;

/// A level with all that the plan knows of it.
struct Planned {
    of: LevelOf,
    candidate: Candidate,
    chosen: bool,
}

/// Plans, benches, trains, and writes the page.
pub(crate) fn run(args: &TradeoffArgs) -> anyhow::Result<()> {
    let name = folder_name(args)?;
    let found: Option<Common> = cache::settings_of(&name, &args.flags);
    let mut settings = settings::of(args, found)?;
    let report_only = args.queue.report;
    if !report_only {
        let base = settings.common.config(&settings.dials[0].base_point())?;
        base.world.install(&mut console::line)?;
    }
    let effort = Effort::of(args.flags.smoke);
    let started = Instant::now();
    if settings.frames_open {
        shorten(&mut settings, effort)?;
    }
    let mut session = Session::open_queue(&name, &args.flags, &settings.common, 0, report_only)?;
    let speeds = speeds(&mut session, &settings, effort, report_only)?;
    let left = settings.budget_seconds - started.elapsed().as_secs_f64();
    let planned = planned(
        &session,
        &settings,
        &speeds,
        args,
        left.max(0.0),
        report_only,
    )?;
    if !report_only {
        print(&describe(&settings, &planned, left))?;
    }
    if args.plan {
        return Ok(());
    }
    let results = made(&mut session, settings, args, &planned, speeds)?;
    let missing = results.missing.clone();
    if results.points.is_empty() {
        return Err(usage!(
            "no run is finished yet, and none fits into the budget: there is nothing to report"
        )
        .into());
    }
    if results.levels.is_empty() {
        queue::check_made(&missing, report_only)?;
        return Err(usage!(
            "no level has a finished run beside its base's, and none fits into the budget: there is nothing to report"
        )
        .into());
    }
    report::report(session, &results)?;
    queue::check_made(&missing, report_only)
}

fn folder_name(args: &TradeoffArgs) -> anyhow::Result<String> {
    let world = driml_settings::presets::world(&args.env).map_err(|e| usage!("--env: {e}"))?;
    Ok(format!(
        "tradeoff-{}",
        world.to_string().replace("procgen:", "")
    ))
}

/// Makes the runs shorter if not even the first level fits into the budget.
fn shorten(settings: &mut Settings, effort: Effort) -> anyhow::Result<()> {
    let Some(dial) = settings.dials.first() else {
        return Ok(());
    };
    let (base, level) = (dial.base_point(), dial.point(&dial.levels[0]));
    let mut seconds = 0.0;
    let base_config = settings.common.config(&base)?;
    for (point, is_base) in [(&base, true), (&level, false)] {
        let config = settings.common.config(point)?;
        let speed = speed::measure(&base_config, &config, effort)?;
        seconds += f64::from(settings.seeds_of(is_base)) * estimate(&config, &speed);
    }
    settings.common.frames = plan::frames(settings.common.frames, seconds, settings.budget_seconds);
    Ok(())
}

/// Seconds of a run, about.
fn estimate(config: &driml_settings::config::RunConfig, speed: &Speed) -> f64 {
    let updates = config.updates() as f64 * speed.update_seconds;
    let actions = config.frames() as f64 * speed.act_seconds;
    START_SECONDS + OVERHEAD * (updates + actions)
}

/// The bench of every level that is asked for and of its base, by the point's key; for a report those that are there.
fn speeds(
    session: &mut Session,
    settings: &Settings,
    effort: Effort,
    report_only: bool,
) -> anyhow::Result<BTreeMap<String, Speed>> {
    let mut speeds = BTreeMap::new();
    let units = settings.common.frames / PIECE_SHARE;
    let program = cache::program()?;
    for dial in all_dials(settings)? {
        let base = dial.base_point();
        let asked = settings.dials.iter().any(|it| it.name == dial.name);
        let base_config = settings.common.config(&base)?;
        let levels = dial.levels.iter().map(|level| dial.point(level));
        for point in std::iter::once(base.clone()).chain(levels) {
            if speeds.contains_key(&point.key) {
                continue;
            }
            let key = format!("speed-{}", point.key);
            if report_only || !asked {
                // Of whatever program made it: only what is asked for is made anew.
                if let Some(speed) = session.kept_piece(&key) {
                    speeds.insert(point.key, speed);
                }
                continue;
            }
            let config = settings.common.config(&point)?;
            session.work().1.again(units);
            let speed = session.piece_of(&program, &key, units, |progress| {
                let speed = speed::measure(&base_config, &config, effort)?;
                progress.advance(units)?;
                Ok(speed)
            })?;
            speeds.insert(point.key, speed);
        }
    }
    Ok(speeds)
}

/// The dials of the world, asked for or not: those that have runs are on the page.
fn all_dials(settings: &Settings) -> anyhow::Result<Vec<dials::Dial>> {
    let world = driml_settings::presets::world(&settings.common.env)?;
    Ok(dials::dials(world))
}

/// Every level of every dial, what it would cost, and whether it is run.
fn planned(
    session: &Session,
    settings: &Settings,
    speeds: &BTreeMap<String, Speed>,
    args: &TradeoffArgs,
    budget_seconds: f64,
    report_only: bool,
) -> anyhow::Result<Vec<Planned>> {
    let runs = Runs::open(session.folder())?;
    // Seconds of this machine for each finished run of a point.
    let taken = |point: &Point, seeds: u32| {
        let plans = (1..=seeds).map(|seed| settings.common.run(point, seed));
        let finished = plans.filter_map(|plan| runs.finished(&plan));
        let seconds =
            finished.map(|ran| ran.summary.wall_seconds / f64::from(settings.common.jobs));
        Spread::of(seconds)
    };
    let estimated = |point: &Point| -> anyhow::Result<Option<f64>> {
        let config = settings.common.config(point)?;
        Ok(speeds.get(&point.key).map(|speed| estimate(&config, speed)))
    };
    let cost = |point: &Point, base: &Point| -> anyhow::Result<Cost> {
        let seeds = settings.seeds_of(point == base);
        let own = taken(point, seeds);
        let unfinished = seeds as usize - own.map_or(0, |it| it.count);
        let each = match own {
            Some(own) => own.mean,
            // What a finished base took corrects what a bench lets expect.
            None => {
                let corrected = taken(base, settings.seeds_of(true)).zip(estimated(base)?);
                let factor = corrected.map_or(1.0, |(taken, estimated)| taken.mean / estimated);
                estimated(point)?.map_or(f64::INFINITY, |seconds| factor * seconds)
            }
        };
        Ok(Cost {
            key: point.key.clone(),
            seconds: match unfinished {
                0 => 0.0,
                several => each * several as f64,
            },
        })
    };
    let mut planned = Vec::new();
    for dial in all_dials(settings)? {
        for level in &dial.levels {
            let (base, point) = (dial.base_point(), dial.point(level));
            let candidate = Candidate {
                base: cost(&base, &base)?,
                level: cost(&point, &base)?,
            };
            planned.push(Planned {
                of: LevelOf {
                    dial: dial.clone(),
                    level: level.name.clone(),
                    base,
                    point,
                },
                candidate,
                chosen: false,
            });
        }
    }
    let asked = |it: &Planned| {
        !report_only && (args.dials.is_empty() || args.dials.contains(&it.of.dial.name))
    };
    let wanted: Vec<usize> = (0..planned.len())
        .filter(|&at| asked(&planned[at]))
        .collect();
    let candidates: Vec<Candidate> = wanted
        .iter()
        .map(|&at| planned[at].candidate.clone())
        .collect();
    let fits = plan::fit(&candidates, budget_seconds);
    for (&at, fits) in wanted.iter().zip(fits) {
        planned[at].chosen = fits;
    }
    Ok(planned)
}

/// What is printed of the plan before anything is run.
fn describe(settings: &Settings, planned: &[Planned], left: f64) -> String {
    let Common {
        env, frames, sets, ..
    } = &settings.common;
    let mut text = format!(
        "world       {env}, {frames} frames a run, seeds 1 to {}\nsettings    preset {} with {}\n",
        settings.seeds,
        settings.common.preset,
        sets.join(", ")
    );
    let candidates: Vec<_> = planned.iter().map(|it| it.candidate.clone()).collect();
    let chosen: Vec<_> = planned.iter().map(|it| it.chosen).collect();
    let asked: Vec<&str> = settings.dials.iter().map(|it| it.name.as_str()).collect();
    for it in planned
        .iter()
        .filter(|it| asked.contains(&it.of.dial.name.as_str()))
    {
        let seconds = it.candidate.level.seconds;
        let what = match (it.chosen, seconds) {
            (true, 0.0) => "finished".to_owned(),
            (true, seconds) => format!("about {}", rough_duration(seconds)),
            (false, seconds) => format!("does not fit, about {}", rough_duration(seconds)),
        };
        text += &format!(
            "level       {} = {}: {what}\n",
            it.of.dial.name, it.of.level
        );
    }
    text + &format!(
        "time        about {} of runs, with their bases, of {} that are left of the budget\n",
        rough_duration(plan::seconds(&candidates, &chosen)),
        rough_duration(left.max(0.0))
    )
}

/// Makes the chosen runs and plays with their weights, and those that are there already.
fn made(
    session: &mut Session,
    settings: Settings,
    args: &TradeoffArgs,
    planned: &[Planned],
    speeds: BTreeMap<String, Speed>,
) -> anyhow::Result<Results> {
    // How many seeds of each point are to be there: none of what was not chosen.
    let mut points: Vec<(Point, u32)> = Vec::new();
    for it in planned {
        for (point, is_base) in [(&it.of.base, true), (&it.of.point, false)] {
            let seeds = if it.chosen {
                settings.seeds_of(is_base)
            } else {
                0
            };
            match points.iter_mut().find(|(known, _)| known == point) {
                Some((_, known)) => *known = seeds.max(*known),
                None => points.push((point.clone(), seeds)),
            }
        }
    }
    let runs = Runs::open(session.folder())?;
    let mut wanted: Vec<PlannedAt<Point>> = Vec::new();
    // Seed by seed, so that what was stopped has one seed of everything before it has two of anything. Further seeds that another call
    // made are on the page too.
    for seed in 1..=settings.seeds_of(true).max(SEEDS_FOUND_MAX) {
        for (point, seeds) in &points {
            let run = settings.common.run(point, seed);
            if seed <= *seeds || runs.finished(&run).is_some() {
                wanted.push((point.clone(), run));
            }
        }
    }
    let units = settings.common.frames / PIECE_SHARE;
    let work: u64 = wanted.iter().map(|(_, plan)| plan.units + units).sum();
    session.work().1.again(work);
    let play = Played {
        levels: Levels::Train,
        checkpoints: 1,
        episodes: settings.common.episodes,
        units,
    };
    let swept = queue::make(session, wanted, settings.common.jobs, args.queue.report)?;
    let Swept { made, missing } = swept;
    let mut results = Results {
        commands: commands(args, session)?,
        smoke: args.flags.smoke,
        levels: planned.iter().map(|it| it.of.clone()).collect(),
        points: BTreeMap::new(),
        random: Vec::new(),
        left_out: planned
            .iter()
            .filter(|it| !it.chosen)
            .map(|it| it.of.name())
            .collect(),
        missing,
        settings,
    };
    for Made { point, plan, run } in made {
        let greedy = play.greedy(session, &format!("{}-played", plan.name), &run)?;
        if results.random.is_empty() {
            results.random = play.random(session, "random", &run)?;
        }
        // One run is enough: seeds differ in what they learned, not in how exactly it is computed.
        let exactness = match results.points.contains_key(&point.key) {
            true => None,
            false => {
                let config = results.settings.common.config(&point)?;
                session.work().1.again(units);
                let key = format!("exactness-{}", point.key);
                let sizes = exactness::Sizes::of(&config);
                let of = format!("{}, {sizes}", run.summary.weights_sha256);
                let made = session.piece_of(&of, &key, units, |progress| {
                    let made = exactness::measure(&config, &run.folder)?;
                    progress.advance(units)?;
                    Ok(made)
                })?;
                Some(made)
            }
        };
        let entry = results.points.entry(point.key.clone());
        let entry = entry.or_insert_with(|| PointResult {
            speed: speeds.get(&point.key).cloned(),
            exactness,
            seeds: Vec::new(),
        });
        entry.seeds.push(SeedResult {
            seed: plan.call.seed,
            ran: run,
            greedy: greedy.unwrap_or_default(),
        });
    }
    let done = |of: &LevelOf| {
        results.points.contains_key(&of.point.key) && results.points.contains_key(&of.base.key)
    };
    results.levels.retain(done);
    if args.queue.report && !args.dials.is_empty() {
        results
            .levels
            .retain(|of| args.dials.contains(&of.dial.name));
    }
    let names: Vec<String> = results.levels.iter().map(LevelOf::name).collect();
    results.left_out.retain(|name| !names.contains(name));
    Ok(results)
}

/// The calls that made the folder's runs, this one last unless it makes none.
fn commands(args: &TradeoffArgs, session: &Session) -> anyhow::Result<Vec<String>> {
    let mut all: Vec<String> = session.kept_piece(CALLS).unwrap_or_default();
    let this = this_command();
    if !all.contains(&this) && !args.queue.report {
        all.push(this);
        session.keep(CALLS, &all)?;
    }
    Ok(all)
}
