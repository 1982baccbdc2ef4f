//! The returns of a run's evaluated checkpoints: `evaluations.csv`, and the best checkpoint, kept in `best/`.
//! This module plays nothing.

use std::{ffi::OsString, fs, path::Path};

use anyhow::Context;
use driml_learner::checkpoint;
use driml_machine::{error::usage, units::count};
use serde::Deserialize;

use super::{
    folder::RunFolder,
    table::{Table, append, csv_row, open_to_append},
};
use crate::metrics::{cell, rounded};

const HEADER: &str = "seconds,frames,updates,episodes,evaluated_return,evaluated_return_sd";

/// The return of a checkpoint over whole episodes.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct EvaluationRow {
    /// Seconds of the run at the checkpoint, from the metrics; none without metrics.
    pub(crate) seconds: Option<f64>,
    /// Frames of the run at the checkpoint, likewise.
    pub(crate) frames: Option<u64>,
    pub(crate) updates: u64,
    pub(crate) episodes: u32,
    /// Mean undiscounted return of the episodes, rounded as in the table.
    #[serde(rename = "evaluated_return")]
    pub(crate) mean_return: f64,
    /// Standard deviation of the return over episodes; none for one episode.
    #[serde(rename = "evaluated_return_sd")]
    pub(crate) deviation: Option<f64>,
}

impl EvaluationRow {
    /// Reads all evaluations in a run's folder, in the order in which they were made; none without the file.
    pub fn all(folder: &RunFolder) -> anyhow::Result<Vec<Self>> {
        let path = folder.evaluations();
        Table::read(&path)?.parse_rows(&path).with_context(|| {
            usage!(
                "{} is not a table of evaluations: move it away",
                path.display()
            )
        })
    }

    /// The kept best checkpoint, with the evaluation of it that has the most episodes; none if none is kept.
    pub(crate) fn best(folder: &RunFolder) -> anyhow::Result<Option<Self>> {
        let kept = checkpoint::list(&folder.best())?;
        let played = Self::all(folder)?.into_iter();
        let of_best = played.filter(|it| kept.last().is_some_and(|(best, _)| *best == it.updates));
        Ok(of_best.max_by_key(|it| it.episodes))
    }

    /// An evaluation of the checkpoint after `updates`. The run's time and frames at that point come from the row of metrics at or
    /// before the checkpoint, or else from the first row, which is written within about a second.
    pub(crate) fn new(
        folder: &RunFolder,
        updates: u64,
        episodes: u32,
        (mean_return, deviation): (f64, Option<f64>),
    ) -> Self {
        let metrics = Table::read(&folder.metrics()).unwrap_or_default();
        let updates_at = |row: &_| metrics.value::<u64>(row, "updates");
        let is_before = |row: &&_| updates_at(row).is_some_and(|at| at <= updates);
        let before = metrics.rows.iter().rev().find(is_before);
        let row = before.or(metrics.rows.first());
        Self {
            seconds: row.and_then(|row| metrics.value(row, "seconds")),
            frames: row.and_then(|row| metrics.value(row, "frames")),
            updates,
            episodes,
            mean_return: rounded(mean_return),
            deviation: deviation.map(rounded),
        }
    }

    /// Describes the evaluation in one line.
    pub fn describe(&self) -> String {
        format!(
            "evaluated after {}: mean return {:.3}{} over {}",
            count(self.updates, "update"),
            self.mean_return,
            crate::stats::describe_deviation(self.deviation),
            count(self.episodes, "episode")
        )
    }

    /// Adds the evaluation to the run's table, which is made if it does not exist. A row that is there is not repeated.
    pub(crate) fn append_to(&self, folder: &RunFolder) -> anyhow::Result<()> {
        if Self::all(folder)?.contains(self) {
            return Ok(());
        }
        let path = folder.evaluations();
        let doing = || format!("writing {}", path.display());
        let mut file = open_to_append(&path)?;
        let is_new = file.metadata().with_context(doing)?.len() == 0;
        let row = csv_row([
            cell(self.seconds),
            cell(self.frames),
            self.updates.to_string(),
            self.episodes.to_string(),
            self.mean_return.to_string(),
            cell(self.deviation),
        ]);
        let head = is_new.then(|| csv_row(HEADER.split(',')));
        // A whole row in one write, as others may read meanwhile.
        append(&mut file, &[head.unwrap_or_default(), row].concat()).with_context(doing)
    }
}

/// A checkpoint that is being evaluated, in memory, so that it can be kept even if the learner deletes it meanwhile.
#[derive(Debug)]
pub(crate) struct Candidate {
    name: String,
    files: Vec<(OsString, Vec<u8>)>,
}

impl Candidate {
    pub(crate) fn read(checkpoint: &Path) -> anyhow::Result<Self> {
        let doing = || format!("reading {}", checkpoint.display());
        let mut files = Vec::new();
        for entry in fs::read_dir(checkpoint).with_context(doing)? {
            let entry = entry.with_context(doing)?;
            let bytes = fs::read(entry.path()).with_context(doing)?;
            files.push((entry.file_name(), bytes));
        }
        let name = checkpoint.file_name().unwrap_or_default();
        let name = name.to_string_lossy().into_owned();
        Ok(Self { name, files })
    }

