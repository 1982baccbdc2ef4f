//! `summary.json`: how a run ended and its counts, in one object.
//! The recorder fills the summary in.

use std::{collections::BTreeMap, fs, time::Duration};

use anyhow::Context;
use driml_machine::units::{count, duration};
use driml_protocol::ReplayStatus;
use serde::{Deserialize, Serialize};

use super::{
    folder::RunFolder,
    metrics::ResumePoint,
    table::{read_json, write_atomically},
};
use crate::{
    console::align_columns,
    run_view::RunView,
    stats::{interval, mean_and_deviation},
};

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    /// All frames are stored, their updates done and the last checkpoint written.
    Finished,
    /// A person stopped the run; what was done is saved.
    Interrupted,
    /// A process failed.
    Failed,
}

/// The mean undiscounted return of whole episodes, and its 95% confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ReturnInterval {
    pub(crate) mean: f64,
    pub(crate) low: f64,
    pub(crate) high: f64,
}

impl ReturnInterval {
    /// The mean of at least one return, and its interval; for a single return, both ends are that return.
    pub(crate) fn new(returns: &[f64]) -> Self {
        let (mean, _) = mean_and_deviation(returns);
        let ends = interval(returns).and_then(|it| it.ends);
        let (low, high) = ends.unwrap_or((mean, mean));
        Self { mean, low, high }
    }
}

/// The returns of a finished run's weights, and of a random policy over as many episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct LastPlay {
    /// Which weights: "averaged" or "online".
    pub(crate) weights: String,
    pub(crate) episodes: u64,
    #[serde(flatten)]
    pub(crate) agent: ReturnInterval,
    pub(crate) random: ReturnInterval,
}

/// The contents of `summary.json`: how a run ended and what it counted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// How the run ended.
    pub outcome: Outcome,
    /// The world's name, such as `procgen:bigfish`.
    pub world: String,
    /// The agent's name, such as `driml-ada`.
    pub agent: String,
    /// The seed of every generator of the run.
    pub seed: u64,
    /// Updates that were done when the run was last resumed; 0 if it never was. Frames, updates, rows, episodes, mean return,
    /// seconds and mean k are of the whole run, all other fields only of the time since then.
    pub resumed_after_updates: u64,
    /// Frames of the run: transitions stored.
    pub frames: u64,
    /// Updates that the learner has done.
    pub updates: u64,
    /// Rows per transition, both counted from the end of the warm-up.
    pub replay_ratio: Option<f64>,
    /// Episodes that ended; in a resumed run also those in which the replay filled again.
    pub episodes: u64,
    /// Mean undiscounted return of the last 100 training episodes, also across a resume.
    pub mean_return: Option<f64>,
    /// Number of episodes in that mean: 100, or all if there were fewer.
    pub mean_return_of: u64,
    /// Seconds from the start of the first process to the end of the run.
    pub wall_seconds: f64,
    /// Frames over wall seconds.
    pub frames_per_second: f64,
    /// Updates over wall seconds.
    pub updates_per_second: f64,
    /// Mean k of the rows served with a positive; for several positives, of the furthest.
    pub mean_k: Option<f64>,
    /// Version of the last weights.
    pub weights_version: u64,
    /// SHA-256 of the last weights, hexadecimal.
    pub weights_sha256: String,
    /// How often a replay server that had died was restarted with the replay that it had kept.
    pub replay_servers_restarted: u32,
    /// How often an actor that had died was restarted; transitions that it had not delivered are in no count.
    pub actors_restarted: u32,
    /// Highest resident memory of each process, MiB.
    pub rss_mib_max: BTreeMap<String, Option<f64>>,
    /// The returns of the weights; none if they were not played.
    pub(crate) played: Option<LastPlay>,
    /// The replay's status at the end; its episodes are those since the run was last resumed.
    pub replay: ReplayStatus,
}

impl Summary {
    /// The summary of a run that took `wall_seconds`. A resumed run without any progress still has the counts of `before`.
    pub(crate) fn new(
        outcome: Outcome,
        view: &RunView,
        wall_seconds: f64,
        before: ResumePoint,
    ) -> Self {
        let (plan, replay, learner) = (&view.plan, &view.replay, &view.learner);
        let frames = replay.transitions_inserted.max(before.frames);
        let updates = learner.updates.max(before.updates);
        let episodes = view.episodes;
        Self {
            outcome,
            world: plan.world.clone(),
            agent: plan.agent.clone(),
            seed: plan.seed,
            resumed_after_updates: view.after_updates.unwrap_or(0),
            frames,
            updates,
            replay_ratio: replay.replay_ratio(),
            episodes: episodes.count,
            mean_return: episodes.mean_return,
            mean_return_of: episodes.mean_return_of as u64,
            wall_seconds,
            frames_per_second: frames as f64 / wall_seconds,
            updates_per_second: updates as f64 / wall_seconds,
            mean_k: view.k.map(|it| it.mean),
            weights_version: learner.weights_version,
            weights_sha256: learner.weights_sha256.clone(),
            replay_servers_restarted: 0,
            actors_restarted: 0,
            rss_mib_max: BTreeMap::new(),
            played: None,
            replay: replay.clone(),
        }
    }

