//! What a run's checkpoints earned when they were played: `evaluations.csv`, and the best of them, kept in `best/`.
//! It plays nothing.

use std::{
    fs::{self, File},
    io::{ErrorKind, Write},
    path::{Path, PathBuf},
};

use anyhow::Context;
use csv::StringRecord;
use driml_machine::error::usage;
use serde::Deserialize;

use super::{
    folder::RunFolder,
    table::{Table, csv_row},
};
use crate::metrics::rounded;

const HEADER: &str = "seconds,frames,updates,episodes,evaluated_return,evaluated_return_sd";

/// What the name of a checkpoint that is held begins with; the number of the process follows.
const HELD: &str = ".playing-";

/// What a checkpoint earned over whole episodes.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct Evaluated {
    /// Seconds of the run at the checkpoint, by the metrics; none without them.
    pub seconds: Option<f64>,
    /// Frames of the run, likewise.
    pub frames: Option<u64>,
    /// Updates behind the weights.
    pub updates: u64,
    /// Whole episodes played.
    pub episodes: u32,
    /// Their mean undiscounted return.
    #[serde(rename = "evaluated_return")]
    pub mean_return: f64,
    /// Its standard deviation over episodes; 0 for one.
    #[serde(rename = "evaluated_return_sd")]
    pub deviation: f64,
}

impl Evaluated {
    /// All that were kept in a run's folder, in the order in which they were played; none of a folder that has none.
    ///
    /// # Errors
    /// A file that is not a table of evaluations, or that cannot be read.
    pub fn all(folder: &RunFolder) -> anyhow::Result<Vec<Self>> {
        let path = folder.evaluations();
        let table = Table::read(&path)?;
        let header = StringRecord::from(table.header);
        let rows = table.rows.iter();
        let rows = rows.map(|row| row.deserialize(Some(&header)).ok());
        rows.collect::<Option<_>>().with_context(|| {
            usage!(
                "{} is not a table of evaluations: move it away",
                path.display()
            )
        })
    }

    /// Updates behind the newest checkpoint that was played; 0 if none was.
    pub(crate) fn newest(folder: &RunFolder) -> anyhow::Result<u64> {
        let all = Self::all(folder)?;
        Ok(all.iter().map(|it| it.updates).max().unwrap_or(0))
    }

    /// The kept best checkpoint and what it earned when it was played for the most episodes; none of a folder that has none.
    pub(crate) fn best(folder: &RunFolder) -> anyhow::Result<Option<Self>> {
        let kept = driml_learner::checkpoint::list(&folder.best())?;
        let played = Self::all(folder)?.into_iter();
        let of_best = played.filter(|it| kept.last().is_some_and(|(best, _)| *best == it.updates));
        Ok(of_best.max_by_key(|it| it.episodes))
    }

    /// A checkpoint of so many updates, with the run's time and frames at it: those of the row of metrics at or before it, or of the
    /// first row, which is written within a second or so, where it was saved before that.
    pub(crate) fn at(
        folder: &RunFolder,
        updates: u64,
        episodes: u32,
        (mean_return, deviation): (f64, f64),
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
            mean_return,
            deviation,
        }
    }

    /// A line about it.
    pub fn describe(&self) -> String {
        format!(
            "evaluated after {} updates: mean return {:.3}, standard deviation {:.3} over {} episodes",
            self.updates, self.mean_return, self.deviation, self.episodes
        )
    }

    /// Adds it to the run's table, which is made where there is none.
    pub(crate) fn add(&self, folder: &RunFolder) -> anyhow::Result<()> {
        let path = folder.evaluations();
        let doing = || format!("writing {}", path.display());
        let file = File::options().create(true).append(true).open(&path);
        let mut file = file.with_context(doing)?;
        let is_new = file.metadata().with_context(doing)?.len() == 0;
        let row = csv_row([
            self.seconds.map_or(String::new(), |it| it.to_string()),
            self.frames.map_or(String::new(), |it| it.to_string()),
            self.updates.to_string(),
            self.episodes.to_string(),
            rounded(self.mean_return).to_string(),
            rounded(self.deviation).to_string(),
        ]);
        let head = is_new.then(|| csv_row(HEADER.split(',')));
        // A whole row at once: others may read meanwhile.
        let rows = [head.unwrap_or_default(), row].concat();
        file.write_all(&rows).with_context(doing)
    }
}

/// A checkpoint that is being played. Its files are held, so that it can be kept even if the learner clears it away meanwhile.
#[derive(Debug)]
pub(crate) struct Candidate {
    best: PathBuf,
    held: PathBuf,
    name: PathBuf,
}

impl Candidate {
    /// Holds the files of a checkpoint of the run.
    pub(crate) fn hold(folder: &RunFolder, checkpoint: &Path) -> anyhow::Result<Self> {
        sweep(folder);
        let best = folder.best();
        let name = PathBuf::from(checkpoint.file_name().unwrap_or_default());
        let held = best.join(format!("{HELD}{}-{}", std::process::id(), name.display()));
        let this = Self { best, held, name };
        let (from, to) = (checkpoint.display(), this.held.display());
        let doing = || format!("holding {from} in {to}");
        fs::create_dir_all(&this.held).with_context(doing)?;
        for entry in fs::read_dir(checkpoint).with_context(doing)? {
            let entry = entry.with_context(doing)?;
            let to = this.held.join(entry.file_name());
            // Files of a checkpoint never change; where there are no links, a copy does.
            if fs::hard_link(entry.path(), &to).is_err() {
                fs::copy(entry.path(), &to).with_context(doing)?;
            }
        }
        Ok(this)
    }

