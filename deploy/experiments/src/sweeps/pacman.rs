//! Fig. 3: (a) ghosts that are more or less predictable; (b, c) one lethal ghost of four that changes, without and with noise in
//! the walls. The engine in `sweep` makes the runs, `results` reads them; this module writes the data, the figure and the page.

mod results;
mod settings;

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_launch::metrics::rounded;
use driml_protocol::RETURNS_MAX;
use minijinja::{Value, context};

use self::{
    results::{LOSSES, Results, Trace},
    settings::{EPISODE_FRAMES_MAX, PART_NAMES, PARTS},
};
use crate::{
    cache::Session,
    flags::PacmanArgs,
    plot::{Band, combine_seeds, smooth},
    stats::Spread,
    sweep::{install_worlds, run_all},
};

const PANELS: [&str; PARTS] = ["(b)", "(c)"];

pub(crate) fn run(args: &PacmanArgs) -> anyhow::Result<()> {
    let settings = settings::with_flags(args)?;
    let plans = (1..=settings.seeds).flat_map(|seed| settings.plans(seed));
    let plans: Vec<_> = plans.collect();
    let report = args.queue.report;
    install_worlds(&plans, report)?;
    let mut session = Session::open("pacman", &args.flags, &settings, 0, report)?;
    let made = run_all(&mut session, plans, settings.jobs)?;
    session.check_has_runs(&made)?;
    let results = Results::read(settings, made)?;
    session.save_figure("fig3", &figure(&results))?;
    write_data(&session, &results)?;
    session.write_page(include_str!("pacman.md.j2"), page_values(&results))
}

fn write_data(session: &Session, results: &Results) -> anyhow::Result<()> {
    let losses = results.losses.iter();
    let losses = losses.map(|it| ((it.epsilon, it.seed, it.column), it));
    let points = losses.clone().flat_map(|(of, it)| {
        let points = it.points.iter();
        points.map(move |(x, y)| (of, *x as u64, rounded(*y)))
    });
    session.write_csv("loss", "epsilon,seed,loss,frames,nats", points)?;
    let ends = losses.map(|(of, it)| (of, [it.last, it.whole].map(|it| it.map(rounded))));
    let columns = "epsilon,seed,loss,last_fifth_nats,whole_nats";
    session.write_csv("final_loss", columns, ends)?;
    for (name, traces) in PART_NAMES.iter().zip(&results.traces) {
        let rows = traces.iter().flat_map(|it| {
            let points = it.points.iter();
            points.map(move |(x, y)| (&it.agent, it.seed, *x as u64, rounded(*y)))
        });
        session.write_csv(name, "agent,seed,episodes,mean_return", rows)?;
    }
    Ok(())
}

/// Returns for each agent, with a value for each seed: the return at the end of the last task minus that of the first task, and the mean
/// return over all tasks minus that of the first agent. Seeds that lack a number are left out.
fn differences(part: usize, results: &Results) -> Vec<Value> {
    let agents = &results.settings.agents;
    let row = |agent: &String, first: Option<&String>, values: Vec<f64>| {
        let row = context! { panel => PANELS[part], agent, first, values };
        (!values.is_empty()).then_some(row)
    };
    let gains = agents.iter().map(|agent| {
        let gain = |it: &Trace| Some((*it.tasks.last()?)?.0 - (*it.tasks.first()?)?.0);
        let gains = results.traces(part, agent).filter_map(gain);
        row(agent, None, gains.collect())
    });
    let above_first = agents.iter().skip(1).map(|agent| {
        let gains_over_first = results.traces(part, agent).filter_map(|it| {
            let mut of_first = results.traces(part, &agents[0]);
            let other = of_first.find(|other| other.seed == it.seed)?;
            Some(it.mean_over_tasks()? - other.mean_over_tasks()?)
        });
        row(agent, Some(&agents[0]), gains_over_first.collect())
    });
    gains.chain(above_first).flatten().collect()
}

