//! Data and page of Fig. 3, from the runs' metrics.
//! It draws nothing beyond the episodes and frames that the settings ask for.

use driml_protocol::RETURNS_OF;

use super::{
    figure::figure,
    results::{LOSSES, Loss, Points, Results, Trace},
    settings::{Continual, EPISODE_FRAMES_MAX},
};
use crate::{
    cache::Session,
    page::{Page, Table, Values, cell, number},
    stats::{Spread, interval, rank_correlation},
};

/// Names of ghosts 0 to 3.
const GHOSTS: [&str; 4] = ["red", "cyan", "orange", "green"];

/// Writes the tables, figure 3 and the page of what was run.
pub(super) fn report(
    session: Session,
    results: &Results,
    command: &str,
    smoke: bool,
) -> anyhow::Result<()> {
    session.figure("fig3", &figure(results))?;
    write_losses(&session, results)?;
    write_traces(&session, "ghosts", &results.ghosts)?;
    write_traces(&session, "noise", &results.noise)?;
    let values = values(results);
    let template = include_str!("../pacman.md");
    session.finish(&Page::new(template, values, command, smoke))
}

fn write_losses(session: &Session, results: &Results) -> anyhow::Result<()> {
    let head = |it: &Loss| {
        vec![
            it.epsilon.to_string(),
            it.seed.to_string(),
            it.column.to_owned(),
        ]
    };
    let rows = results.losses.iter().flat_map(|it| {
        let points = it.points.iter();
        points.map(move |(frames, loss)| {
            [head(it), vec![format!("{frames:.0}"), format!("{loss:.4}")]].concat()
        })
    });
    let header = ["epsilon", "seed", "loss", "frames", "nats"];
    session.csv("loss", &Table::new(&header, rows))?;
    let rows = results
        .losses
        .iter()
        .map(|it| [head(it), vec![number(it.last, 4), number(it.whole, 4)]].concat());
    let header = ["epsilon", "seed", "loss", "last_fifth_nats", "whole_nats"];
    session.csv("final_loss", &Table::new(&header, rows))
}

fn write_traces(session: &Session, name: &str, traces: &[Trace]) -> anyhow::Result<()> {
    let rows = traces.iter().flat_map(|trace| {
        trace.points.iter().map(|(episodes, mean)| {
            vec![
                trace.agent.clone(),
                trace.seed.to_string(),
                format!("{episodes:.0}"),
                format!("{mean:.4}"),
            ]
        })
    });
    let header = ["agent", "seed", "episodes", "mean_return"];
    session.csv(name, &Table::new(&header, rows))
}

fn loss_table(results: &Results) -> Table {
    let epsilons = results.settings.predictability.epsilons.iter();
    let rows = epsilons.map(|&epsilon| {
        let episodes = results.episodes.iter().filter(|it| it.0 == epsilon);
        let episodes = Spread::of(episodes.map(|it| it.1));
        let mut row = vec![
            epsilon.to_string(),
            cell(episodes, |it| format!("{:.0}", it.mean)),
        ];
        for (column, _) in LOSSES {
            let here = || results.losses(column).filter(|it| it.epsilon == epsilon);
            row.push(plus_minus(here().filter_map(|it| it.last)));
            row.push(plus_minus(here().filter_map(|it| it.whole)));
        }
        row
    });
    let header = [
        "epsilon",
        "episodes",
        "local, last fifth",
        "local, whole run",
        "global, last fifth",
        "global, whole run",
    ];
    Table::new(&header, rows)
}

fn plus_minus(values: impl Iterator<Item = f64>) -> String {
    match Spread::of(values) {
        None => "-".into(),
        Some(it) if it.count == 1 => format!("{:.3}", it.mean),
        Some(it) => format!("{:.3} ± {:.3}", it.mean, it.sd),
    }
}

fn task_table(continual: &Continual, results: &Results, traces: &[Trace]) -> Table {
    let mut header = vec!["task".to_owned(), "lethal ghost".into()];
    for agent in &results.settings.agents {
        header.extend([
            format!("{agent}, at the end"),
            format!("{agent}, over the task"),
        ]);
    }
    let rows = (0..continual.tasks).map(|task| {
        let ghost = continual.order[task as usize % continual.order.len()];
        let ghost = GHOSTS.get(usize::from(ghost)).copied().unwrap_or("?");
        let mut row = vec![(task + 1).to_string(), ghost.to_owned()];
        for agent in &results.settings.agents {
            let own = traces.iter().filter(|trace| trace.agent == *agent);
            let both: Vec<_> = own
                .filter_map(|trace| trace.task(continual, task))
                .collect();
            row.push(plus_minus(both.iter().map(|it| it.0)));
            row.push(plus_minus(both.iter().map(|it| it.1)));
        }
        row
    });
    Table {
        header,
        rows: rows.collect(),
    }
}

