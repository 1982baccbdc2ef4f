//! `driml tradeoff`: measures how much accuracy each setting that buys speed costs, and the other way round. It makes short trainings of
//! whole runs in which one such setting (a dial) changes at a time, and benchmarks single updates.
//! `menu` has the dials, `plan` chooses what fits into a budget, `report` writes data, figures and page.

mod fixed_batch;
mod measured;
mod menu;
mod plan;
mod report;
mod results;

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Instant,
};

use driml_launch::{checkpoint_choice::read_config, console::print, evaluate::Levels};
use driml_machine::error::usage;
use driml_settings::{config::RunConfig, presets};
use minijinja::context;

use self::{
    menu::{DialLevel, Point, Settings},
    plan::{Cost, choose_levels},
    results::{Numbers, PointResult, Results, SeedResult},
};
use crate::{
    cache::{self, Session},
    flags::{SEEDS_MAX, TradeoffArgs, this_command_line},
    page::fill,
    plot::Run,
    stats::Spread,
    sweep::{FinishedRun, PlaySettings, PointPlan, PointRun, Runs, install_worlds, run_all},
};

/// The piece with the list of command lines that made runs in this folder.
const COMMANDS_KEY: &str = "calls";
/// A measurement counts as 1 / this of the work of a run, used only to estimate the time left.
const PIECE_SHARE: u64 = 20;
/// The factor for what a run does besides updates and actions: replay, messages, and processes that wait for each other.
const OVERHEAD: f64 = 1.3;
/// The seconds that the processes of a run take to start, to save and to exit.
const START_SECONDS: f64 = 4.0;

struct Tradeoff {
    settings: Settings,
    session: Session,
    speeds: BTreeMap<String, Numbers>,
}

/// Measures what each dial that buys speed costs: plans, benchmarks, trains, and writes the page.
pub fn run(args: &TradeoffArgs) -> anyhow::Result<()> {
    let world = presets::world(&args.env).map_err(|e| usage!("--env: {e}"))?;
    let name = format!("tradeoff-{}", world.to_string().replace("procgen:", ""));
    let stored = cache::settings_of(&name, &args.flags);
    let is_new = stored.is_none() && !args.queue.report;
    let mut settings = Settings::from_args(args, world, stored)?;
    let report_only = args.queue.report;
    let base = settings.common.plan_run(&settings.levels[0].base, 1);
    install_worlds(&[((), base)], report_only)?;
    // The budget is the machine time for the runs of this call.
    let (started, budget_seconds) = (Instant::now(), f64::from(args.budget) * 60.0);
    if settings.may_shorten {
        shorten_runs(&mut settings, args.flags.smoke, budget_seconds)?;
    }
    let mut tradeoff = Tradeoff {
        session: Session::open(&name, &args.flags, &settings.common, 0, report_only)?,
        settings,
        speeds: BTreeMap::new(),
    };
    let left = || (budget_seconds - started.elapsed().as_secs_f64()).max(0.0);
    let measured = tradeoff.measure_speeds(args.flags.smoke);
    let chosen = measured.and_then(|()| tradeoff.choose_levels(left()));
    // The length of the runs is settled once a level fits.
    if is_new && (args.plan || !chosen.as_ref().is_ok_and(|it| it.contains(&true))) {
        tradeoff.session.forget_settings()?;
    }
    let chosen = chosen?;
    if args.plan {
        return Ok(());
    }
    let results = tradeoff.make_runs(&chosen)?;
    if results.levels.is_empty() {
        tradeoff.session.check_none_missing()?;
        let what = match results.points.is_empty() {
            true => "no run is finished yet",
            false => "no level and its base both have a finished run",
        };
        let next = match report_only {
            true => ": run the same command without --report first",
            false => ", and none fits into the budget: raise --budget",
        };
        return Err(usage!("{what}{next}").into());
    }
    report::write_report(tradeoff.session, &results)
}

/// Makes the runs shorter if not even the first requested level fits into the budget.
fn shorten_runs(settings: &mut Settings, smoke: bool, budget_seconds: f64) -> anyhow::Result<()> {
    let Some(level) = settings.levels.iter().find(|it| it.is_requested) else {
        return Ok(());
    };
    let base = settings.common.config(&level.base)?;
    let mut seconds = 0.0;
    for (point, is_base) in [(&level.base, true), (&level.point, false)] {
        let config = settings.common.config(point)?;
        let speed = measured::speeds(&base, &config, smoke)?;
        seconds += f64::from(settings.seed_count(is_base)) * estimate_seconds(&config, &speed);
    }
    settings.common.frames = plan::choose_frames(settings.common.frames, seconds, budget_seconds);
    Ok(())
}

