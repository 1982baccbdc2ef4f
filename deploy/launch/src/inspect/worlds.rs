//! What one agent costs in several worlds: a Markdown table with a line for each, and in brackets what it would be with whole frames,
//! every action's distribution of s_t, targets of all rows, and each state computed and sent. It is the table of `deploy/experiments/results/inspect/README.md`.

use std::collections::BTreeSet;

use driml_learner::cost::{UpdateCost, UpdateShape};
use driml_protocol::BatchHeader;
use driml_settings::config::RunConfig;

use super::{Inspection, play::RowShares};

const HEADINGS: [&str; 7] = [
    "world",
    "frame",
    "transition, bytes",
    "batch, MB",
    "update, GFLOP",
    "broadcast, MB",
    "actions that differ",
];

const PLAYED: [&str; 6] = [
    "no bootstrap",
    "no positive",
    "bytes of a batch that do not travel",
    "s_t, s_{t+k} that repeat",
    "s_{t+n} that repeat",
    "rows",
];

/// A table of `configs`, one agent's in different worlds; with what was found in rows, if they were played.
///
/// # Errors
/// As [`Inspection::of`].
pub fn markdown(configs: &[(RunConfig, Option<RowShares>)]) -> anyhow::Result<String> {
    let played = configs.iter().any(|(_, shares)| shares.is_some());
    let headings = HEADINGS.iter().chain(PLAYED.iter().filter(|_| played));
    let headings: Vec<_> = headings.copied().collect();
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let mut text = line(&headings.iter().map(|&it| it.to_owned()).collect::<Vec<_>>());
    text += &line(&vec!["---".to_owned(); headings.len()]);
    for (config, shares) in configs {
        let mut cells = cells(config, *shares)?;
        if played {
            cells.extend(shares.map_or_else(|| vec![String::new(); PLAYED.len()], played_cells));
        }
        text += &line(&cells);
    }
    Ok(text)
}

fn cells(config: &RunConfig, shares: Option<RowShares>) -> anyhow::Result<Vec<String>> {
    let whole_frames = config.with_whole_frames()?;
    let (is, whole) = (Inspection::of(config)?, Inspection::of(&whole_frames)?);
    let bytes = |it: &Inspection, what: &str| {
        let line = it.bytes.iter().find(|line| line.what == what);
        line.map_or(0, |line| line.is)
    };
    let beside = |is: String, whole: String| {
        if is == whole {
            is
        } else {
            format!("{is} ({whole})")
        }
    };
    let run = &config.run;
    let frame = config.world.frame_shape();
    let differ: BTreeSet<_> = config.world.visible_actions().into_iter().collect();
    let transition = |it| bytes(it, "a transition in a chunk").to_string();
    let update = |flops: f64| format!("{:.2}", flops / 1e9);
    // With every state, and each of them whole.
    let whole_batch = |config: &RunConfig| {
        let header = BatchHeader {
            stacked: None,
            ..BatchHeader::of(&config.run, config.learner.batch_size)
        };
        let header = header.sampled_by(&config.replay.sampling);
        header.payload_bytes() as f64
    };
    let batch_is = shares.map_or(bytes(&is, "a batch") as f64, |shares| {
        whole_batch(config) * (1.0 - shares.absent_bytes - shares.shared_bytes)
    });
    let megabytes = |bytes: f64| format!("{:.2}", bytes / 1e6);
    Ok(vec![
        run.world.clone(),
        beside(
            format!("{}x{}", run.frame_height, run.frame_width),
            format!("{}x{}", frame.height, frame.width),
        ),
        beside(transition(&is), transition(&whole)),
        beside(megabytes(batch_is), megabytes(whole_batch(&whole_frames))),
        beside(
            update(flops(config, false, shares)),
            update(flops(&whole_frames, true, None)),
        ),
        format!("{:.2}", bytes(&is, "a broadcast") as f64 / 1e6),
        format!("{} of {}", differ.len(), config.world.num_actions()),
    ])
}

/// FLOPs of an update, of whose states those are computed that `shares` has, or all.
fn flops(config: &RunConfig, every_action: bool, shares: Option<RowShares>) -> f64 {
    let shape = UpdateShape {
        every_action,
        ..UpdateShape::of(&config.learner, config.run.horizon.positives())
    };
    let cost = UpdateCost::of(&config.model, &shape);
    let left_out = shares.map_or(0.0, |shares| {
        let online = (1.0 - shares.computed_online) * (cost.online + cost.states) as f64;
        let target = (1.0 - shares.computed_target) * (cost.target + cost.double_dqn) as f64;
        online + target
    });
    cost.total() as f64 - left_out
}

fn played_cells(shares: RowShares) -> Vec<String> {
    let RowShares {
        rows,
        without_bootstrap,
        without_positive,
        absent_bytes,
        shared_bytes,
        repeated_online,
        repeated_target,
        ..
    } = shares;
    let percents = [
        without_bootstrap,
        without_positive,
        absent_bytes + shared_bytes,
        repeated_online,
        repeated_target,
    ];
    let percents = percents.map(|share| format!("{:.1}%", 100.0 * share));
    percents.into_iter().chain([rows.to_string()]).collect()
}
