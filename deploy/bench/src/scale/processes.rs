//! Whole runs on Procgen with more and more actor processes, watched from outside: at a replay ratio of 8, where everybody waits
//! for the learner, and at one so low that the actors are what limits.

use std::time::Instant;

use driml_protocol::Quantiles;

use super::cases::{Table, actors, seconds};
use crate::{
    flags::BenchScaleArgs,
    launched::{Launched, Moment},
    settings,
};

pub(super) const TITLE: &str =
    "Processes: driml local on bigfish with driml-ada, actors of 16 copies";

/// Actor processes that are measured.
const ACTORS: [u32; 6] = [1, 2, 4, 8, 16, 32];
const AGENT: &str = "driml-ada";
/// Replay ratios, and how far either side may run ahead at each, in transitions.
const RATIOS: [(f64, u64); 2] = [(8.0, 256), (0.1, 10_000)];

/// Measures every number of actors at both ratios.
///
/// # Errors
/// An engine that cannot be had, a run that failed.
pub(super) fn measure(args: &BenchScaleArgs) -> anyhow::Result<Table> {
    let mut table = Table::new(&[
        "ratio",
        "actors",
        "frames/s",
        "updates/s",
        "all act after s",
        "answer p50 ms",
        "answer p99 ms",
        "insert p50 ms",
        "insert p99 ms",
        "weights behind p50 s",
        "weights behind p99 s",
        "behind p99 updates",
        "MiB of all",
        "retried",
        "lost",
    ]);
    for (ratio, slack) in RATIOS {
        for actors in actors(args, &ACTORS) {
            let values = watch(args, actors, ratio, slack)?;
            table.add(
                "processes",
                &[ratio.to_string(), actors.to_string()],
                &values,
            );
        }
    }
    Ok(table)
}

/// A run with `actors` actors, from its start until it has been watched.
fn watch(
    args: &BenchScaleArgs,
    actors: u32,
    ratio: f64,
    slack: u64,
) -> anyhow::Result<Vec<Option<f64>>> {
    let sets = [
        format!("replay.replay_ratio={ratio}"),
        format!("replay.slack_transitions={slack}"),
        "replay.capacity_transitions=20000".into(),
        "replay.transitions_max=1000000000000".into(),
    ];
    let set_words: Vec<_> = sets.iter().map(String::as_str).collect();
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &set_words)?;
    let started = Instant::now();
    let count = actors.to_string();
    let mut words = vec![
        "--env",
        settings::WORLD,
        "--agent",
        AGENT,
        "--actors",
        &count,
    ];
    words.extend(set_words.iter().flat_map(|set| ["--set", set]));
    let mut run = Launched::start(&words, &config)?;
    let acting = run.wait_until(|replay, _| replay.actors_acting >= actors)?;
    let all_act_after = (acting.at - started).as_secs_f64();
    let warm = run.wait_until(|_, learner| learner.updates > 2)?;
    let [first, last] = run.watch(warm, seconds(args))?;
    let summary = run.interrupt()?;
    let elapsed = (last.at - first.at).as_secs_f64();
    let rate = |count: fn(&Moment) -> u64| Some((count(&last) - count(&first)) as f64 / elapsed);
    let quantiles = |it: Option<Quantiles>| [it.map(|it| it.p50), it.map(|it| it.p99)];
    let mut values = vec![
        rate(|moment| moment.replay.transitions_inserted),
        rate(|moment| moment.learner.updates),
        Some(all_act_after),
    ];
    let replay = &last.replay;
    values.extend(quantiles(replay.answer_ms));
    values.extend(quantiles(replay.insert_ms));
    values.extend(quantiles(replay.weights_behind_s));
    values.push(replay.weights_behind_updates.map(|it| it.p99));
    let memory = summary.rss_mib_max.values();
    values.push(Some(memory.filter_map(|mib| mib.as_f64()).sum()));
    let counts = [summary.chunks_retried, summary.transitions_lost];
    values.extend(counts.map(|n| Some(n as f64)));
    Ok(values)
}