fn page_values(results: &Results) -> Value {
    let settings = &results.settings;
    let ranks = LOSSES.iter().filter_map(|(column, what)| {
        let (rank, runs) = results.epsilon_correlation(column)?;
        Some(context! { what, rank, runs })
    });
    let differences = (0..PARTS).flat_map(|part| differences(part, results));
    let epsilons = settings.predictability.epsilons.iter();
    context! {
        settings,
        agents => settings.agents,
        seeds => settings.seeds,
        ranks => ranks.collect::<Vec<_>>(),
        differences => differences.collect::<Vec<_>>(),
        epsilons => epsilons.map(f64::to_string).collect::<Vec<_>>(),
        columns => LOSSES.map(|(column, _)| column),
        losses => results.losses,
        traces => results.traces,
        returns_of => RETURNS_MAX,
        episode_frames_max => EPISODE_FRAMES_MAX,
    }
}

/// The share of a run over which the drawn loss is averaged.
const SMOOTHED_SHARE: f64 = 0.1;

/// Draws the DIM losses by epsilon, and the returns under one lethal ghost after another.
fn figure(results: &Results) -> Figure {
    let settings = &results.settings;
    let mut panels = Vec::new();
    for (column, what) in LOSSES {
        let mut series = Vec::new();
        for (index, &epsilon) in settings.predictability.epsilons.iter().enumerate() {
            let window = settings.predictability.frames as f64 * SMOOTHED_SHARE;
            let each = results.losses(column, epsilon);
            let each: Vec<_> = each.map(|it| smooth(&it.points, window)).collect();
            let curve = combine_seeds(&each, Band::Range);
            series.push(curve.series(&format!("epsilon {epsilon}"), index));
        }
        let title = format!("(a) DIM loss, {what} features");
        let (x, y) = (Axis::linear("frames"), Axis::log("InfoNCE [nats]"));
        panels.push(Panel::Chart(Chart::new(&title, x, y, series)));
    }
    let titles = [
        "(b) One lethal ghost after another",
        "(c) The same with Ising noise in the walls",
    ];
    for (part, title) in titles.into_iter().enumerate() {
        let (x, y) = (Axis::linear("episodes"), Axis::linear("mean return"));
        let series = task_series(results, part);
        panels.push(Panel::Chart(Chart::new(title, x, y, series)));
    }
    Figure {
        title: "Ms. PacMan: what DIM finds, and what it is good for".into(),
        notes: vec![format!(
            "(a) Mean over a tenth of the run; mean and range over seeds. (b, c) Training return, mean of the last {RETURNS_MAX} \
             episodes; mean and range over seeds; vertical lines: another ghost becomes the lethal one; dashed: where {} stood at the \
             end of each task.",
            settings.agents.first().map_or("", String::as_str)
        )],
        columns: 2,
        panel_size: (430.0, 320.0),
        panels,
    }
}

fn task_series(results: &Results, part: usize) -> Vec<Series> {
    let continual = results.settings.continual(part);
    let mut series = Vec::new();
    let points = results.traces[part].iter().flat_map(|it| &it.points);
    let length = continual.episodes_per_task as f64;
    if let Some(Spread { min, max, .. }) = Spread::of(points.map(|point| point.1)) {
        for task in 1..continual.tasks {
            let x = length * task as f64;
            let line = Series::line("", 0, vec![(x, min), (x, max)]);
            series.push(line.with_colour(GREY).with_mark(Mark::Line));
        }
    }
    for (index, agent) in results.settings.agents.iter().enumerate() {
        let traces = || results.traces(part, agent);
        let each: Vec<_> = traces().map(|trace| trace.points.clone()).collect();
        series.push(combine_seeds(&each, Band::Range).series(agent, index));
        let tasks = if index == 0 { continual.tasks } else { 0 };
        for task in 0..tasks {
            let ends = traces().filter_map(|trace| trace.tasks[task as usize]);
            if let Some(end) = Spread::of(ends.map(|it| it.0)) {
                let x = length * task as f64;
                let line = vec![(x, end.mean), (x + length, end.mean)];
                series.push(Series::line("", 0, line).with_mark(Mark::Dashed));
            }
        }
    }
    series
}
