//! Data and page of Fig. 3, from the runs' metrics.
//! It draws nothing beyond the episodes and frames that the settings ask for.

use driml_protocol::RETURNS_OF;
use serde_json::{Value, json};

use super::{
    figure::figure,
    results::{LOSSES, Loss, Results},
    settings::{EPISODE_FRAMES_MAX, PART_NAMES, PARTS},
};
use crate::{
    cache::Session,
    page::{Page, Table, Values, number},
    stats::interval,
};

/// Names of ghosts 0 to 3.
const GHOSTS: [&str; 4] = ["red", "cyan", "orange", "green"];
/// How the page names (b) and (c).
const PANELS: [&str; PARTS] = ["(b)", "(c)"];

/// Writes the tables, figure 3 and the page of what was run.
pub(super) fn report(
    session: Session,
    results: &Results,
    command: &str,
    smoke: bool,
) -> anyhow::Result<()> {
    session.figure("fig3", &figure(results))?;
    write_data(&session, results)?;
    let values = values(results);
    let template = include_str!("../pacman.md");
    session.finish(&Page::new(template, values, command, smoke))
}

fn write_data(session: &Session, results: &Results) -> anyhow::Result<()> {
    let losses = || results.losses.iter();
    let head = |it: &Loss| {
        [
            it.epsilon.to_string(),
            it.seed.to_string(),
            it.column.into(),
        ]
    };
    let rows = losses().flat_map(|it| {
        it.points.iter().map(move |(frames, loss)| {
            [
                &head(it)[..],
                &[format!("{frames:.0}"), format!("{loss:.4}")],
            ]
            .concat()
        })
    });
    session.csv("loss", &Table::of("epsilon,seed,loss,frames,nats", rows))?;
    let rows =
        losses().map(|it| [&head(it)[..], &[number(it.last, 4), number(it.whole, 4)]].concat());
    let columns = "epsilon,seed,loss,last_fifth_nats,whole_nats";
    session.csv("final_loss", &Table::of(columns, rows))?;
    for (name, traces) in PART_NAMES.iter().zip(&results.traces) {
        let rows = traces.iter().flat_map(|trace| {
            trace.points.iter().map(|(episodes, mean)| {
                let numbers = [format!("{episodes:.0}"), format!("{mean:.4}")];
                [&[trace.agent.clone(), trace.seed.to_string()], &numbers[..]].concat()
            })
        });
        session.csv(name, &Table::of("agent,seed,episodes,mean_return", rows))?;
    }
    Ok(())
}

/// Of each epsilon its episodes, and the final losses of its runs.
fn losses(results: &Results) -> Vec<Value> {
    let epsilons = results.settings.predictability.epsilons.iter();
    let row = |&epsilon: &f64| {
        let episodes = results.episodes.iter().filter(|it| it.0 == epsilon);
        let of_column = LOSSES.map(|(column, _)| {
            let here = || results.losses(column).filter(|it| it.epsilon == epsilon);
            json!({
                "last": here().map(|it| it.last).collect::<Vec<_>>(),
                "whole": here().map(|it| it.whole).collect::<Vec<_>>(),
            })
        });
        json!({
            "epsilon": epsilon.to_string(),
            "episodes": episodes.map(|it| it.1).collect::<Vec<_>>(),
            "losses": of_column,
        })
    };
    epsilons.map(row).collect()
}

/// Of each task its lethal ghost, and of each agent the returns at its end and over it.
fn tasks(part: usize, results: &Results) -> Vec<Value> {
    let continual = results.settings.tasks(part);
    let row = |task: u64| {
        let ghost = continual.order[task as usize % continual.order.len()];
        let of_agent = |agent: &String| {
            let own = results.traces(part, agent);
            let both = own.filter_map(|trace| trace.task(continual, task));
            let (end, over): (Vec<f64>, Vec<f64>) = both.unzip();
            json!({ "end": end, "over": over })
        };
        let agents = results.settings.agents.iter().map(of_agent);
        json!({
            "number": task + 1,
            "ghost": GHOSTS.get(usize::from(ghost)).unwrap_or(&"?"),
            "agents": agents.collect::<Vec<_>>(),
        })
    };
    (0..continual.tasks).map(row).collect()
}

fn got_losses(results: &Results) -> Vec<String> {
    let lines = LOSSES.iter().filter_map(|(column, what)| {
        let (rank, runs) = results.order_of_epsilon(column)?;
        Some(format!(
            "(a) Rank correlation of epsilon and the final {what} loss over {runs} runs: {rank:.2} (1 if the loss rises with epsilon)."
        ))
    });
    lines.collect()
}

/// The mean with its interval, and of how many seeds it is.
fn with_interval(values: impl Iterator<Item = f64>) -> Option<String> {
    let values: Vec<f64> = values.collect();
    let found = interval(&values)?;
    Some(match values.len() {
        1 => format!("{found:.3}"),
        seeds => format!("{found:.3} (95% interval over {seeds} seeds)"),
    })
}

fn got_tasks(part: usize, results: &Results) -> Vec<String> {
    let (continual, panel) = (results.settings.tasks(part), PANELS[part]);
    let last = continual.tasks.saturating_sub(1);
    let agents = &results.settings.agents;
    let mut lines = Vec::new();
    for agent in agents {
        let own = results.traces(part, agent);
        let gains = own
            .filter_map(|trace| Some(trace.task(continual, last)?.0 - trace.task(continual, 0)?.0));
        lines.extend(with_interval(gains).map(|gain| {
            format!("{panel} `{agent}`: return at the end of the last task minus that of the first: {gain}.")
        }));
    }
    let of_seed = |agent: &str, seed: u32| {
        let trace = results.traces(part, agent).find(|it| it.seed == seed)?;
        trace.over_tasks(continual)
    };
    for agent in agents.iter().skip(1) {
        let first = &agents[0];
        let seeds = 1..=results.settings.seeds;
        let apart = seeds.filter_map(|seed| Some(of_seed(agent, seed)? - of_seed(first, seed)?));
        lines.extend(with_interval(apart).map(|apart| {
            format!(
                "{panel} `{agent}` minus `{first}`, return over all tasks, seed by seed: {apart}."
            )
        }));
    }
    lines
}

/// What the page says.
fn values(results: &Results) -> Values {
    let settings = &results.settings;
    let (ghosts, noise) = (&settings.continual, &settings.noise);
    let mut got = got_losses(results);
    got.extend((0..PARTS).flat_map(|part| got_tasks(part, results)));
    let short = ghosts.episodes_per_task.min(noise.episodes_per_task) < 2 * RETURNS_OF as u64;
    let mut sets = ghosts.sets.iter();
    let capacity = sets.find_map(|set| set.strip_prefix("replay.capacity_transitions="));
    let out_of_order = results.order_of_epsilon(LOSSES[1].0);
    let mut values = Values::default();
    values
        .set("settings", settings)
        .set("agents", &settings.agents)
        .set("seeds", settings.seeds)
        .set("got", got)
        .set("losses", losses(results))
        .set("ghosts", tasks(0, results))
        .set("noise", tasks(1, results))
        .set("missing", &results.missing)
        .set(
            "out_of_order",
            out_of_order.is_some_and(|(rank, _)| rank <= 0.0),
        )
        .set("capacity", capacity)
        .set("short_tasks", short)
        .set("returns_of", RETURNS_OF)
        .set("episode_frames_max", EPISODE_FRAMES_MAX);
    values
}