    /// Adds what it earned to the run's table, and keeps it if it earned more than the best before it, over at least as many episodes.
    /// Says whether it is the best.
    pub(crate) fn judge(
        self,
        folder: &RunFolder,
        earned: &Evaluated,
        best: Option<&Evaluated>,
    ) -> anyhow::Result<bool> {
        let is_best = best.is_none_or(|best| {
            best.updates == earned.updates
                || earned.episodes >= best.episodes && earned.mean_return > best.mean_return
        });
        if is_best {
            let path = self.best.join(&self.name);
            let doing = || format!("keeping {}", path.display());
            let older = driml_learner::checkpoint::list(&self.best)?;
            for (_, older) in older {
                fs::remove_dir_all(&older).with_context(doing)?;
            }
            fs::rename(&self.held, &path).with_context(doing)?;
        }
        earned.add(folder)?;
        Ok(is_best)
    }
}

impl Drop for Candidate {
    fn drop(&mut self) {
        remove(&self.held);
    }
}

/// Removes what this process, and processes that are gone, held while they played.
pub fn sweep(folder: &RunFolder) {
    let Ok(entries) = fs::read_dir(folder.best()) else {
        return;
    };
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let holder = name
            .strip_prefix(HELD)
            .and_then(|rest| rest.split('-').next()?.parse().ok());
        let is_left =
            |pid: u32| pid == std::process::id() || !Path::new(&format!("/proc/{pid}")).exists();
        if holder.is_some_and(is_left) {
            remove(&entry.path());
        }
    }
}

fn remove(held: &Path) {
    if let Err(e) = fs::remove_dir_all(held)
        && e.kind() != ErrorKind::NotFound
    {
        tracing::warn!("removing {}: {e}", held.display());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checkpoint(folder: &RunFolder, updates: u64) -> PathBuf {
        let path = folder.checkpoints().join(format!("checkpoint-{updates}"));
        fs::create_dir_all(&path).unwrap();
        fs::write(path.join("weights"), updates.to_string()).unwrap();
        path
    }

    #[test]
    fn the_best_is_kept_and_all_are_in_the_table() {
        let root = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(root.path());
        fs::write(
            folder.metrics(),
            "seconds,frames,updates\n0.5,100,0\n1.5,300,9\n2.5,500,25\n",
        )
        .unwrap();
        assert_eq!(Evaluated::all(&folder).unwrap(), []);
        let judge = |updates, mean, episodes| {
            let path = checkpoint(&folder, updates);
            let candidate = Candidate::hold(&folder, &path).unwrap();
            // The learner clears it away while it is played.
            fs::remove_dir_all(path).unwrap();
            let earned = Evaluated::at(&folder, updates, episodes, (mean, 0.5));
            let best = Evaluated::best(&folder).unwrap();
            candidate.judge(&folder, &earned, best.as_ref()).unwrap()
        };
        assert!(judge(10, -1.0, 4));
        assert!(judge(20, 3.0, 4));
        assert!(!judge(30, 3.0, 4), "the first of equals stays");
        assert!(!judge(40, 9.0, 1), "one episode is luck");
        let best = driml_learner::checkpoint::list(&folder.best()).unwrap();
        assert_eq!(best.len(), 1);
        assert_eq!(fs::read_to_string(best[0].1.join("weights")).unwrap(), "20");
        assert_eq!(fs::read_dir(folder.best()).unwrap().count(), 1);
        // What a process that was killed left.
        let left = |pid: u32| folder.best().join(format!("{HELD}{pid}-checkpoint-7"));
        let (left, other) = (left(u32::MAX), left(1));
        for folder in [&left, &other] {
            fs::create_dir(folder).unwrap();
        }
        sweep(&folder);
        assert!(!left.exists() && other.exists(), "process 1 lives");
        let all = Evaluated::all(&folder).unwrap();
        let at = all.iter().map(|it| (it.frames, it.updates, it.mean_return));
        let (early, late) = (Some(300), Some(500));
        let first = [(early, 10, -1.0), (early, 20, 3.0)];
        let others = [(late, 30, 3.0), (late, 40, 9.0)];
        assert!(at.eq(first.into_iter().chain(others)), "{all:?}");
        fs::write(folder.evaluations(), "a,b\n1,2\n").unwrap();
        let said = Evaluated::all(&folder).unwrap_err().to_string();
        assert!(said.contains("is not a table of evaluations"), "{said}");
    }

    #[test]
    fn a_checkpoint_from_before_the_first_row_has_that_row_s_frames_if_there_is_one() {
        let root = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(root.path());
        let metrics = "seconds,frames,updates\n1.0,300,120\n2.0,500,240\n";
        fs::write(folder.metrics(), metrics).unwrap();
        let earned = Evaluated::at(&folder, 100, 1, (2.0, 0.0));
        assert_eq!((earned.frames, earned.seconds), (Some(300), Some(1.0)));

        fs::remove_file(folder.metrics()).unwrap();
        let earned = Evaluated::at(&folder, 5, 1, (2.0, 0.0));
        assert_eq!((earned.frames, earned.seconds), (None, None));
        earned.add(&folder).unwrap();
        assert_eq!(Evaluated::all(&folder).unwrap(), [earned]);
    }
}
