//! The files that a run leaves behind: summary, metrics, checkpoints, logs.
//! This module reads the files and checks what holds for every run. Each test checks the results of the run that it started.

use std::{
    fs,
    path::{Path, PathBuf},
    str::FromStr,
};

pub use driml_launch::run_folder::{Outcome, Summary, Table};
use driml_learner::checkpoint;
use safetensors::SafeTensors;
use sha2::{Digest, Sha256};

use crate::{client::check_nothing_lost, waiting::wait_until};

/// A run's folder.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    pub(crate) const fn new(path: PathBuf) -> Self {
        Self { path }
    }

    /// Returns the folder's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn text(&self, name: &str) -> String {
        let path = self.path.join(name);
        fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
    }

    /// The resolved settings.
    pub fn config(&self) -> toml::Table {
        self.text("config.toml").parse().unwrap()
    }

    /// Returns a numeric setting by its dotted path.
    pub fn setting(&self, path: &str) -> f64 {
        let config = toml::Value::Table(self.config());
        let value = path.split('.').fold(&config, |table, key| &table[key]);
        value
            .as_float()
            .unwrap_or_else(|| value.as_integer().unwrap() as f64)
    }

    /// Reads `summary.json`.
    pub fn summary(&self) -> Summary {
        serde_json::from_str(&self.text("summary.json")).unwrap()
    }

    /// Reads the complete rows of a table so far; none if the file does not exist yet.
    pub fn table(&self, name: &str) -> Table {
        Table::read(&self.path.join(name)).unwrap()
    }

    /// Waits until `metrics.csv` has a row with more than `updates` updates.
    pub fn wait_for_updates(&self, updates: u64) {
        wait_until(&format!("a row with more than {updates} updates"), || {
            self.table("metrics.csv").last::<u64>("updates") > Some(updates)
        });
    }

    /// The cells of one column of a table.
    #[track_caller]
    fn cells(&self, table: &str, name: &str) -> Vec<String> {
        let table = self.table(table);
        let at = table.column_index(name);
        let at = at.unwrap_or_else(|| panic!("{name} is not in {:?}", table.header));
        table.rows.iter().map(|row| row[at].to_owned()).collect()
    }

    /// The cells of one column of `metrics.csv`.
    #[track_caller]
    pub fn column(&self, name: &str) -> Vec<String> {
        self.cells("metrics.csv", name)
    }

    /// Returns one column of `metrics.csv` as numbers; no cell may be empty.
    #[track_caller]
    pub fn numeric_column(&self, name: &str) -> Vec<f64> {
        let cells = self.column(name);
        cells.iter().map(|it| it.parse().unwrap()).collect()
    }

    /// Returns one column of `episodes.csv` so far, nothing before its header is written; `None` where a cell is empty.
    #[track_caller]
    pub fn episode_column<T: FromStr>(&self, name: &str) -> Vec<Option<T>> {
        if self.table("episodes.csv").header.is_empty() {
            return Vec::new();
        }
        let parse = |cell: &String| {
            let value = cell.parse();
            value.unwrap_or_else(|_| panic!("{name} = {cell:?}"))
        };
        let cells = self.cells("episodes.csv", name).into_iter();
        let values = cells.map(|cell| (!cell.is_empty()).then(|| parse(&cell)));
        values.collect()
    }

    /// Checks that every episode has a row, and that the mean return is of the last 100 episodes, or of all if there were fewer.
    #[track_caller]
    fn check_episodes(&self, summary: &Summary) {
        let [frames, numbers] = ["frames", "episode"].map(|name| self.episode_column::<u64>(name));
        let is_sorted = frames.is_sorted() && numbers.is_sorted_by(|a, b| a < b);
        let is_past = frames.iter().all(|it| it.unwrap() <= summary.frames);
        assert!(is_sorted && is_past, "{frames:?} {numbers:?}");
        assert_eq!(summary.mean_return_of, summary.episodes.min(100));
        let returns = self.episode_column("return");
        let newest = &returns[returns.len() - summary.mean_return_of as usize..];
        let sum: f64 = newest.iter().flatten().sum();
        let mean = (!newest.is_empty()).then(|| sum / newest.len() as f64);
        assert_eq!(mean.is_some(), summary.mean_return.is_some());
        let off = mean.unwrap_or_default() - summary.mean_return.unwrap_or_default();
        assert!(off.abs() < 1e-9, "{mean:?} {:?}", summary.mean_return);
        let last = numbers.last().map_or(0, |number| number.unwrap());
        assert_eq!(last, summary.episodes, "episodes have their numbers");
        let rows = numbers.len() as u64;
        assert_eq!(rows, summary.episodes, "each has a row");
    }

    /// Returns the log of a process.
    pub fn log(&self, process: &str) -> String {
        self.text(&format!("logs/{process}.log"))
    }

    /// The complete checkpoints, oldest first, as (updates, path); none if the folder does not exist.
    pub fn checkpoints(&self) -> Vec<(u64, PathBuf)> {
        checkpoint::list(&self.path.join("checkpoints")).unwrap()
    }

    fn newest(&self) -> (u64, PathBuf) {
        self.checkpoints().pop().expect("there is a checkpoint")
    }

    /// The newest checkpoint.
    pub fn newest_checkpoint(&self) -> PathBuf {
        self.newest().1
    }

    /// Returns the number of updates in the newest checkpoint.
    pub fn saved_updates(&self) -> u64 {
        self.newest().0
    }

    /// Returns the SHA-256 of the newest checkpoint's weights as actors receive them: only torso and head, as a safetensors file.
    ///
    /// Uses only the tensors in the file and the safetensors library, no code under test.
    pub fn checkpoint_sha256(&self) -> String {
        let bytes = fs::read(self.newest_checkpoint().join("online.safetensors")).unwrap();
        let tensors = SafeTensors::deserialize(&bytes).unwrap();
        let published = tensors.iter().filter(|(name, _)| !name.starts_with("dim."));
        let file = safetensors::serialize(published, None).unwrap();
        format!("{:x}", Sha256::digest(file))
    }

    /// Checks what holds for every run that shut down in order, and returns its summary.
    #[track_caller]
    pub fn check(&self, outcome: Outcome) -> Summary {
        let summary = self.summary();
        let (replay, details) = (&summary.replay, format!("{summary:#?}"));
        assert_eq!(summary.outcome, outcome, "{details}");
        check_nothing_lost(replay);
        assert_eq!(replay.messages_refused, 0, "{details}");
        assert_eq!(summary.frames, replay.transitions_inserted, "{details}");
        // A replay that was kept on disk has counted k over the whole run.
        let is_kept = self.path.join("replay").is_dir();
        let before = u64::from(!is_kept) * summary.resumed_after_updates;
        let rows_before = before * self.setting("learner.batch_size") as u64;
        let known = rows_before + replay.k_histogram.iter().sum::<u64>();
        let served = replay.rows_sampled + replay.rows_unlearned;
        // A killed server has lost its counts of k since its last snapshot.
        let restarted = summary.resumed_after_updates > 0 || summary.replay_servers_restarted > 0;
        let may_lack = is_kept && restarted;
        assert!(known == served || may_lack && known < served, "{details}");
        let is_timed = summary.wall_seconds > 0.0 && summary.frames_per_second > 0.0;
        assert!(is_timed, "{details}");

        self.check_episodes(&summary);
        for name in ["metrics.csv", "episodes.csv"] {
            assert!(self.text(name).ends_with('\n'), "{name} has whole rows");
        }
        for (column, count) in [("frames", summary.frames), ("updates", summary.updates)] {
            let last = self.column(column).pop().expect("there is a row");
            assert_eq!(last, count.to_string(), "{column}");
        }

        // The newest checkpoint holds the final weights.
        assert_eq!(self.checkpoint_sha256(), summary.weights_sha256);
        let kept = self.checkpoints().len();
        let allowed = 1..=self.setting("learner.checkpoints_kept") as usize;
        assert!(allowed.contains(&kept), "{kept} checkpoints");
        let mut entries = fs::read_dir(self.path.join("checkpoints")).unwrap();
        let unfinished = entries.find(|it| it.as_ref().unwrap().path().extension().is_some());
        assert!(unfinished.is_none(), "{unfinished:?}");
        summary
    }

    /// Checks, in addition to [`Self::check`], what holds for a run that finished.
    #[track_caller]
    pub fn check_finished(&self) -> Summary {
        let summary = self.check(Outcome::Finished);
        let details = format!("{summary:#?}");
        let [rows, warmup, planned, period] = [
            "learner.batch_size",
            "replay.warmup_transitions",
            "replay.transitions_max",
            "learner.publish_period_updates",
        ]
        .map(|name| self.setting(name) as u64);
        assert!(summary.frames >= planned, "{details}");
        let learned = summary.updates * rows;
        assert_eq!(summary.replay.rows_sampled, learned, "{details}");
        let ratio = self.setting("replay.replay_ratio");
        let allowed = ratio * (summary.frames - warmup) as f64 / rows as f64;
        assert_eq!(summary.updates, allowed as u64, "{details}");
        // One version is published before the first update, and one for updates after the last full period. A resumed run skips the
        // versions that may have been published since its checkpoint.
        let publications = summary.updates / period;
        let most = match summary.resumed_after_updates {
            0 => publications + 2,
            _ => u64::MAX,
        };
        let allowed = publications + 1..=most;
        assert!(allowed.contains(&summary.weights_version), "{details}");
        summary
    }
}
