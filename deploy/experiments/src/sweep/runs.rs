//! The runs of an experiment as they lie on the disk: each with the call that made it and what its process said.
//! It starts none.

use std::{
    fs::{self, File},
    io::{Read, Seek, SeekFrom},
    path::{Path, PathBuf},
};

use anyhow::Context;
use driml_launch::run_folder::{Outcome, RunFolder, Summary, progress as how_far, write_whole};

/// Where the runs lie in an experiment's folder. Git does not keep them.
const RUNS: &str = "runs";
/// Bytes at the end of a run's output that are shown if it fails.
const LAST_WORDS_BYTES: u64 = 1200;

/// A run to be made.
#[derive(Clone, Debug)]
pub(super) struct PlannedRun {
    /// Its folder's name.
    pub(super) name: String,
    /// What follows `driml local`.
    pub(super) args: Vec<String>,
    /// Its length in frames.
    pub(super) frames: u64,
    /// Episodes after which it is long enough, if that comes first.
    pub(super) episodes: Option<u64>,
    /// Its share of the experiment's work.
    pub(super) units: u64,
}

/// A finished run.
#[derive(Clone, Debug)]
pub(super) struct FinishedRun {
    pub(super) folder: RunFolder,
    pub(super) summary: Summary,
}

/// The folder of an experiment's runs.
pub(super) struct Runs {
    root: PathBuf,
}

impl Runs {
    /// Opens the folder in the experiment's `folder`, or makes it.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(super) fn open(folder: &Path) -> anyhow::Result<Self> {
        let root = folder.join(RUNS);
        fs::create_dir_all(&root).with_context(|| format!("making {}", root.display()))?;
        Ok(Self { root })
    }

    /// The plan's run, if it is there, was made by this plan, and is whole and long enough.
    pub(super) fn finished(&self, plan: &PlannedRun) -> Option<FinishedRun> {
        if !self.is_made_by(plan) {
            return None;
        }
        let folder = self.folder(plan);
        how_far(&folder)?;
        let summary = Summary::read(&folder).ok()?;
        let enough = plan.episodes.is_some_and(|all| summary.episodes >= all);
        let good = match summary.outcome {
            Outcome::Finished => true,
            Outcome::Interrupted => enough,
            Outcome::Failed => false,
        };
        good.then_some(FinishedRun { folder, summary })
    }

    /// Whether what lies in the plan's folder was begun by this very plan.
    pub(super) fn is_made_by(&self, plan: &PlannedRun) -> bool {
        let call = fs::read_to_string(self.call(plan)).ok();
        let call = call.and_then(|text| serde_json::from_str::<Vec<String>>(&text).ok());
        call.is_some_and(|args| args == plan.args)
    }

    /// Notes that the plan's run is made by this plan.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(super) fn write_call(&self, plan: &PlannedRun) -> anyhow::Result<()> {
        let call = serde_json::to_vec(&plan.args).context("writing down a call")?;
        write_whole(&self.call(plan), &call)
    }

    /// The end of what the run's process said.
    pub(super) fn last_words(&self, plan: &PlannedRun) -> String {
        tail(&self.log(plan), LAST_WORDS_BYTES).unwrap_or_default()
    }

    /// The folder of the plan's run.
    pub(super) fn folder(&self, plan: &PlannedRun) -> RunFolder {
        RunFolder::new(self.root.join(&plan.name))
    }

    /// Where the arguments are that a run was made with.
    fn call(&self, plan: &PlannedRun) -> PathBuf {
        self.root.join(format!("{}.call.json", plan.name))
    }

    /// What the run's process said.
    pub(super) fn log(&self, plan: &PlannedRun) -> PathBuf {
        self.root.join(format!("{}.log", plan.name))
    }
}

/// Renames what lies at `folder`, if anything does; says where it is now.
pub(super) fn move_aside(folder: &Path) -> anyhow::Result<Option<PathBuf>> {
    if !folder.exists() {
        return Ok(None);
    }
    let name = |number: u32| {
        let mut name = folder.as_os_str().to_owned();
        name.push(format!(".unfinished-{number}"));
        PathBuf::from(name)
    };
    let free = (1..).map(name).find(|path| !path.exists());
    let aside = free.expect("there are more numbers than folders");
    fs::rename(folder, &aside).with_context(|| format!("moving {} aside", folder.display()))?;
    Ok(Some(aside))
}

/// The end of a file.
fn tail(path: &Path, bytes: u64) -> Option<String> {
    let mut file = File::open(path).ok()?;
    let length = file.metadata().ok()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(bytes)))
        .ok()?;
    let mut end = Vec::new();
    file.read_to_end(&mut end).ok()?;
    Some(String::from_utf8_lossy(&end).into_owned())
}

#[cfg(test)]
mod tests {
    use driml_protocol::{LearnerStatus, ReplayStatus};

    use super::*;
    use crate::made_up;
    use driml_launch::run_folder::{Recorded, RunRecorder};

    #[test]
    fn a_run_counts_for_the_plan_that_made_it_alone() {
        let root = tempfile::tempdir().unwrap();
        let runs = Runs {
            root: root.path().to_owned(),
        };
        let plan = |frames: u64| PlannedRun {
            name: "run".into(),
            args: vec!["--frames".into(), frames.to_string()],
            frames,
            episodes: None,
            units: frames,
        };
        let (replay, learner) = (ReplayStatus::default(), LearnerStatus::default());
        let folder = RunFolder::new(runs.root.join("run"));
        let mut recorder = RunRecorder::create(&folder, Recorded::default()).unwrap();
        recorder.record(std::slice::from_ref(&replay), &learner, &[]);
        let summary = recorder.summarise(Outcome::Finished, &made_up::spec(), &replay, &learner);
        summary.write(&folder).unwrap();
        assert!(runs.finished(&plan(10)).is_none(), "nobody knows its call");
        runs.write_call(&plan(10)).unwrap();
        assert!(runs.finished(&plan(10)).is_some());
        assert!(runs.finished(&plan(20)).is_none());
        fs::write(folder.metrics(), "seconds,frames\n").unwrap();
        assert!(runs.finished(&plan(10)).is_none(), "its metrics are gone");
    }

    #[test]
    fn what_is_in_the_way_is_moved_and_kept() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("run");
        assert_eq!(move_aside(&folder).unwrap(), None);
        for number in 1..3 {
            fs::create_dir(&folder).unwrap();
            let aside = move_aside(&folder).unwrap().unwrap();
            assert!(aside.ends_with(format!("run.unfinished-{number}")) && aside.exists());
        }
    }
}