    /// Writes the summary into the run folder, whole or not at all.
    pub fn write(&self, folder: &RunFolder) -> anyhow::Result<()> {
        let mut text = serde_json::to_vec_pretty(self).context("writing the summary")?;
        text.push(b'\n');
        write_atomically(&folder.summary(), &text)
    }

    /// Reads the summary of the run in `folder`.
    pub fn read(folder: &RunFolder) -> anyhow::Result<Self> {
        read_json(&folder.summary())
    }

    pub(super) fn remove(folder: &RunFolder) -> anyhow::Result<()> {
        let path = folder.summary();
        match fs::remove_file(&path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                Err(e).with_context(|| format!("removing {}", path.display()))
            }
            _ => Ok(()),
        }
    }

    /// Whether the run in `folder` finished.
    pub fn is_finished(folder: &RunFolder) -> bool {
        Self::read(folder).is_ok_and(|it| it.outcome == Outcome::Finished)
    }

    /// The returns of a finished run's weights, and what a person may do next, one command per line.
    pub(crate) fn next_steps(&self, run_dir: &RunFolder, is_resumable: bool) -> String {
        let run = run_dir.quoted();
        let more = self.frames.saturating_mul(2);
        let film = "films the agent";
        let mut next = vec![
            (format!("evaluate {run} --record play.gif"), film),
            plot_command(run_dir),
        ];
        if is_resumable {
            next.push((
                format!("train --resume {run} --frames {more}"),
                "continues training",
            ));
        }
        self.describe_returns() + &format_commands(&next)
    }

    /// Describes how the run ended, and the returns of its weights.
    pub fn describe(&self, run_dir: &RunFolder) -> String {
        let (counts, returns) = (self.describe_counts(), self.describe_returns());
        format!("{counts}\n{returns}{}\n", run_dir.display())
    }

    fn describe_returns(&self) -> String {
        let Some(played) = &self.played else {
            return String::new();
        };
        let ReturnInterval { mean, low, high } = played.agent;
        let agent = format!("{mean:.2}, 95% interval {low:.2} to {high:.2}");
        let ReturnInterval { mean, low, high } = played.random;
        let random = format!("{mean:.2} ({low:.2} to {high:.2})");
        let (weights, episodes) = (&played.weights, played.episodes);
        format!(
            "Greedy return ({weights} weights): {agent}, {episodes} episodes; a random policy earns {random}.\n"
        )
    }

    /// Describes how the run ended and what it counted; without time and speed if the time is not known.
    pub(crate) fn describe_counts(&self) -> String {
        let (of, episodes) = (self.mean_return_of, count(self.episodes, "episode"));
        let returns = match self.mean_return {
            None => "no episode ended".into(),
            Some(mean) => {
                format!("mean return {mean:.2} over the last {of} of {episodes}")
            }
        };
        let time = Duration::try_from_secs_f64(self.wall_seconds).map(|it| {
            let (frames, updates) = (self.frames_per_second, self.updates_per_second);
            let time = duration(it);
            format!(" in {time} ({frames:.0} frames/s, {updates:.2} updates/s)")
        });
        let ratio = self.replay_ratio.map(|it| format!("{it:.2}"));
        let how = match self.outcome {
            Outcome::Finished => "finished",
            _ => "interrupted",
        };
        format!(
            "{how}: {} and {}{}, replay ratio {}, {returns}",
            count(self.frames, "frame"),
            count(self.updates, "update"),
            time.unwrap_or_default(),
            ratio.as_deref().unwrap_or("-"),
        )
    }
}

pub(crate) fn plot_command(run_dir: &RunFolder) -> (String, &'static str) {
    let command = format!("plot {} --out plot.png", run_dir.quoted());
    (command, "return, losses, k and speed")
}

pub(crate) fn format_commands(commands: &[(String, &str)]) -> String {
    let row =
        |(command, what): &(String, &str)| vec![format!("  driml {command}"), format!(" {what}")];
    align_columns(&commands.iter().map(row).collect::<Vec<_>>(), &[])
}
