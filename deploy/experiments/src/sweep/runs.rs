//! The runs of a sweep on the disk: the folder of each, the call that made it and the output of its process.
//! This module starts no run.

use std::{
    collections::HashSet,
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail};
use driml_launch::{
    checkpoint_choice::read_config,
    run_folder::{Outcome, RunFolder, Summary, read_progress, write_atomically},
};
use driml_machine::error::usage;
use driml_settings::config::RunConfig;

use super::plan::{FinishedRun, PlannedRun, PointPlan, TrainCall};
use crate::{
    cache::RUNS,
    plot::{Settings, read_settings},
};

/// The number of bytes at the end of a failed run's output that are shown.
const LOG_TAIL_BYTES: usize = 1200;

pub(crate) struct Runs {
    root: PathBuf,
}

impl Runs {
    pub(crate) fn open(folder: &Path) -> anyhow::Result<Self> {
        let root = folder.join(RUNS);
        fs::create_dir_all(&root).with_context(|| format!("making {}", root.display()))?;
        Ok(Self { root })
    }

    /// Returns the plan's run if it exists, was made by this plan, and is complete and long enough.
    pub(crate) fn get_finished(&self, plan: &PlannedRun) -> Option<FinishedRun> {
        if !self.is_made_by(plan) {
            return None;
        }
        let folder = self.folder(plan);
        read_progress(&folder)?;
        let summary = Summary::read(&folder).ok()?;
        is_finished(&summary, plan.episodes).then_some(FinishedRun {
            folder,
            summary,
            commit: self.read_commit(plan),
        })
    }

    /// Returns the names of the finished runs in this folder that none of `plans` has, sorted.
    pub(super) fn finished_besides<P>(&self, plans: &[PointPlan<P>]) -> Vec<String> {
        let planned: HashSet<_> = plans.iter().map(|(_, plan)| plan.name.as_str()).collect();
        let enough = plans.iter().filter_map(|(_, plan)| plan.episodes).min();
        let is_other = |name: &str| {
            let folder = RunFolder::new(self.root.join(name));
            let is_done = |it: Summary| is_finished(&it, enough);
            !planned.contains(name) && Summary::read(&folder).is_ok_and(is_done)
        };
        let entries = fs::read_dir(&self.root).into_iter().flatten().flatten();
        let names = entries.filter_map(|entry| {
            let file = entry.file_name().into_string().ok()?;
            let name = file.strip_suffix(".call.json")?;
            is_other(name).then(|| name.to_owned())
        });
        let mut names: Vec<_> = names.collect();
        names.sort();
        names
    }

    /// Checks that the existing runs have the settings that the same calls mean now: presets may have changed since, and defaults depend on
    /// the machine.
    pub(super) fn check_settings<P>(&self, plans: &[PointPlan<P>]) -> anyhow::Result<()> {
        let mut known: Vec<(TrainCall, Settings)> = Vec::new();
        let settings = |config: RunConfig| {
            let found = read_settings(&config.to_toml(), &[]);
            found.expect("a run's settings have a table [run]").0
        };
        for (_, plan) in plans {
            let (folder, mut call) = (self.folder(plan), plan.call.clone());
            call.seed = 1;
            // The queue begins other runs again.
            let is_used = self.get_finished(plan).is_some() || folder.newest_checkpoint().is_some();
            if !self.is_made_by(plan) || !is_used {
                continue;
            }
            let next = "choose another --out, or remove that folder";
            let at = known.iter().position(|it| it.0 == call);
            let at = at.unwrap_or(known.len());
            if at == known.len() {
                let now = settings(call.config()?);
                known.push((call, now));
            }
            let now = &known[at].1;
            let made = read_config(&folder).map_err(|e| usage!("{e:#}; {next}"))?;
            let made = settings(made);
            let mut keys = made.keys().chain(now.keys());
            if let Some(key) = keys.find(|key| made.get(*key) != now.get(*key)) {
                let [made, now] = [&made, now].map(|it| it.get(key).map_or("unset", |it| it));
                bail!(usage!(
                    "{} was made with {key} = {made}, and this call has {now}: {next}",
                    folder.display()
                ));
            }
        }
        Ok(())
    }

    fn read_commit(&self, plan: &PlannedRun) -> String {
        let commit = fs::read_to_string(self.path_beside(plan, "commit")).unwrap_or_default();
        commit.trim().to_owned()
    }

    /// Whether the run in the plan's folder was started with exactly this plan's call.
    pub(super) fn is_made_by(&self, plan: &PlannedRun) -> bool {
        let call = fs::read_to_string(self.path_beside(plan, "call.json")).ok();
        let call = call.and_then(|text| serde_json::from_str::<Vec<String>>(&text).ok());
        call.is_some_and(|args| args == plan.call.args())
    }

