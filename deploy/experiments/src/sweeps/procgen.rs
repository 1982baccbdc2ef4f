//! Table 1: agents on Procgen's games, as a queue of whole runs that are then played on levels seen and unseen.
//! Data and figures are in `curves`, scores over all games in `scores`, the page in `page`, other people's numbers in
//! `published`, the choice of games in `screen`.

mod curves;
mod grid;
mod k;
mod page;
mod published;
mod results;
mod scores;
mod screen;

use std::{collections::BTreeMap, thread::ScopedJoinHandle};

use driml_launch::{
    console,
    evaluate::{Levels, Player, Who},
};
use driml_machine::error::usage;
use serde::Serialize;

use self::{
    grid::{settings, short},
    results::{Evaluation, Results, RunResult},
};
use crate::{
    flags::{ProcgenArgs, command_line},
    plot, queue,
    runs::{FinishedRun, PlannedRun},
    session::Session,
};

/// Seed of the played episodes: the same levels for every agent.
const PLAY_SEED: u64 = 1;
/// Playing after a run, as a part of the run's work; only the estimate of the time left depends on it.
const PLAY_SHARE: u64 = 10;

/// What every run and every piece has in common: a folder holds those of one such choice, while games, agents and seeds
/// can be added.
#[derive(Serialize)]
struct Common<'a> {
    preset: &'a str,
    frames: u64,
    sets: &'a [String],
    episodes: u32,
}

/// Runs the grid, or the screen.
///
/// # Errors
/// Names that nothing has, a folder of other settings, an interrupt, a file system that refuses.
pub(super) fn run(args: &ProcgenArgs) -> anyhow::Result<()> {
    let settings = settings(args)?;
    let name = if args.screen {
        "procgen-screen"
    } else {
        "procgen"
    };
    let plans = settings.plans();
    let worlds = settings.worlds.len() as u64;
    let frames = settings.frames;
    let play_units = (frames / PLAY_SHARE).max(1);
    let units = plans.len() as u64 * (frames + play_units) + worlds * play_units;
    let common = Common {
        preset: &settings.preset,
        frames,
        sets: &settings.sets,
        episodes: settings.episodes,
    };
    let report_only = args.queue.report;
    let mut session = Session::open_queue(name, &args.flags, &common, units, report_only)?;
    let is_procgen = |world: &String| world.starts_with("procgen:");
    if !report_only && settings.worlds.iter().any(is_procgen) {
        procgen_sys::Engine::install(&mut console::line)?;
    }
    let runs: Vec<PlannedRun> = plans.iter().map(|(_, plan)| plan.clone()).collect();
    let ran = queue::run_all(&mut session, &runs, settings.jobs, report_only)?;
    let mut results = Results {
        command: command(args, name, &session),
        smoke: args.flags.smoke,
        settings,
        cells: Vec::new(),
        random: BTreeMap::new(),
        missing: Vec::new(),
    };
    for ((spot, plan), ran) in plans.into_iter().zip(ran) {
        let Some(ran) = ran else {
            results.missing.push(plan.name);
            continue;
        };
        let mut play = |of: &str, key: &str, who| {
            let episodes = results.settings.episodes;
            session.piece_of(of, key, play_units, |progress| {
                let played = played(&ran, who, episodes)?;
                progress.advance(play_units)?;
                Ok(played)
            })
        };
        // A run may have been made anew, or gone on, since it was played.
        let weights = &ran.summary.weights_sha256;
        let played = play(weights, &format!("{}-played", plan.name), Who::Agent)?;
        if !results.random.contains_key(&spot.world) {
            let random = play("", &format!("{}-random", short(&spot.world)), Who::Random)?;
            results.random.insert(spot.world.clone(), random);
        }
        results.cells.push(RunResult {
            world: spot.world,
            agent: spot.agent,
            seed: spot.seed,
            ran,
            played,
        });
    }
    if results.cells.is_empty() {
        return Err(usage!("no run is finished yet: there is nothing to report").into());
    }
    if args.screen {
        screen::report(session, &results)?;
    } else {
        report(session, &results)?;
    }
    queue::check_made(&results.missing, report_only)
}

/// Writes the tables, the figures and the page of what was run.
fn report(session: Session, results: &Results) -> anyhow::Result<()> {
    curves::write_runs(&session, results)?;
    curves::write_table(&session, results)?;
    session.figure("curves", &curves::figure(&session, results)?)?;
    let aggregates = scores::of(results);
    let rows = aggregates.iter().map(|it| {
        let head = [it.measure, it.kind.name(), &it.agent].map(String::from);
        let numbers = it.interval.cells();
        head.into_iter()
            .chain([it.games.to_string()])
            .chain(numbers)
            .collect()
    });
    let header = ["measure", "of", "agent", "games", "value", "low", "high"];
    session.csv("aggregate", &header, rows)?;
    session.figure("aggregate", &scores::figure(results, &aggregates))?;
    let adaptive: Vec<&RunResult> = results.adaptive().collect();
    if !adaptive.is_empty() {
        session.figure("k", &curves::k_figure(&session, results)?)?;
        curves::write_actions(&session, results)?;
        let first = adaptive.iter().filter(|cell| cell.seed == adaptive[0].seed);
        let folders: Vec<_> = first.map(|cell| cell.ran.folder.clone()).collect();
        session.figure("affinity", &plot::affinities(&folders)?)?;
    }
    session.finish(&page::page(results, &aggregates, !adaptive.is_empty()))
}

fn played(ran: &FinishedRun, who: Who, episodes: u32) -> anyhow::Result<Evaluation> {
    let player = Player::load(&ran.folder)?;
    let on = |levels| player.returns(who, levels, episodes, PLAY_SEED);
    // A world steps on one thread.
    std::thread::scope(|scope| {
        let single = scope.spawn(|| on(Levels::TrainSingle));
        let unseen = scope.spawn(|| on(Levels::Unseen));
        let trained = on(Levels::Train)?.unwrap_or_default();
        let join =
            |thread: ScopedJoinHandle<'_, _>| thread.join().expect("a panic has ended the process");
        Ok(Evaluation {
            trained,
            single: join(single)?,
            unseen: join(unseen)?,
        })
    })
}

fn command(args: &ProcgenArgs, name: &str, session: &Session) -> String {
    let experiment = if args.screen {
        "procgen --screen"
    } else {
        name
    };
    let mut words = command_line(experiment, &args.flags, session.folder());
    for (flag, list) in [("--games", &args.games), ("--agents", &args.agents)] {
        if !list.is_empty() {
            words += &format!(" {flag} {}", list.join(","));
        }
    }
    let numbers = [
        ("--frames", args.frames),
        ("--episodes", args.episodes.map(u64::from)),
        ("--jobs", args.queue.jobs.map(u64::from)),
    ];
    for (flag, number) in numbers {
        if let Some(number) = number {
            words += &format!(" {flag} {number}");
        }
    }
    if let Some(preset) = &args.preset {
        words += &format!(" --preset {preset}");
    }
    for set in &args.queue.sets {
        words += &format!(" --set '{set}'");
    }
    words
}