/// Rank correlation of epsilon and a final loss, and of how many runs it is.
fn order_of_epsilon(results: &Results, column: &str) -> Option<(f64, usize)> {
    let pairs = results.losses(column);
    let pairs: Points = pairs
        .filter_map(|it| Some((it.epsilon, it.last?)))
        .collect();
    Some((rank_correlation(&pairs)?, pairs.len()))
}

fn got_losses(results: &Results) -> Vec<String> {
    let lines = LOSSES.iter().filter_map(|(column, what)| {
        let (rank, runs) = order_of_epsilon(results, column)?;
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

fn got_tasks(
    panel: &str,
    continual: &Continual,
    results: &Results,
    traces: &[Trace],
) -> Vec<String> {
    let mut lines = Vec::new();
    let last = continual.tasks.saturating_sub(1);
    for agent in &results.settings.agents {
        let own = traces.iter().filter(|trace| trace.agent == *agent);
        let gains = own
            .filter_map(|trace| Some(trace.task(continual, last)?.0 - trace.task(continual, 0)?.0));
        if let Some(gain) = with_interval(gains) {
            lines.push(format!(
                "{panel} `{agent}`: return at the end of the last task minus that of the first: {gain}."
            ));
        }
    }
    let mean_over_tasks = |agent: &str, seed: u32| {
        let trace = traces
            .iter()
            .find(|it| it.agent == agent && it.seed == seed)?;
        let tasks = (0..continual.tasks).map(|task| Some(trace.task(continual, task)?.1));
        Spread::of(tasks.collect::<Option<Vec<_>>>()?).map(|spread| spread.mean)
    };
    if let Some((first, others)) = results.settings.agents.split_first() {
        for agent in others {
            let seeds = 1..=results.settings.seeds;
            let apart = seeds.filter_map(|seed| {
                Some(mean_over_tasks(agent, seed)? - mean_over_tasks(first, seed)?)
            });
            if let Some(apart) = with_interval(apart) {
                lines.push(format!(
                    "{panel} `{agent}` minus `{first}`, return over all tasks, seed by seed: {apart}."
                ));
            }
        }
    }
    lines
}

/// What the page says.
fn values(results: &Results) -> Values {
    let settings = &results.settings;
    let (ghosts, noise) = (&settings.continual, &settings.noise);
    let mut got = got_losses(results);
    got.extend(got_tasks("(b)", ghosts, results, &results.ghosts));
    got.extend(got_tasks("(c)", noise, results, &results.noise));
    let mut values = Values::default();
    values
        .set("losses", loss_table(results))
        .set("ghosts", task_table(ghosts, results, &results.ghosts))
        .set("noise", task_table(noise, results, &results.noise));
    let missing = &results.missing;
    values
        .when("some_missing", !missing.is_empty())
        .set("missing", missing.join(", "))
        .when("nothing", got.is_empty() && missing.is_empty())
        .items("got", got);
    let short = ghosts.episodes_per_task.min(noise.episodes_per_task) < 2 * RETURNS_OF as u64;
    let replay = "replay.capacity_transitions=";
    let mut capacities = ghosts
        .sets
        .iter()
        .filter_map(|set| set.strip_prefix(replay));
    let capacity = capacities.next();
    values
        .when(
            "out_of_order",
            order_of_epsilon(results, LOSSES[1].0).is_some_and(|(rank, _)| rank <= 0.0),
        )
        .when("smaller_replay", capacity.is_some())
        .set("capacity", capacity.unwrap_or_default())
        .when("short_tasks", short)
        .set("returns_of", RETURNS_OF)
        .set("episode_frames_max", EPISODE_FRAMES_MAX);
    values
        .set("frames", settings.predictability.frames)
        .set("agent", &settings.predictability.agent)
        .set(
            "epsilons",
            format!("{:?}", settings.predictability.epsilons),
        )
        .set("ghosts_tasks", ghosts.tasks)
        .set("ghosts_episodes", ghosts.episodes_per_task)
        .set("noise_tasks", noise.tasks)
        .set("noise_episodes", noise.episodes_per_task)
        .set("envs", ghosts.envs)
        .set("seeds", settings.seeds)
        .set("preset", &settings.preset)
        .when("has_sets", !settings.sets.is_empty())
        .set("sets", settings.sets.join(", "));
    values
}
