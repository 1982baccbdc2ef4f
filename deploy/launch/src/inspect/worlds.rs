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

/// The columns as CSV has them.
const COLUMNS: [&str; 20] = [
    "world",
    "frame_height",
    "frame_width",
    "whole_frame_height",
    "whole_frame_width",
    "transition_bytes",
    "whole_transition_bytes",
    "batch_bytes",
    "whole_batch_bytes",
    "update_flops",
    "whole_update_flops",
    "broadcast_bytes",
    "actions_that_differ",
    "actions",
    "rows_without_bootstrap",
    "rows_without_positive",
    "bytes_left_out",
    "repeated_s_t_and_s_t_k",
    "repeated_s_t_n",
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
        let mut cells = vec![config.run.world.clone()];
        cells.extend(WorldCost::of(config, *shares)?.cells());
        if played {
            cells.extend(shares.map_or_else(|| vec![String::new(); PLAYED.len()], played_cells));
        }
        text += &line(&cells);
    }
    Ok(text)
}

/// The same numbers as CSV, in bytes and FLOPs: a column for what is, and one for what it would be with nothing left out.
///
/// # Errors
/// As [`markdown`].
pub fn csv(configs: &[(RunConfig, Option<RowShares>)]) -> anyhow::Result<String> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(COLUMNS)?;
    for (config, shares) in configs {
        let cost = WorldCost::of(config, *shares)?;
        let pairs = [cost.transition_bytes, cost.batch_bytes, cost.update_flops];
        let numbers = pairs.iter().flat_map(|it| [it.is, it.whole]);
        let mut row = vec![config.run.world.clone()];
        row.extend(cost.frame.map(|side| side.to_string()));
        row.extend(cost.whole_frame.map(|side| side.to_string()));
        row.extend(numbers.map(|it| format!("{it:.0}")));
        row.push(cost.broadcast_bytes.to_string());
        row.extend(cost.actions.map(|it| it.to_string()));
        row.extend(match shares {
            Some(shares) => shares_in_columns(*shares),
            None => [const { String::new() }; 6],
        });
        writer.write_record(row)?;
    }
    Ok(String::from_utf8(writer.into_inner()?)?)
}

/// How much there is of something, and how much there would be with nothing left out.
#[derive(Clone, Copy)]
struct Beside {
    is: f64,
    whole: f64,
}

impl Beside {
    /// Both in words, or one if they read the same.
    fn write(self, text: impl Fn(f64) -> String) -> String {
        let (is, whole) = (text(self.is), text(self.whole));
        match is == whole {
            true => is,
            false => format!("{is} ({whole})"),
        }
    }
}

/// What an agent costs in one world.
struct WorldCost {
    /// Height and width as they are sent, and as the world makes them.
    frame: [u32; 2],
    whole_frame: [u32; 2],
    transition_bytes: Beside,
    batch_bytes: Beside,
    update_flops: Beside,
    broadcast_bytes: u64,
    /// Those that differ, and all.
    actions: [usize; 2],
}

impl WorldCost {
    fn of(config: &RunConfig, shares: Option<RowShares>) -> anyhow::Result<Self> {
        let whole_frames = config.with_whole_frames()?;
        let (is, whole) = (Inspection::of(config)?, Inspection::of(&whole_frames)?);
        let bytes = |it: &Inspection, what: &str| {
            let line = it.bytes.iter().find(|line| line.what == what);
            line.map_or(0, |line| line.is)
        };
        let frame = config.world.frame_shape();
        let differ: BTreeSet<_> = config.world.visible_actions().into_iter().collect();
        let transition = |it| bytes(it, "a transition in a chunk") as f64;
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
        Ok(Self {
            frame: [config.run.frame_height, config.run.frame_width],
            whole_frame: [frame.height as u32, frame.width as u32],
            transition_bytes: Beside {
                is: transition(&is),
                whole: transition(&whole),
            },
            batch_bytes: Beside {
                is: batch_is,
                whole: whole_batch(&whole_frames),
            },
            update_flops: Beside {
                is: flops(config, false, shares),
                whole: flops(&whole_frames, true, None),
            },
            broadcast_bytes: bytes(&is, "a broadcast"),
            actions: [differ.len(), config.world.num_actions()],
        })
    }

    /// The cells of [`HEADINGS`] after the world's name.
    fn cells(&self) -> [String; 6] {
        let side = |[height, width]: [u32; 2]| format!("{height}x{width}");
        let (frame, whole_frame) = (side(self.frame), side(self.whole_frame));
        let [differ, actions] = self.actions;
        [
            match frame == whole_frame {
                true => frame,
                false => format!("{frame} ({whole_frame})"),
            },
            self.transition_bytes.write(|it| format!("{it:.0}")),
            self.batch_bytes.write(|it| format!("{:.2}", it / 1e6)),
            self.update_flops.write(|it| format!("{:.2}", it / 1e9)),
            format!("{:.2}", self.broadcast_bytes as f64 / 1e6),
            format!("{differ} of {actions}"),
        ]
    }
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

/// Shares of rows, of bytes and of states as [`PLAYED`] and [`COLUMNS`] have them.
fn in_order(shares: RowShares) -> ([f64; 5], u64) {
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
    let each = [
        without_bootstrap,
        without_positive,
        absent_bytes + shared_bytes,
        repeated_online,
        repeated_target,
    ];
    (each, rows)
}

fn played_cells(shares: RowShares) -> Vec<String> {
    let (shares, rows) = in_order(shares);
    let percents = shares.map(|share| format!("{:.1}%", 100.0 * share));
    percents.into_iter().chain([rows.to_string()]).collect()
}

fn shares_in_columns(shares: RowShares) -> [String; 6] {
    let ([a, b, c, d, e], rows) = in_order(shares);
    let [a, b, c, d, e] = [a, b, c, d, e].map(|share| format!("{share:.6}"));
    [a, b, c, d, e, rows.to_string()]
}