    /// Records the call of the plan's run and the commit of the program. A resumed run keeps the earlier commits.
    pub(super) fn write_call(
        &self,
        plan: &PlannedRun,
        commit: &str,
        resumed: bool,
    ) -> anyhow::Result<()> {
        let earlier = match resumed {
            true => self.read_commit(plan),
            false => String::new(),
        };
        let mut commits: Vec<_> = earlier.split('+').filter(|it| !it.is_empty()).collect();
        if !commits.contains(&commit) {
            commits.push(commit);
        }
        let call = serde_json::to_vec(&plan.call.args()).context("encoding a call")?;
        write_atomically(&self.path_beside(plan, "call.json"), &call)?;
        let commits = commits.join("+");
        write_atomically(&self.path_beside(plan, "commit"), commits.as_bytes())
    }

    pub(super) fn log_tail(&self, plan: &PlannedRun) -> String {
        let text = fs::read(self.log_path(plan)).unwrap_or_default();
        let start = text.len().saturating_sub(LOG_TAIL_BYTES);
        String::from_utf8_lossy(&text[start..]).into_owned()
    }

    pub(super) fn folder(&self, plan: &PlannedRun) -> RunFolder {
        RunFolder::new(self.root.join(&plan.name))
    }

    pub(super) fn log_path(&self, plan: &PlannedRun) -> PathBuf {
        self.path_beside(plan, "log")
    }

    fn path_beside(&self, plan: &PlannedRun, what: &str) -> PathBuf {
        self.root.join(format!("{}.{what}", plan.name))
    }
}

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

/// Whether a run is complete, or was stopped with the `episodes` that are enough.
fn is_finished(summary: &Summary, episodes: Option<u64>) -> bool {
    match summary.outcome {
        Outcome::Finished => true,
        Outcome::Interrupted => episodes.is_some_and(|all| summary.episodes >= all),
        Outcome::Failed => false,
    }
}

#[cfg(test)]
pub(super) mod tests {
    use driml_launch::{
        run_folder::RunRecorder,
        run_view::{Plan, RunView},
    };

    use super::*;

    pub(in crate::sweep) fn write_finished_run(folder: &RunFolder) {
        let call = TrainCall {
            env: Some("chain".into()),
            ..TrainCall::default()
        };
        let config = call.config().unwrap();
        let mut view = RunView::new(Plan::new(&config));
        let mut recorder = RunRecorder::open(folder, &config, Vec::new(), None, false).unwrap();
        recorder.record(&mut view, &[]);
        let summary = recorder.summarise(Outcome::Finished, &mut view);
        summary.write(folder).unwrap();
    }

    #[test]
    fn a_run_counts_for_the_plan_that_made_it_alone() {
        let root = tempfile::tempdir().unwrap();
        let runs = Runs::open(root.path()).unwrap();
        let plan = |frames: u64| {
            let call = TrainCall {
                frames: Some(frames),
                ..TrainCall::default()
            };
            PlannedRun::new("run", call, frames)
        };
        let folder = runs.folder(&plan(10));
        write_finished_run(&folder);
        assert!(runs.get_finished(&plan(10)).is_none(), "it has no call");
        for (commit, resumed, expected) in [
            ("old", false, "old"),
            ("abc", false, "abc"),
            ("abc", true, "abc"),
            ("def", true, "abc+def"),
            ("abc", true, "abc+def"),
        ] {
            runs.write_call(&plan(10), commit, resumed).unwrap();
            assert_eq!(runs.get_finished(&plan(10)).unwrap().commit, expected);
        }
        assert!(runs.get_finished(&plan(20)).is_none());
        fs::remove_file(runs.path_beside(&plan(10), "commit")).unwrap();
        assert_eq!(runs.get_finished(&plan(10)).unwrap().commit, "");
        fs::write(folder.metrics(), "seconds,frames\n").unwrap();
        let found = runs.get_finished(&plan(10));
        assert!(found.is_none(), "its metrics are gone");
    }

    #[test]
    fn a_run_of_other_settings_is_not_mixed_in() {
        let root = tempfile::tempdir().unwrap();
        let runs = Runs::open(root.path()).unwrap();
        let call = TrainCall {
            env: Some("chain".into()),
            seed: 2,
            ..TrainCall::default()
        };
        let plans = [((), PlannedRun::new("run", call, 10))];
        let folder = runs.folder(&plans[0].1);
        write_finished_run(&folder);
        let check = || runs.check_settings(&plans).map_err(|e| e.to_string());
        let config = fs::read_to_string(folder.config()).unwrap();
        let other = config.replace("beta1 = 0.9", "beta1 = 0.8");
        assert_ne!(other, config);
        fs::write(folder.config(), &other).unwrap();
        assert_eq!(check(), Ok(()), "another call made it");
        runs.write_call(&plans[0].1, "abc", false).unwrap();
        let problem = check().unwrap_err();
        let expected = "beta1 = 0.8, and this call has 0.9";
        assert!(problem.contains(expected), "{problem}");
        fs::write(folder.config(), config).unwrap();
        assert_eq!(check(), Ok(()));
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
