//! Makes the runs of a sweep: `driml train` as child processes, a few at once, each with a separate folder.
//! A finished run is not repeated. An unfinished run is resumed; if that is impossible, its folder is moved aside and the run starts
//! again. This module knows nothing about experiments.

use std::{
    collections::VecDeque,
    fs::File,
    process::{Command, ExitStatus, Stdio},
    time::Duration,
};

use anyhow::Context;
use driml_launch::{
    managed_process::{ManagedProcess, exit_with_parent_flags, stop_processes},
    resume::{self, Resumption},
    run_folder::{Progress as RunProgress, read_progress},
};
use driml_machine::{
    error::{EXIT_USAGE, usage},
    process_env,
    resources::{MEMORY_SHARE_ENV, Machine},
};
use driml_protocol::lock_file;
use driml_settings::flags::Flags;

use super::{
    plan::{PlannedRun, PointPlan, PointRun},
    runs::{Runs, move_aside},
};
use crate::{cache::Session, progress::Progress};

/// How often a run is tried in one call. On a machine that is busy with other work, a run may lose contact with its processes.
const TRIES_MAX: u32 = 2;
const POLL: Duration = Duration::from_millis(250);
/// How long children may take to save after they were asked to stop. Then they are killed.
const DRAIN_MAX: Duration = Duration::from_secs(240);

/// Makes all runs, `jobs` at once, in the order of `plans`, and adds their work to the progress. For a report it makes none. Returns the
/// finished runs in the same order, and names on the screen those in the folder that no plan has.
pub(crate) fn run_all<P>(
    session: &mut Session,
    plans: Vec<PointPlan<P>>,
    jobs: u32,
) -> anyhow::Result<Vec<PointRun<P>>> {
    let (runs, report_only) = (Runs::open(&session.folder)?, session.report_only);
    let progress = &mut session.progress;
    progress.add_work(plans.iter().map(|(_, plan)| plan.units).sum());
    let mut queue = Queue {
        runs,
        jobs,
        memory_share: Machine::detect().memory_bytes
            / u64::from(jobs).min(plans.len() as u64).max(1),
        waiting: VecDeque::new(),
        running: Vec::new(),
    };
    if !report_only {
        queue.runs.check_settings(&plans)?;
    }
    for (_, plan) in &plans {
        if queue.runs.get_finished(plan).is_some() {
            progress.count_earlier(plan.units);
        } else if !report_only {
            queue.waiting.push_back(Job::new(plan.clone()));
        }
    }
    if let Err(e) = queue.run_jobs(progress) {
        queue.stop_all(progress);
        return Err(e);
    }
    let others = queue.runs.finished_besides(&plans).join(", ");
    if !others.is_empty() {
        progress.line(&format!(
            "left out, as the flags do not ask for these finished runs: {others}"
        ));
    }
    let (mut finished, mut missing) = (Vec::new(), Vec::new());
    for (point, plan) in plans {
        match queue.runs.get_finished(&plan) {
            Some(run) => finished.push(PointRun { point, plan, run }),
            None => missing.push(plan.name),
        }
    }
    let seconds = finished.iter().map(|it| it.run.summary.wall_seconds);
    session.count_runs(seconds.sum(), jobs, missing);
    Ok(finished)
}

/// Returns the commit of this program's file, which `--version` prints in brackets. Another build may have replaced the file.
fn program_commit() -> anyhow::Result<String> {
    let mut command = Command::new(process_env::program_path());
    let output = command.arg("--version").output();
    let output = output.context("asking this program for its version")?;
    let text = String::from_utf8_lossy(&output.stdout);
    let text = text.trim().strip_suffix(')');
    let commit = text.and_then(|it| it.rsplit_once('('));
    Ok(commit.map_or_else(String::new, |it| it.1.to_owned()))
}

struct Queue {
    runs: Runs,
    jobs: u32,
    memory_share: u64,
    waiting: VecDeque<Job>,
    running: Vec<RunningJob>,
}

