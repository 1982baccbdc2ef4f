//! Data and page of Fig. 3, from the runs' metrics.
//! It draws nothing beyond the episodes and frames that the settings ask for.

use driml_protocol::RETURNS_OF;
use serde_json::{Value, json};

use super::{
    results::{LOSSES, Results, Trace},
    settings::{EPISODE_FRAMES_MAX, PART_NAMES, PARTS},
};
use crate::{
    cache::Session,
    page::{Table, Values, number},
};

/// Names of ghosts 0 to 3.
const GHOSTS: [&str; 4] = ["red", "cyan", "orange", "green"];
/// How the page names (b) and (c).
const PANELS: [&str; PARTS] = ["(b)", "(c)"];

/// Writes the tables.
pub(super) fn write_data(session: &Session, results: &Results) -> anyhow::Result<()> {
    let losses = results.losses.iter();
    let rows = losses.clone().flat_map(|it| {
        let (epsilon, seed, column) = (it.epsilon, it.seed, it.column);
        let points = it.points.iter();
        points.map(move |(x, y)| format!("{epsilon},{seed},{column},{x:.0},{y:.4}"))
    });
    let columns = "epsilon,seed,loss,frames,nats";
    session.csv("loss", &Table::of_lines(columns, rows))?;
    let rows = losses.map(|it| {
        let (epsilon, seed, column) = (it.epsilon, it.seed, it.column);
        let [last, whole] = [it.last, it.whole].map(|it| number(it, 4));
        format!("{epsilon},{seed},{column},{last},{whole}")
    });
    let columns = "epsilon,seed,loss,last_fifth_nats,whole_nats";
    session.csv("final_loss", &Table::of_lines(columns, rows))?;
    for (name, traces) in PART_NAMES.iter().zip(&results.traces) {
        let rows = traces.iter().flat_map(
            |Trace {
                 agent,
                 seed,
                 points,
             }| {
                let points = points.iter();
                points.map(move |(x, y)| format!("{agent},{seed},{x:.0},{y:.4}"))
            },
        );
        let columns = "agent,seed,episodes,mean_return";
        session.csv(name, &Table::of_lines(columns, rows))?;
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

/// By seed, of each agent how much more it earns at the end of its last task than of its first, and how much more than the first agent
/// over all tasks; where a run has both.
fn differences(part: usize, results: &Results) -> Vec<Value> {
    let continual = results.settings.tasks(part);
    let last = continual.tasks.saturating_sub(1);
    let agents = &results.settings.agents;
    let gains = agents.iter().map(|agent| {
        let gain = |it: &Trace| Some(it.task(continual, last)?.0 - it.task(continual, 0)?.0);
        let gains = results.traces(part, agent).filter_map(gain);
        (agent, None, gains.collect())
    });
    let of_seed = |agent: &str, seed: u32| {
        let trace = results.traces(part, agent).find(|it| it.seed == seed)?;
        trace.over_tasks(continual)
    };
    let above_first = agents.iter().skip(1).map(|agent| {
        let first = &agents[0];
        let seeds = 1..=results.settings.seeds;
        let above = seeds.filter_map(|seed| Some(of_seed(agent, seed)? - of_seed(first, seed)?));
        (agent, Some(first), above.collect::<Vec<f64>>())
    });
    let all = gains.chain(above_first).filter(|it| !it.2.is_empty());
    all.map(|(agent, first, values)| {
        json!({ "panel": PANELS[part], "agent": agent, "first": first, "values": values })
    })
    .collect()
}

/// What the page says.
pub(super) fn values(results: &Results) -> Values {
    let settings = &results.settings;
    let (ghosts, noise) = (&settings.continual, &settings.noise);
    let ranks = LOSSES.iter().filter_map(|(column, what)| {
        let (rank, runs) = results.order_of_epsilon(column)?;
        Some(json!({ "what": what, "rank": rank, "runs": runs }))
    });
    let differences = (0..PARTS).flat_map(|part| differences(part, results));
    let short = ghosts.episodes_per_task.min(noise.episodes_per_task) < 2 * RETURNS_OF as u64;
    let mut sets = ghosts.sets.iter();
    let capacity = sets.find_map(|set| set.strip_prefix("replay.capacity_transitions="));
    let order = results.order_of_epsilon(LOSSES[1].0);
    let is_out_of_order = order.is_some_and(|(rank, _)| rank <= 0.0);
    let mut values = Values::default();
    values
        .set("settings", settings)
        .set("agents", &settings.agents)
        .set("seeds", settings.seeds)
        .set("ranks", ranks.collect::<Vec<_>>())
        .set("differences", differences.collect::<Vec<_>>())
        .set("losses", losses(results))
        .set("ghosts", tasks(0, results))
        .set("noise", tasks(1, results))
        .set("missing", &results.missing)
        .set("out_of_order", is_out_of_order)
        .set("capacity", capacity)
        .set("short_tasks", short)
        .set("returns_of", RETURNS_OF)
        .set("episode_frames_max", EPISODE_FRAMES_MAX);
    values
}
