//! Table 1: agents on Procgen's games, compared with a random policy and the paper's numbers.
//! `settings` decides which runs there are, and the engine in `sweep` makes them.

mod settings;

use std::collections::BTreeSet;

use anyhow::Context;
use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_launch::{evaluate::Levels, metrics::rounded};
use driml_machine::units::format_number;
use driml_protocol::RETURNS_MAX;
use minijinja::{Value, context};
use serde::Serialize;

use self::settings::{CHECKPOINTS_PLAYED, Point, Settings};
use crate::{
    cache::Session,
    flags::ProcgenArgs,
    plot::{Band, Run, combine_seeds},
    stats::{
        Spread, mean,
        over_games::{Scores, improvement_chance, iqm},
    },
    sweep::{FinishedRun, PlannedRun, PointRun, install_worlds, run_all},
    sweeps::published::{normalise, paper_return},
};

/// A mean return counts as above that of the random policy if the difference exceeds this many standard errors.
const STANDARD_ERRORS: f64 = 2.0;
const PAPER_FRAMES: f64 = 50e6;
/// The fewest seeds for each game and agent with which scores over all games are computed.
const SEEDS_MIN: usize = 3;

/// Makes the runs, plays with them, and writes the table, the figure and the page.
pub(crate) fn run(args: &ProcgenArgs) -> anyhow::Result<()> {
    let settings = Settings::from_args(args)?;
    let plans = (1..=settings.seeds).flat_map(|seed| settings.plans(seed));
    let plans: Vec<_> = plans.collect();
    let play = settings.play_settings(Levels::Train);
    // For each run its agent plays, and also a random policy.
    let units = plans.len() as u64 * 2 * play.units;
    let report = args.queue.report;
    install_worlds(&plans, report)?;
    let mut session = Session::open("procgen", &args.flags, &settings, units, report)?;
    let made = run_all(&mut session, plans, settings.jobs)?;
    session.check_has_runs(&made)?;
    let mut scored = Vec::new();
    for PointRun { point, plan, run } in made {
        let greedy = play.play_greedy(&mut session, &format!("{}-greedy", plan.name), &run)?;
        let greedy = greedy.unwrap_or_default();
        let random = play.play_random(&mut session, &format!("{}-at-random", point.game), &run)?;
        scored.push(Row {
            training: run.summary.mean_return,
            greedy: mean(&greedy),
            random: mean(&random),
            is_above_random: is_clearly_above(&greedy, &random),
            single: None,
            metrics: Run::read(&run.folder)?,
            point,
            plan,
            run,
        });
    }
    write_data(&session, &scored)?;
    session.save_figure("curves", &figure(&settings, &scored)?)?;
    if has_enough_seeds(&settings, &scored) {
        let play = settings.play_settings(Levels::TrainSingle);
        for it in &mut scored {
            session.progress.add_work(play.units);
            let key = format!("{}-single", it.plan.name);
            let returns = play.play_greedy(&mut session, &key, &it.run)?;
            let settings = it.metrics.settings.as_ref();
            let mode = settings.and_then(|it| it.get("world.distribution_mode"));
            let score = returns.and_then(|it| mean(&it)).zip(mode);
            it.single = score.and_then(|(score, mode)| normalise(&it.point.game, mode, score));
        }
    }
    let values = page_values(&settings, &scored);
    session.write_page(include_str!("procgen.md.j2"), values)
}

/// A finished run and its mean returns: a line of the table, and an entry of the page.
#[derive(Serialize)]
struct Row {
    #[serde(flatten)]
    point: Point,
    #[serde(skip)]
    plan: PlannedRun,
    #[serde(skip)]
    run: FinishedRun,
    #[serde(skip)]
    metrics: Run,
    training: Option<f64>,
    /// The mean return of the agent, played greedily.
    greedy: Option<f64>,
    /// The mean return of a random policy in the same world.
    random: Option<f64>,
    is_above_random: bool,
    /// The normalised return of the agent, played greedily on single levels; `None` without scores over all games.
    #[serde(skip)]
    single: Option<f64>,
}

fn is_clearly_above(greedy: &[f64], random: &[f64]) -> bool {
    let spreads = [greedy, random].map(|it| Spread::of(it.iter().copied()));
    let [Some(greedy), Some(random)] = spreads else {
        return false;
    };
    let error = |it: Spread| it.sd.powi(2) / it.count as f64;
    greedy.mean - random.mean > STANDARD_ERRORS * (error(greedy) + error(random)).sqrt()
}

fn games(all: &[Row]) -> BTreeSet<&str> {
    all.iter().map(|it| it.point.game.as_str()).collect()
}

fn runs_of<'a>(all: &'a [Row], game: &str, agent: &str) -> impl Iterator<Item = &'a Row> {
    let all = all.iter();
    all.filter(move |it| it.point.game == game && it.point.agent == agent)
}