/// A run to be made, with the history of its tries in this call.
struct Job {
    plan: PlannedRun,
    tries: u32,
    /// The updates of the checkpoint that the last try resumed from. That checkpoint may cause the failure, so it is not used again.
    resumed_at: Option<u64>,
}

impl Job {
    const fn new(plan: PlannedRun) -> Self {
        Self {
            plan,
            tries: 0,
            resumed_at: None,
        }
    }
}

struct RunningJob {
    job: Job,
    process: ManagedProcess,
    done: u64,
    /// Whether the run is long enough and was asked to stop.
    has_enough: bool,
}

impl Queue {
    fn run_jobs(&mut self, progress: &mut Progress) -> anyhow::Result<()> {
        loop {
            while self.running.len() < self.jobs as usize
                && let Some(next) = self.waiting.pop_front()
            {
                self.running.extend(self.start(next, progress)?);
            }
            if self.running.is_empty() {
                return Ok(());
            }
            let names = self.running.iter().map(|it| it.job.plan.name.as_str());
            let waiting = self.waiting.len();
            let names = names.collect::<Vec<_>>().join(", ");
            progress.set_task(&format!("{names}; {waiting} waiting"));
            std::thread::sleep(POLL);
            self.poll_children(progress)?;
            progress.advance(0)?;
        }
    }

    fn poll_children(&mut self, progress: &mut Progress) -> anyhow::Result<()> {
        let mut at = 0;
        while at < self.running.len() {
            let (done, has_enough) = self.work_done(&self.running[at].job.plan);
            let running = &mut self.running[at];
            let new_units = done.saturating_sub(running.done);
            running.done += new_units;
            progress.advance(new_units)?;
            if has_enough && !running.has_enough {
                running.has_enough = true;
                running.process.ask_to_stop();
            }
            match running.process.exit_status() {
                None => at += 1,
                Some(status) => {
                    let ended = self.running.remove(at);
                    self.handle_exit(ended, status, progress)?;
                }
            }
        }
        Ok(())
    }

    /// Returns the units that the plan's run has done, and whether the run has all its episodes.
    fn work_done(&self, plan: &PlannedRun) -> (u64, bool) {
        let folder = self.runs.folder(plan);
        let RunProgress { frames, episodes } = read_progress(&folder).unwrap_or_default();
        let share = |part: u64, all: u64| part as f64 / all.max(1) as f64;
        let of_episodes = plan.episodes.map_or(0.0, |all| share(episodes, all));
        let share = of_episodes.max(share(frames, plan.frames)).min(1.0);
        let has_enough = plan.episodes.is_some_and(|all| episodes >= all);
        ((share * plan.units as f64) as u64, has_enough)
    }

    /// Counts and returns the units that a resumed run did in an earlier start. They do not count for the speed.
    fn count_earlier_work(&self, plan: &PlannedRun, progress: &mut Progress) -> u64 {
        let (done, _) = self.work_done(plan);
        progress.count_earlier(done);
        done
    }

    /// Handles a run whose process exited: counts a finished run; retries a failed run once, then leaves it out.
    fn handle_exit(
        &mut self,
        ended: RunningJob,
        status: ExitStatus,
        progress: &mut Progress,
    ) -> anyhow::Result<()> {
        let Job { plan, tries, .. } = &ended.job;
        if self.runs.get_finished(plan).is_some() {
            return Ok(progress.advance(plan.units - ended.done)?);
        }
        let (name, log_tail) = (&plan.name, self.runs.log_tail(plan));
        // Settings that are wrong here are wrong for the other runs too.
        if status.code() == Some(EXIT_USAGE.into()) && ended.job.resumed_at.is_none() {
            return Err(usage!("the run {name} cannot start:\n{log_tail}").into());
        }
        let (failed, next_step) = match *tries < TRIES_MAX {
            true => ("failed", "is retried once"),
            false => ("failed again", "is left out"),
        };
        progress.line(&format!(
            "the run {name} {failed} ({status}) and {next_step}. The end of its log:\n{log_tail}"
        ));
        if *tries < TRIES_MAX {
            progress.add_work(ended.done);
            self.waiting.push_back(ended.job);
            return Ok(());
        }
        Ok(progress.advance(plan.units - ended.done)?)
    }