    /// Adds the evaluation to the run's table. Keeps the checkpoint if it earned more than the best before it, over at least as many
    /// episodes. Returns whether it is the best.
    pub(crate) fn keep_if_best(
        &self,
        folder: &RunFolder,
        row: &EvaluationRow,
    ) -> anyhow::Result<bool> {
        let path = folder.evaluations();
        let file = open_to_append(&path)?;
        // If several processes evaluate one run, each compares with what the others kept.
        if let Err(e) = file.lock() {
            tracing::debug!("{} cannot be locked: {e}", path.display());
        }
        let is_best = EvaluationRow::best(folder)?.is_none_or(|best| {
            best.updates == row.updates
                || row.episodes >= best.episodes && row.mean_return > best.mean_return
        });
        // First, because a kept checkpoint without a row would not count as the best.
        row.append_to(folder)?;
        if is_best {
            self.replace_best(&folder.best())?;
        }
        Ok(is_best)
    }

    /// Makes this checkpoint the only one in the folder `best`.
    fn replace_best(&self, best: &Path) -> anyhow::Result<()> {
        let stored = checkpoint::store(best, &self.name, &self.files);
        let path =
            stored.with_context(|| format!("keeping {}", best.join(&self.name).display()))?;
        for (_, other) in checkpoint::list(best)? {
            if other != path {
                checkpoint::prune(&other);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::run_folder;

    /// Judges a checkpoint after `updates`, which the learner deletes while it is played.
    fn keep(folder: &RunFolder, updates: u64, mean: f64, episodes: u32) -> anyhow::Result<bool> {
        let path = folder.checkpoints().join(format!("checkpoint-{updates}"));
        fs::create_dir_all(&path).unwrap();
        fs::write(path.join("weights"), updates.to_string()).unwrap();
        let candidate = Candidate::read(&path).unwrap();
        fs::remove_dir_all(path).unwrap();
        let row = EvaluationRow::new(folder, updates, episodes, (mean, Some(0.5)));
        candidate.keep_if_best(folder, &row)
    }

    #[test]
    fn the_best_is_kept_and_all_are_in_the_table() {
        let (_root, folder) = run_folder();
        let metrics = "seconds,frames,updates\n0.5,100,0\n1.5,300,9\n2.5,500,25\n";
        fs::write(folder.metrics(), metrics).unwrap();
        assert_eq!(EvaluationRow::all(&folder).unwrap(), []);
        let keep = |updates, mean, episodes| keep(&folder, updates, mean, episodes).unwrap();
        assert!(keep(10, -1.0, 4));
        assert!(keep(20, 10.0 / 3.0, 4));
        assert!(keep(20, 10.0 / 3.0, 4), "it has one row");
        assert!(!keep(30, 10.0 / 3.0, 4), "the first of equals stays");
        assert!(!keep(40, 9.0, 1), "one episode is luck");
        let best = checkpoint::list(&folder.best()).unwrap();
        assert_eq!(best.len(), 1);
        assert_eq!(fs::read_to_string(best[0].1.join("weights")).unwrap(), "20");
        assert_eq!(fs::read_dir(folder.best()).unwrap().count(), 1);
        // The remains of a process that was killed do not count as a checkpoint.
        fs::create_dir(folder.best().join("checkpoint-50.tmp")).unwrap();
        let again = checkpoint::list(&folder.best()).unwrap();
        assert_eq!(again, best);
        let all = EvaluationRow::all(&folder).unwrap();
        let at = all.iter().map(|it| (it.frames, it.updates, it.mean_return));
        let (early, late) = (Some(300), Some(500));
        let first = [(early, 10, -1.0), (early, 20, 3.333333)];
        let others = [(late, 30, 3.333333), (late, 40, 9.0)];
        assert!(at.eq(first.into_iter().chain(others)), "{all:?}");
        fs::write(folder.evaluations(), "a,b\n1,2\n").unwrap();
        let said = EvaluationRow::all(&folder).unwrap_err().to_string();
        assert!(said.contains("is not a table of evaluations"), "{said}");
    }

    #[test]
    fn of_evaluations_at_once_the_best_is_kept() {
        let (_root, folder) = &run_folder();
        std::thread::scope(|scope| {
            for updates in 1..=8 {
                scope.spawn(move || keep(folder, updates, updates as f64, 4).unwrap());
            }
        });
        assert_eq!(EvaluationRow::best(folder).unwrap().unwrap().updates, 8);
        assert_eq!(fs::read_dir(folder.best()).unwrap().count(), 1);
        assert_eq!(EvaluationRow::all(folder).unwrap().len(), 8);
    }

    #[test]
    fn the_best_stays_until_another_has_its_place() {
        let (_root, folder) = run_folder();
        assert!(keep(&folder, 20, 3.0, 4).unwrap());
        let taken = folder.best().join("checkpoint-50.tmp");
        fs::write(&taken, "").unwrap();
        keep(&folder, 50, 9.0, 4).unwrap_err();
        fs::remove_file(taken).unwrap();
        assert_eq!(EvaluationRow::best(&folder).unwrap().unwrap().updates, 20);
        assert!(keep(&folder, 50, 9.0, 4).unwrap());
        assert_eq!(EvaluationRow::best(&folder).unwrap().unwrap().updates, 50);
    }

    #[test]
    fn a_checkpoint_from_before_the_first_row_has_that_row_s_frames_if_there_is_one() {
        let (_root, folder) = run_folder();
        let metrics = "seconds,frames,updates\n1.0,300,120\n2.0,500,240\n";
        fs::write(folder.metrics(), metrics).unwrap();
        let row = EvaluationRow::new(&folder, 100, 1, (2.0, None));
        assert_eq!((row.frames, row.seconds), (Some(300), Some(1.0)));

        fs::remove_file(folder.metrics()).unwrap();
        let row = EvaluationRow::new(&folder, 5, 1, (2.0, None));
        assert_eq!((row.frames, row.seconds), (None, None));
        row.append_to(&folder).unwrap();
        assert_eq!(EvaluationRow::all(&folder).unwrap(), [row]);
    }
}
