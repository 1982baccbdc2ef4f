//! Data and page of Fig. 3, from the runs' metrics.
//! It draws nothing beyond the episodes and frames that the settings ask for.

use driml_protocol::RETURNS_OF;

use super::{
    figure::figure,
    plans::{EPISODE_FRAMES_MAX, RunKind},
    results::{LOSSES, Points, Results, Trace, loss_of, traces},
    settings::Continual,
};
use crate::{
    page::{Page, Table},
    session::Session,
    statistics::{Spread, interval, rank_correlation},
    template::Values,
};

/// Share of a run, at its end, whose mean is the final loss.
const FINAL: f64 = 0.2;
/// Names of ghosts 0 to 3.
const GHOSTS: [&str; 4] = ["red", "cyan", "orange", "green"];

/// Final loss of a run of (a).
struct Loss {
    epsilon: f64,
    seed: u32,
    column: &'static str,
    last: f64,
    whole: f64,
}

/// Writes the tables, figure 3 and the page of what was run.
pub(super) fn report(session: Session, results: &Results) -> anyhow::Result<()> {
    let losses = losses(results)?;
    let ghosts = traces(results, false)?;
    let noise = traces(results, true)?;
    session.figure("fig3", &figure(results, &ghosts, &noise)?)?;
    write_losses(&session, results, &losses)?;
    let (continual, with_noise) = (&results.settings.continual, &results.settings.noise);
    write_traces(&session, "ghosts", &ghosts)?;
    write_traces(&session, "noise", &noise)?;
    let mut tables = Values::default();
    tables
        .set("losses", loss_table(results, &losses))
        .set("ghosts", task_table(continual, results, &ghosts))
        .set("noise", task_table(with_noise, results, &noise));
    let mut got = got_losses(&losses);
    got.extend(got_tasks("(b)", continual, results, &ghosts));
    got.extend(got_tasks("(c)", with_noise, results, &noise));
    session.finish(&page(results, &losses, got, tables))
}

fn losses(results: &Results) -> anyhow::Result<Vec<Loss>> {
    let mut losses = Vec::new();
    let settings = &results.settings.predictability;
    let from = settings.frames as f64 * (1.0 - FINAL);
    for &epsilon in &settings.epsilons {
        for (column, _) in LOSSES {
            for (seed, values) in loss_of(results, epsilon, column)? {
                let mean = |from: f64| {
                    let late = values.iter().filter(|(frames, _)| *frames >= from);
                    Spread::of(late.map(|point| point.1)).map(|spread| spread.mean)
                };
                if let (Some(last), Some(whole)) = (mean(from), mean(0.0)) {
                    losses.push(Loss {
                        epsilon,
                        seed,
                        column,
                        last,
                        whole,
                    });
                }
            }
        }
    }
    Ok(losses)
}

fn write_losses(session: &Session, results: &Results, losses: &[Loss]) -> anyhow::Result<()> {
    let mut rows = Vec::new();
    for &epsilon in &results.settings.predictability.epsilons {
        for (column, _) in LOSSES {
            for (seed, values) in loss_of(results, epsilon, column)? {
                rows.extend(values.into_iter().map(|(frames, loss)| {
                    vec![
                        epsilon.to_string(),
                        seed.to_string(),
                        column.to_owned(),
                        format!("{frames:.0}"),
                        format!("{loss:.4}"),
                    ]
                }));
            }
        }
    }
    session.csv("loss", &["epsilon", "seed", "loss", "frames", "nats"], rows)?;
    let rows = losses.iter().map(|it| {
        vec![
            it.epsilon.to_string(),
            it.seed.to_string(),
            it.column.to_owned(),
            format!("{:.4}", it.last),
            format!("{:.4}", it.whole),
        ]
    });
    session.csv(
        "final_loss",
        &["epsilon", "seed", "loss", "last_fifth_nats", "whole_nats"],
        rows,
    )
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
    session.csv(name, &["agent", "seed", "episodes", "mean_return"], rows)
}

fn loss_table(results: &Results, losses: &[Loss]) -> Table {
    let rows = results
        .settings
        .predictability
        .epsilons
        .iter()
        .map(|&epsilon| {
            let kind = RunKind::Epsilon(epsilon);
            let here = results.runs.iter().filter(|(of, ..)| *of == kind);
            let episodes = here.map(|(.., ran)| ran.summary.episodes as f64);
            let mut row = vec![
                epsilon.to_string(),
                Spread::of(episodes).map_or("-".into(), |it| format!("{:.0}", it.mean)),
            ];
            for (column, _) in LOSSES {
                let of = |value: &dyn Fn(&Loss) -> f64| {
                    let here = losses
                        .iter()
                        .filter(|it| it.epsilon == epsilon && it.column == column);
                    plus_minus(here.map(value))
                };
                row.push(of(&|it| it.last));
                row.push(of(&|it| it.whole));
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
    Table {
        header: header.map(String::from).to_vec(),
        rows: rows.collect(),
    }
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

/// Epsilon and the final loss of each run.
fn final_losses(losses: &[Loss], column: &str) -> Points {
    let of = losses.iter().filter(|it| it.column == column);
    of.map(|it| (it.epsilon, it.last)).collect()
}

/// Rank correlation of epsilon and the final global loss.
fn order_of_epsilon(losses: &[Loss]) -> Option<f64> {
    rank_correlation(&final_losses(losses, LOSSES[1].0))
}

fn got_losses(losses: &[Loss]) -> Vec<String> {
    let lines = LOSSES.iter().filter_map(|(column, what)| {
        let pairs = final_losses(losses, column);
        let rank = rank_correlation(&pairs)?;
        Some(format!(
            "(a) Rank correlation of epsilon and the final {what} loss over {} runs: {rank:.2} (1 where each more random ghost costs more).",
            pairs.len()
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

fn page(results: &Results, losses: &[Loss], got: Vec<String>, mut values: Values) -> Page {
    let settings = &results.settings;
    let (ghosts, noise) = (&settings.continual, &settings.noise);
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
            order_of_epsilon(losses).is_some_and(|rank| rank <= 0.0),
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
    let template = include_str!("page.md");
    Page::new(template, values, &results.command, results.smoke)
}