    /// Starts a run in a separate process group, so that only this process passes Ctrl-C to it. `None` if the run is finished or left out.
    fn start(&self, mut job: Job, progress: &mut Progress) -> anyhow::Result<Option<RunningJob>> {
        let plan = &job.plan;
        let path = self.runs.log_path(plan);
        let doing = || format!("making {}", path.display());
        let log = File::options().create(true).append(true).open(&path);
        let log = log.with_context(doing)?;
        wait_for_log_lock(&log, plan, progress)?;
        if self.runs.get_finished(plan).is_some() {
            progress.count_earlier(plan.units);
            return Ok(None);
        }
        log.set_len(0).with_context(doing)?;
        let resumed_at = match self.resume_point(&job, progress) {
            Ok(updates) => updates,
            Err(e) => {
                progress.line(&format!("the run {} is left out: {e:#}", plan.name));
                progress.count_earlier(plan.units);
                return Ok(None);
            }
        };
        let folder = self.runs.folder(plan).path().to_owned();
        let resumed = resumed_at.is_some();
        if !resumed && let Some(aside) = move_aside(&folder)? {
            progress.line(&format!(
                "{} was not finished, or comes from another call: moved it to {}; the run starts from the beginning",
                folder.display(),
                aside.display()
            ));
        }
        self.runs.write_call(plan, &program_commit()?, resumed)?;
        let mut command = self.train_command(plan, resumed);
        command
            .stdin(Stdio::null())
            .stdout(log.try_clone().with_context(doing)?)
            .stderr(log);
        let process = ManagedProcess::spawn(&format!("the run {}", plan.name), command)?;
        let found = resumed.then(|| self.count_earlier_work(plan, progress));
        let done = found.unwrap_or(0);
        job.tries += 1;
        job.resumed_at = resumed_at;
        Ok(Some(RunningJob {
            job,
            process,
            done,
            has_enough: false,
        }))
    }

    /// Builds the command that starts a run, or resumes it. A resumed run keeps its replay size and its number of threads. Runs at once
    /// divide the cores among them, so that their learners do not compete.
    fn train_command(&self, plan: &PlannedRun, resumed: bool) -> Command {
        let folder = self.runs.folder(plan);
        let mut command = Command::new(process_env::program_path());
        command.args(["train", "--no-play"]);
        command.args(exit_with_parent_flags());
        if resumed {
            command.arg("--resume").arg(folder.path());
        } else {
            command.arg("--run-dir").arg(folder.path());
            if self.jobs > 1 {
                let threads = (Machine::detect().cores / self.jobs).max(1);
                command.args(["--set", &format!("local.learner_threads={threads}")]);
            }
            command.args(plan.call.args());
            command.env(MEMORY_SHARE_ENV, self.memory_share.to_string());
        }
        command
    }

    /// Returns the updates of the checkpoint from which the run resumes; `None` if the run starts from the beginning.
    fn resume_point(&self, job: &Job, progress: &mut Progress) -> anyhow::Result<Option<u64>> {
        let (plan, folder) = (&job.plan, self.runs.folder(&job.plan));
        if !folder.path().exists() {
            return Ok(None);
        }
        resume::wait_until_free(&folder)?;
        let newest = folder.newest_checkpoint().map(|(updates, _)| updates);
        let is_resumable = newest > job.resumed_at
            && self.runs.is_made_by(plan)
            && resume::is_resumable(&plan.call.config()?.world, &folder);
        if !is_resumable {
            return Ok(None);
        }
        match resume::prepare(&folder, &Flags::default())? {
            Resumption::Done(sentence) => {
                progress.line(&sentence);
                Ok(None)
            }
            Resumption::Resumed(_) => {
                let run = folder.display();
                progress.line(&format!("{run} resumes from its checkpoint"));
                Ok(newest)
            }
        }
    }

