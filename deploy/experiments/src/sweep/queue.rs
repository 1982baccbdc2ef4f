//! Makes the runs of a sweep: `driml train` as child processes, a few at once, each with a separate folder.
//! A finished run is not repeated. An unfinished run is resumed; if that is impossible, its folder is moved aside and the run starts
//! again. This module knows nothing about experiments.

use std::{
    collections::VecDeque,
    fs::File,
    os::unix::process::CommandExt,
    process::{Child, Command, ExitStatus, Stdio},
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_launch::{
    managed_process::{ask_to_stop, exit_with_parent_flags},
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
    plan::{Made, Planned, PlannedRun},
    runs::{Runs, move_aside},
};
use crate::{cache::Session, progress::Progress};

/// How often a run is tried in one call. On a machine that is busy with other work, a run may lose contact with its processes.
const TRIES: u32 = 2;
/// The interval between two checks of the running children.
const POLL: Duration = Duration::from_millis(250);
/// How long children may take to save after they were asked to stop. Then they are killed.
const DRAIN_MAX: Duration = Duration::from_secs(240);

/// Makes all runs, `jobs` at once, in the order of `plans`, and adds their work to the progress. For a report it makes none. Returns the
/// finished runs in the same order.
pub(crate) fn make<P>(
    session: &mut Session,
    plans: Vec<Planned<P>>,
    jobs: u32,
) -> anyhow::Result<Vec<Made<P>>> {
    let (runs, report_only) = (Runs::open(session.folder())?, session.report_only());
    let progress = session.progress();
    progress.again(plans.iter().map(|(_, plan)| plan.units).sum());
    let mut queue = Queue {
        runs,
        jobs,
        memory_share: Machine::detect().memory_bytes
            / u64::from(jobs).min(plans.len() as u64).max(1),
        waiting: VecDeque::new(),
        running: Vec::new(),
    };
    for (_, plan) in &plans {
        if queue.runs.finished(plan).is_some() {
            progress.find(plan.units);
        } else if !report_only {
            queue.waiting.push_back(Job::of(plan.clone()));
        }
    }
    if let Err(e) = queue.make(progress) {
        queue.stop(progress);
        return Err(e);
    }
    let (mut made, mut missing) = (Vec::new(), Vec::new());
    for (point, plan) in plans {
        match queue.runs.finished(&plan) {
            Some(run) => made.push(Made { point, plan, run }),
            None => missing.push(plan.name),
        }
    }
    let seconds = made.iter().map(|it| it.run.summary.wall_seconds);
    session.count_runs(seconds.sum(), jobs, missing);
    Ok(made)
}

/// Returns the commit of this program's file, which `--version` prints in brackets. Another build may have replaced the file.
fn commit() -> anyhow::Result<String> {
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
    /// The bytes of memory for each of the concurrent runs.
    memory_share: u64,
    waiting: VecDeque<Job>,
    running: Vec<Running>,
}

/// A run to be made, with the history of its tries in this call.
struct Job {
    plan: PlannedRun,
    /// How often the run was started.
    tried: u32,
    /// The updates of the checkpoint that the last try resumed from. That checkpoint may cause the failure, so it is not used again.
    resumed_at: Option<u64>,
}

impl Job {
    const fn of(plan: PlannedRun) -> Self {
        Self {
            plan,
            tried: 0,
            resumed_at: None,
        }
    }
}

struct Running {
    job: Job,
    child: Child,
    /// The units of the plan that are done.
    done: u64,
    /// Whether the run is long enough and was asked to stop.
    enough: bool,
}

impl Queue {
    /// Starts and watches runs until none is waiting or running.
    fn make(&mut self, progress: &mut Progress) -> anyhow::Result<()> {
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
            progress.begin(&format!("{names}; {waiting} waiting"));
            std::thread::sleep(POLL);
            self.look(progress)?;
            progress.advance(0)?;
        }
    }

    /// Counts the new work of the children, and handles those that exited.
    fn look(&mut self, progress: &mut Progress) -> anyhow::Result<()> {
        let mut at = 0;
        while at < self.running.len() {
            let (done, enough) = self.done(&self.running[at].job.plan);
            let running = &mut self.running[at];
            let fresh = done.saturating_sub(running.done);
            running.done += fresh;
            progress.advance(fresh)?;
            if enough && !running.enough {
                running.enough = true;
                ask_to_stop(&running.child, &running.job.plan.name);
            }
            let ended = running.child.try_wait();
            match ended.with_context(|| format!("waiting for {}", running.job.plan.name))? {
                None => at += 1,
                Some(status) => {
                    let ended = self.running.remove(at);
                    self.see_to(ended, status, progress)?;
                }
            }
        }
        Ok(())
    }

    /// Returns the units that the plan's run has done, and whether the run has all its episodes.
    fn done(&self, plan: &PlannedRun) -> (u64, bool) {
        let folder = self.runs.folder(plan);
        let RunProgress { frames, episodes } = read_progress(&folder).unwrap_or_default();
        let share = |part: u64, all: u64| part as f64 / all.max(1) as f64;
        let of_episodes = plan.episodes.map_or(0.0, |all| share(episodes, all));
        let share = of_episodes.max(share(frames, plan.frames)).min(1.0);
        let enough = plan.episodes.is_some_and(|all| episodes >= all);
        ((share * plan.units as f64) as u64, enough)
    }

    /// Counts and returns the units that a resumed run did in an earlier start. They do not count for the speed.
    fn find(&self, plan: &PlannedRun, progress: &mut Progress) -> u64 {
        let (done, _) = self.done(plan);
        progress.find(done);
        done
    }

    /// Handles a run whose process exited: counts a finished run; retries a failed run once, then leaves it out.
    fn see_to(
        &mut self,
        ended: Running,
        status: ExitStatus,
        progress: &mut Progress,
    ) -> anyhow::Result<()> {
        let Job { plan, tried, .. } = &ended.job;
        if self.runs.finished(plan).is_some() {
            return Ok(progress.advance(plan.units - ended.done)?);
        }
        let (name, words) = (&plan.name, self.runs.last_words(plan));
        // Settings that are wrong here are wrong for the other runs too.
        if status.code() == Some(EXIT_USAGE.into()) && ended.job.resumed_at.is_none() {
            return Err(usage!("the run {name} cannot be made:\n{words}").into());
        }
        let (failed, then) = match *tried < TRIES {
            true => ("failed", "is tried once more"),
            false => ("failed again", "is left out"),
        };
        progress.line(&format!(
            "the run {name} {failed} ({status}) and {then}. Its last words:\n{words}"
        ));
        if *tried < TRIES {
            progress.again(ended.done);
            self.waiting.push_back(ended.job);
            return Ok(());
        }
        Ok(progress.advance(plan.units - ended.done)?)
    }

    /// Starts a run in a separate process group, so that only this process passes Ctrl-C to it. `None` if the run is finished or left out.
    fn start(&self, mut job: Job, progress: &mut Progress) -> anyhow::Result<Option<Running>> {
        let plan = &job.plan;
        let path = self.runs.log(plan);
        let doing = || format!("making {}", path.display());
        let log = File::options().create(true).append(true).open(&path);
        let log = log.with_context(doing)?;
        wait_for_the_last(&log, plan, progress)?;
        if self.runs.finished(plan).is_some() {
            progress.find(plan.units);
            return Ok(None);
        }
        log.set_len(0).with_context(doing)?;
        let resumed_at = match self.resumes_at(&job, progress) {
            Ok(updates) => updates,
            Err(e) => {
                progress.line(&format!("the run {} is left out: {e:#}", plan.name));
                progress.find(plan.units);
                return Ok(None);
            }
        };
        let folder = self.runs.folder(plan).path().to_owned();
        let resumed = resumed_at.is_some();
        if !resumed && let Some(aside) = move_aside(&folder)? {
            progress.line(&format!(
                "{} was not finished, or is of another call: it is now {}, and the run starts anew",
                folder.display(),
                aside.display()
            ));
        }
        self.runs.write_call(plan, &commit()?, resumed)?;
        let mut command = self.command(plan, resumed);
        command
            .stdin(Stdio::null())
            .stdout(log.try_clone().with_context(doing)?)
            .stderr(log)
            .process_group(0);
        let starting = || format!("starting the run {}", plan.name);
        let child = command.spawn().with_context(starting)?;
        let found = resumed.then(|| self.find(plan, progress));
        let done = found.unwrap_or(0);
        job.tried += 1;
        job.resumed_at = resumed_at;
        Ok(Some(Running {
            job,
            child,
            done,
            enough: false,
        }))
    }

    /// Builds the command that starts a run, or resumes it. A resumed run keeps its replay size and its number of threads.
    fn command(&self, plan: &PlannedRun, resumed: bool) -> Command {
        let folder = self.runs.folder(plan);
        let mut command = Command::new(process_env::program_path());
        command
            .args(["train", "--no-play"])
            .args(exit_with_parent_flags());
        if resumed {
            command.arg("--resume").arg(folder.path());
        } else {
            command.arg("--run-dir").arg(folder.path());
            command.args(self.threads()).args(plan.call.args());
            command.env(MEMORY_SHARE_ENV, self.memory_share.to_string());
        }
        command
    }

    /// Returns the updates of the checkpoint from which the run resumes; `None` if the run starts from the beginning.
    fn resumes_at(&self, job: &Job, progress: &mut Progress) -> anyhow::Result<Option<u64>> {
        let (plan, folder) = (&job.plan, self.runs.folder(&job.plan));
        if !folder.path().exists() {
            return Ok(None);
        }
        resume::wait_until_free(&folder)?;
        let newest = resume::newest_updates(&folder);
        let is_resumable = newest > job.resumed_at
            && self.runs.is_made_by(plan)
            && resume::is_resumable(&plan.call.config()?.world, &folder);
        if !is_resumable {
            return Ok(None);
        }
        match resume::prepare(&folder, &Flags::default(), &Machine::detect())? {
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

    /// Returns the flags that divide the cores among the concurrent runs, so that their learners do not compete for them.
    fn threads(&self) -> Vec<String> {
        if self.jobs == 1 {
            return Vec::new();
        }
        let threads = (Machine::detect().cores / self.jobs).max(1);
        vec!["--set".into(), format!("local.learner_threads={threads}")]
    }

    /// Asks all children to stop and waits until they have saved. A second interrupt, or `DRAIN_MAX`, kills them.
    fn stop(&mut self, progress: &Progress) {
        if self.running.is_empty() {
            return;
        }
        progress.line("stopping the runs; the same command resumes those that are not finished");
        for running in &self.running {
            ask_to_stop(&running.child, &running.job.plan.name);
        }
        let deadline = Instant::now() + DRAIN_MAX;
        while !self.running.is_empty() {
            if progress.shutdown().now.is_set() || Instant::now() > deadline {
                for running in &mut self.running {
                    // The child may have exited by itself in the meantime.
                    let _ = running.child.kill();
                    let _ = running.child.wait();
                }
                return;
            }
            self.running
                .retain_mut(|running| matches!(running.child.try_wait(), Ok(None)));
            std::thread::sleep(POLL);
        }
    }
}

/// Waits until no process of an earlier call writes to the run: a run whose parent was killed still saves. A child inherits our open
/// log file and with it the lock, so that two processes never write to one folder.
fn wait_for_the_last(log: &File, plan: &PlannedRun, progress: &mut Progress) -> anyhow::Result<()> {
    let mut said = false;
    while !lock_file::try_lock(log).context("locking a run's log")? {
        if !std::mem::replace(&mut said, true) {
            let name = &plan.name;
            progress.line(&format!(
                "an earlier {name} still runs or saves: waiting for it"
            ));
        }
        std::thread::sleep(POLL);
        progress.advance(0)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use driml_protocol::GracefulShutdown;

    use super::*;
    use crate::sweep::{plan::Call, runs::tests::finish};

    /// Creates a queue in `root` with a single plan, whose run is finished.
    fn queue(root: &Path) -> (Queue, PlannedRun) {
        let runs = Runs::open(root).unwrap();
        let plan = PlannedRun::new("run", Call::default(), 10);
        finish(&runs.folder(&plan));
        runs.write_call(&plan, "abc", false).unwrap();
        let queue = Queue {
            runs,
            jobs: 1,
            memory_share: 7,
            waiting: [Job::of(plan.clone())].into(),
            running: Vec::new(),
        };
        (queue, plan)
    }

    #[test]
    fn what_a_resumed_run_did_before_is_no_measure_of_speed() {
        let root = tempfile::tempdir().unwrap();
        let (queue, plan) = queue(root.path());
        let metrics = queue.runs.folder(&plan).metrics();
        std::fs::write(metrics, "seconds,frames,episodes\n60,9,0\n").unwrap();
        let mut progress = Progress::new(10, GracefulShutdown::default());
        assert_eq!(queue.find(&plan, &mut progress), 9);
        assert_eq!(progress.seconds_left(1.0), None);
    }

    #[test]
    fn a_run_is_told_its_part_of_the_memory_once() {
        let root = tempfile::tempdir().unwrap();
        let (queue, plan) = queue(root.path());
        let share = |resumed| {
            let command = queue.command(&plan, resumed);
            let mut shares = command.get_envs().filter(|it| it.0 == MEMORY_SHARE_ENV);
            shares.next().map(|(_, value)| value == Some("7".as_ref()))
        };
        assert_eq!([share(false), share(true)], [Some(true), None]);
    }

    #[test]
    fn a_checkpoint_is_resumed_from_once_and_kept_while_it_cannot_be() {
        let root = tempfile::tempdir().unwrap();
        let (queue, plan) = queue(root.path());
        let folder = queue.runs.folder(&plan);
        std::fs::write(folder.config(), "").unwrap();
        let checkpoint = folder.checkpoints().join("checkpoint-000000000005");
        std::fs::create_dir_all(checkpoint).unwrap();
        let mut progress = Progress::new(10, GracefulShutdown::default());
        let mut job = Job::of(plan);
        for (resumed_at, is_tried) in [(None, true), (Some(4), true), (Some(5), false)] {
            job.resumed_at = resumed_at;
            let found = queue.resumes_at(&job, &mut progress);
            assert_eq!(found.is_err(), is_tried, "{found:?}");
        }
    }

    /// This happens when a run saves while this call waits for the lock of its log.
    #[test]
    fn a_run_that_finished_meanwhile_is_not_made_again() {
        let root = tempfile::tempdir().unwrap();
        let (mut queue, plan) = queue(root.path());
        let mut progress = Progress::new(10, GracefulShutdown::default());
        queue.make(&mut progress).unwrap();
        assert_eq!(queue.runs.finished(&plan).unwrap().commit, "abc");
    }
}