fn write_data(session: &Session, scored: &[Row]) -> anyhow::Result<()> {
    let columns = "game,agent,torso,seed,frames,training,greedy,random,paper,wall_seconds,commit";
    let mut rows = Vec::new();
    for it in scored {
        let (point, summary) = (&it.point, &it.run.summary);
        let paper = paper_return(&point.game, &point.agent);
        let returns = [it.training, it.greedy, it.random, paper];
        let settings = it.metrics.settings.as_ref();
        let settings = settings
            .with_context(|| format!("{} cannot be read", it.run.folder.config().display()))?;
        // Settings of earlier versions lack `model.torso` and mean `nature`, the torso of DQN in Nature.
        let torso = settings.get("model.torso").map_or("nature", String::as_str);
        rows.push((
            (&point.game, &point.agent, torso),
            (it.plan.call.seed, summary.frames),
            returns.map(|it| it.map(rounded)),
            (summary.wall_seconds.round() as u64, &it.run.commit),
        ));
    }
    session.write_csv("table", columns, rows)
}

fn figure(settings: &Settings, scored: &[Row]) -> anyhow::Result<Figure> {
    let mut panels = Vec::new();
    for game in games(scored) {
        let constant = |value: f64| vec![(0.0, value), (settings.frames as f64, value)];
        let mut series = Vec::new();
        let first = scored.iter().find(|it| it.point.game == game);
        if let Some(random) = first.and_then(|it| it.random) {
            series.push(Series::line("random", 0, constant(random)).with_colour(GREY));
        }
        for (index, agent) in settings.agents.iter().enumerate() {
            let each =
                runs_of(scored, game, agent).map(|it| it.metrics.values("frames", "mean_return"));
            let each = each.collect::<Result<Vec<_>, _>>()?;
            let curve = combine_seeds(&each, Band::Range);
            if curve.points.is_empty() {
                continue;
            }
            series.push(curve.series(agent, index));
            if let Some(paper) = paper_return(game, agent) {
                series.push(Series::line("", index, constant(paper)).with_mark(Mark::Dashed));
            }
        }
        let (x, y) = (Axis::linear("frames"), Axis::linear("mean return"));
        panels.push(Panel::Chart(Chart::new(game, x, y, series)));
    }
    Ok(Figure {
        title: "Training return by game".into(),
        notes: vec![format!(
            "Mean of the last {RETURNS_MAX} training episodes, with exploration; over several seeds mean and range. Dashed: the paper's \
             after 50 million frames. Grey: a random policy."
        )],
        columns: panels.len().min(4),
        panel_size: (300.0, 230.0),
        panels,
    })
}

/// Whether each game and agent has enough seeds for an interval of scores over all games.
fn has_enough_seeds(settings: &Settings, scored: &[Row]) -> bool {
    games(scored).into_iter().all(|game| {
        let mut agents = settings.agents.iter();
        agents.all(|agent| runs_of(scored, game, agent).count() >= SEEDS_MIN)
    })
}

fn page_values(settings: &Settings, scored: &[Row]) -> Value {
    let (agents, games) = (&settings.agents, games(scored));
    let scores = |agent: &String, score: fn(&Row) -> Option<f64>| -> Scores {
        let of_game = |game: &&str| runs_of(scored, game, agent).filter_map(score).collect();
        games.iter().map(of_game).collect()
    };
    let iqms = agents.iter().filter_map(|agent| {
        let mut scores = scores(agent, |it| it.single);
        scores.retain(|of_game| of_game.len() >= SEEDS_MIN);
        let score = format!("{:.3}", iqm(&scores)?);
        Some(context! { agent, games => scores.len(), score })
    });
    let others = agents.iter().skip(1);
    let others = others.filter(|_| has_enough_seeds(settings, scored));
    let improvements = others.filter_map(|agent| {
        let [own, first] = [agent, &agents[0]].map(|agent| scores(agent, |it| it.training));
        let chance = format!("{:.3}", improvement_chance(&own, &first)?);
        Some(context! { agent, chance })
    });
    let games = games.iter().map(|name| {
        let paper = agents.iter().map(|agent| paper_return(name, agent));
        context! { name, paper => paper.collect::<Vec<_>>() }
    });
    context! {
        settings,
        agents,
        seeds => settings.seeds,
        runs => scored,
        games => games.collect::<Vec<_>>(),
        iqms => iqms.collect::<Vec<_>>(),
        improvements => improvements.collect::<Vec<_>>(),
        percent => format_number(100.0 * settings.frames as f64 / PAPER_FRAMES),
        errors => STANDARD_ERRORS,
        returns_of => RETURNS_MAX,
        episodes => CHECKPOINTS_PLAYED * settings.episodes,
        some_seeds => scored.iter().any(|it| it.plan.call.seed > 1),
    }
}