    /// Asks all children to stop and waits until they have saved. A second interrupt, or `DRAIN_MAX`, kills them.
    fn stop_all(&mut self, progress: &Progress) {
        if self.running.is_empty() {
            return;
        }
        progress.line("stopping the runs; the same command resumes those that are not finished");
        let processes = self.running.iter_mut().map(|it| &mut it.process);
        stop_processes(processes, true, DRAIN_MAX, &progress.shutdown.immediate);
    }
}

/// Waits until no process of an earlier call writes to the run: a run whose parent was killed still saves. A child inherits our open
/// log file and with it the lock, so that two processes never write to one folder.
fn wait_for_log_lock(log: &File, plan: &PlannedRun, progress: &mut Progress) -> anyhow::Result<()> {
    let mut has_told = false;
    while !lock_file::try_lock(log).context("locking a run's log")? {
        if !std::mem::replace(&mut has_told, true) {
            let name = &plan.name;
            progress.line(&format!(
                "an earlier process of {name} still runs: waiting for it"
            ));
        }
        std::thread::sleep(POLL);
        progress.advance(0)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use driml_protocol::GracefulShutdown;

    use super::*;
    use crate::sweep::{plan::TrainCall, runs::tests::write_finished_run};

    /// Creates a queue in a folder with a single plan, whose run is finished.
    fn queue() -> (tempfile::TempDir, Queue, PlannedRun) {
        let root = tempfile::tempdir().unwrap();
        let runs = Runs::open(root.path()).unwrap();
        let plan = PlannedRun::new("run", TrainCall::default(), 10);
        write_finished_run(&runs.folder(&plan));
        runs.write_call(&plan, "abc", false).unwrap();
        let queue = Queue {
            runs,
            jobs: 1,
            memory_share: 7,
            waiting: [Job::new(plan.clone())].into(),
            running: Vec::new(),
        };
        (root, queue, plan)
    }

    #[test]
    fn what_a_resumed_run_did_before_is_no_measure_of_speed() {
        let (_root, queue, plan) = queue();
        let metrics = queue.runs.folder(&plan).metrics();
        std::fs::write(metrics, "seconds,frames,episodes\n60,9,0\n").unwrap();
        let mut progress = Progress::new(10, GracefulShutdown::default());
        assert_eq!(queue.count_earlier_work(&plan, &mut progress), 9);
        assert_eq!(progress.seconds_left(1.0), None);
    }

    #[test]
    fn a_run_is_told_its_part_of_the_memory_once() {
        let (_root, queue, plan) = queue();
        let share = |resumed| {
            let command = queue.train_command(&plan, resumed);
            let mut shares = command.get_envs().filter(|it| it.0 == MEMORY_SHARE_ENV);
            shares.next().map(|(_, value)| value == Some("7".as_ref()))
        };
        assert_eq!([share(false), share(true)], [Some(true), None]);
    }

    #[test]
    fn a_checkpoint_is_resumed_from_once_and_kept_while_it_cannot_be() {
        let (_root, queue, plan) = queue();
        let folder = queue.runs.folder(&plan);
        std::fs::write(folder.config(), "").unwrap();
        let checkpoint = folder.checkpoints().join("checkpoint-000000000005");
        std::fs::create_dir_all(checkpoint).unwrap();
        let mut progress = Progress::new(10, GracefulShutdown::default());
        let mut job = Job::new(plan);
        for (resumed_at, is_tried) in [(None, true), (Some(4), true), (Some(5), false)] {
            job.resumed_at = resumed_at;
            let found = queue.resume_point(&job, &mut progress);
            assert_eq!(found.is_err(), is_tried, "{found:?}");
        }
    }

    /// This happens when a run saves while this call waits for the lock of its log.
    #[test]
    fn a_run_that_finished_meanwhile_is_not_made_again() {
        let (_root, mut queue, plan) = queue();
        let mut progress = Progress::new(10, GracefulShutdown::default());
        queue.run_jobs(&mut progress).unwrap();
        assert_eq!(queue.runs.get_finished(&plan).unwrap().commit, "abc");
    }
}
