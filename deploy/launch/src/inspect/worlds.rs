//! What one agent costs in several worlds: a Markdown table with a line for each, beside the same with whole frames.
//! It is the table of `deploy/experiments/results/inspect/README.md`.

use std::collections::BTreeSet;

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
    "zeros in a batch",
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
        let mut cells = cells(config)?;
        if played {
            cells.extend(shares.map_or_else(|| vec![String::new(); PLAYED.len()], played_cells));
        }
        text += &line(&cells);
    }
    Ok(text)
}

fn cells(config: &RunConfig) -> anyhow::Result<Vec<String>> {
    let is = Inspection::of(config)?;
    let whole = Inspection::of(&config.with_whole_frames()?)?;
    let bytes = |it: &Inspection, what: &str| {
        let line = it.bytes.iter().find(|line| line.what == what);
        line.map_or(0, |line| line.is)
    };
    let flops = |it: &Inspection| it.update_flops.iter().map(|line| line.is).sum::<u64>();
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
    let batch = |it| format!("{:.2}", bytes(it, "a batch") as f64 / 1e6);
    let update = |it| format!("{:.2}", flops(it) as f64 / 1e9);
    Ok(vec![
        run.world.clone(),
        beside(
            format!("{}x{}", run.frame_height, run.frame_width),
            format!("{}x{}", frame.height, frame.width),
        ),
        beside(transition(&is), transition(&whole)),
        beside(batch(&is), batch(&whole)),
        beside(update(&is), update(&whole)),
        format!("{:.2}", bytes(&is, "a broadcast") as f64 / 1e6),
        format!("{} of {}", differ.len(), config.world.num_actions()),
    ])
}

fn played_cells(shares: RowShares) -> Vec<String> {
    let RowShares {
        rows,
        without_bootstrap,
        without_positive,
        zero_bytes,
        repeated_online,
        repeated_target,
        ..
    } = shares;
    let percents = [
        without_bootstrap,
        without_positive,
        zero_bytes,
        repeated_online,
        repeated_target,
    ];
    let percents = percents.map(|share| format!("{:.1}%", 100.0 * share));
    percents.into_iter().chain([rows.to_string()]).collect()
}