fn estimate_seconds(config: &RunConfig, speed: &Numbers) -> f64 {
    let updates = config.updates() as f64 * speed["update_seconds"];
    let actions = config.frames() as f64 * speed["act_seconds"];
    START_SECONDS + OVERHEAD * (updates + actions)
}

impl Tradeoff {
    fn piece_units(&self) -> u64 {
        self.settings.common.frames / PIECE_SHARE
    }

    /// Benchmarks every requested level and its base. For other levels, and for a report, it only reads existing benchmarks.
    fn measure_speeds(&mut self, smoke: bool) -> anyhow::Result<()> {
        let (units, settings) = (self.piece_units(), &self.settings);
        let (common, report) = (&settings.common, self.session.report_only);
        let inputs = format!("{}, {:?}, {:?}", common.env, common.preset, common.sets);
        let points = || settings.levels.iter().flat_map(DialLevel::points);
        let is_wanted = |it: &&Point| !report && settings.requests(it);
        let keys = points().filter(is_wanted).map(|it| &it.key);
        let count = keys.collect::<BTreeSet<_>>().len() as u64;
        self.session.progress.add_work(units * count);
        for point in points() {
            if self.speeds.contains_key(&point.key) {
                continue;
            }
            let key = format!("speed-{}", point.key);
            let speed = if !is_wanted(&point) {
                // Accept the result of any program: only requested points are measured again.
                self.session.read_piece(&key)
            } else {
                let base = common.config(settings.timing_base(point))?;
                let config = common.config(point)?;
                let measure = |_: &mut _| measured::speeds(&base, &config, smoke);
                let session = &mut self.session;
                Some(session.load_or_compute(&inputs, &key, units, measure)?)
            };
            self.speeds.extend(speed.map(|it| (point.key.clone(), it)));
        }
        Ok(())
    }

    /// Returns for each level whether it is run: it is requested and fits into the `left` seconds. Prints this plan. A report runs nothing.
    fn choose_levels(&self, left: f64) -> anyhow::Result<Vec<bool>> {
        let levels = &self.settings.levels;
        if self.session.report_only {
            return Ok(vec![false; levels.len()]);
        }
        let runs = Runs::open(&self.session.folder)?;
        let requested = || levels.iter().filter(|it| it.is_requested);
        let costs = requested().map(|level| {
            let [base, own] = level.points().map(|it| self.cost(&runs, it, &level.base));
            Ok([base?, own?])
        });
        let costs = costs.collect::<anyhow::Result<Vec<_>>>()?;
        let (fits, seconds) = choose_levels(&costs, left);
        let asked = requested().zip(&costs).zip(&fits);
        let asked = asked.map(|((level, [_, (_, seconds)]), fits)| {
            context! { name => level.name(), seconds, fits }
        });
        let values = context! {
            settings => self.settings.common,
            seeds => self.settings.seeds,
            levels => asked.collect::<Vec<_>>(),
            seconds,
            left,
        };
        print(&fill(include_str!("tradeoff_plan.j2"), &values)?)?;
        let mut fits = fits.into_iter();
        let is_chosen = |it: &DialLevel| it.is_requested && fits.next() == Some(true);
        Ok(levels.iter().map(is_chosen).collect())
    }

    /// Returns the cost of the unfinished runs of a requested point. `base` is the point itself or the base of its level.
    fn cost(&self, runs: &Runs, point: &Point, base: &Point) -> anyhow::Result<Cost> {
        let common = &self.settings.common;
        // The seconds of machine time for each finished run of a point.
        let taken = |point: &Point| {
            let seeds = self.settings.seed_count(point == base);
            let plans = (1..=seeds).map(|seed| common.plan_run(point, seed));
            let finished = plans.filter_map(|plan| runs.get_finished(&plan));
            Spread::of(finished.map(|it| it.summary.wall_seconds / f64::from(common.jobs)))
        };
        let estimated = |point: &Point| -> anyhow::Result<f64> {
            let speed = &self.speeds[&point.key];
            Ok(estimate_seconds(&common.config(point)?, speed))
        };
        let finished = taken(point);
        let seeds = self.settings.seed_count(point == base) as usize;
        let unfinished = seeds - finished.map_or(0, |it| it.count);
        let each = match finished {
            Some(finished) => finished.mean,
            // The time of finished base runs corrects the estimate from the benchmark.
            None => match taken(base) {
                Some(taken) => estimated(point)? * taken.mean / estimated(base)?,
                None => estimated(point)?,
            },
        };
        Ok((point.key.clone(), each * unfinished as f64))
    }

