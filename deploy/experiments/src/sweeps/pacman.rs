//! Fig. 3: (a) ghosts that are more or less predictable; (b, c) one lethal ghost of four that changes, without and with noise in
//! the walls. The engine in `sweep` makes the runs, `results` reads them, `figure` draws them.

mod figure;
mod results;
mod settings;

use driml_launch::metrics::rounded;
use driml_protocol::RETURNS_MAX;
use minijinja::{Value, context};

use self::{
    results::{LOSSES, Results, Trace},
    settings::{EPISODE_FRAMES_MAX, NAME, PART_NAMES, PARTS},
};
use crate::{
    cache::Session,
    flags::PacmanArgs,
    sweep::{plan::install_worlds, queue},
};

const PANELS: [&str; PARTS] = ["(b)", "(c)"];

pub(crate) fn run(args: &PacmanArgs) -> anyhow::Result<()> {
    let settings = settings::with_flags(args)?;
    let plans = (1..=settings.seeds).flat_map(|seed| settings.plans(seed));
    let plans: Vec<_> = plans.collect();
    let report = args.queue.report;
    install_worlds(&plans, report)?;
    let mut session = Session::open(NAME, &args.flags, &settings, 0, report)?;
    let made = queue::run_all(&mut session, plans, settings.jobs)?;
    session.check_has_runs(&made)?;
    let results = Results::read(settings, made)?;
    session.save_figure("fig3", &figure::figure(&results))?;
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