    /// Returns the runs of the chosen levels and their bases, and all runs that are already finished.
    fn planned_runs(&self, chosen: &[bool]) -> anyhow::Result<Vec<PointPlan<Point>>> {
        let runs = Runs::open(&self.session.folder)?;
        let mut wanted: Vec<PointPlan<Point>> = Vec::new();
        // Ordered by seed, so that a stopped call has one seed of every point before two of any. The page also has further seeds that
        // another call made.
        for seed in 1..=SEEDS_MAX {
            for (level, &is_chosen) in self.settings.levels.iter().zip(chosen) {
                for (point, is_base) in [(&level.base, true), (&level.point, false)] {
                    let run = self.settings.common.plan_run(point, seed);
                    let is_requested = is_chosen && seed <= self.settings.seed_count(is_base);
                    // Levels share bases, and a level may be the base of another.
                    let is_new = wanted.iter().all(|(_, known)| known.name != run.name);
                    if is_new && (is_requested || runs.get_finished(&run).is_some()) {
                        wanted.push((point.clone(), run));
                    }
                }
            }
        }
        Ok(wanted)
    }

    /// Makes the chosen runs, and plays with the weights of these and of the runs that are already finished.
    fn make_runs(&mut self, chosen: &[bool]) -> anyhow::Result<Results> {
        let wanted = self.planned_runs(chosen)?;
        let (units, report) = (self.piece_units(), self.session.report_only);
        install_worlds(&wanted, report)?;
        // The agent of each run plays, and a random policy once.
        let plays = wanted.len() as u64 + 1;
        self.session.progress.add_work(units * plays);
        let common = self.settings.common.clone();
        // An interrupt keeps the runs that are finished.
        let commands = self.record_command()?;
        let made = run_all(&mut self.session, wanted, common.jobs)?;
        let play = PlaySettings {
            levels: Levels::Train,
            checkpoints: 1,
            episodes: common.episodes,
            units,
        };
        let mut points = BTreeMap::<String, PointResult>::new();
        let mut random = Vec::new();
        for PointRun { point, plan, run } in made {
            let key = format!("{}-played", plan.name);
            let greedy = play.play_greedy(&mut self.session, &key, &run)?;
            if random.is_empty() {
                random = play.play_random(&mut self.session, "random", &run)?;
            }
            let result = points.entry(point.key.clone()).or_default();
            // One run suffices: seeds differ in what they learned, not in the numeric error of the computation.
            if result.seeds.is_empty() {
                result.measured = self.measure_errors(&point, &run)?;
                let speed = self.speeds.get(&point.key).cloned();
                result.measured.extend(speed.unwrap_or_default());
            }
            result.seeds.push(SeedResult {
                seed: plan.call.seed,
                curve: Run::read(&run.folder)?.values("seconds", "mean_return")?,
                run,
                greedy: greedy.unwrap_or_default(),
            });
        }
        let is_made = |point: &Point| points.contains_key(&point.key);
        let (mut levels, mut left_out) = (Vec::new(), Vec::new());
        for (level, is_chosen) in self.settings.levels.iter().zip(chosen) {
            if is_made(&level.point) && is_made(&level.base) && (!report || level.is_requested) {
                levels.push(level.clone());
            } else if level.is_requested && !is_chosen {
                left_out.push(level.name());
            }
        }
        Ok(Results {
            common,
            commands,
            levels,
            points,
            random,
            left_out,
        })
    }

    fn measure_errors(&mut self, point: &Point, run: &FinishedRun) -> anyhow::Result<Numbers> {
        // Read the config of this run, whose seed may not be 1.
        let (units, config) = (self.piece_units(), read_config(&run.folder)?);
        self.session.progress.add_work(units);
        let key = format!("exactness-{}", point.key);
        let (rows, states) = measured::sizes(&config);
        let weights = &run.summary.weights_sha256;
        let what = format!("{weights}, {rows} rows, {states} states");
        let measure = |_: &mut _| measured::errors(&config, &run.folder);
        self.session.load_or_compute(&what, &key, units, measure)
    }

    /// Returns the command lines that made the folder's runs, with this one last unless it only reports.
    fn record_command(&self) -> anyhow::Result<Vec<String>> {
        let mut all: Vec<String> = self.session.read_piece(COMMANDS_KEY).unwrap_or_default();
        let this = this_command_line();
        if !all.contains(&this) && !self.session.report_only {
            all.push(this);
            self.session.store(COMMANDS_KEY, &all)?;
        }
        Ok(all)
    }
}
