//! A run of `driml local` in a process of its own, watched from outside as any client could.
//! It changes nothing about the run but its end.

use std::{
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use driml_launch::{
    endpoint::NAMESPACE,
    run_folder::{RunFolder, Summary},
    status_client::Statuses,
};
use driml_protocol::{
    Keys, LearnerStatus, ReplayStatus,
    session::{self, Endpoints},
};
use driml_settings::config::RunConfig;
use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};
use tempfile::TempDir;

/// How often the run is looked at.
const POLL: Duration = Duration::from_millis(50);
/// How long the run may take to listen.
const LISTEN_MAX: Duration = Duration::from_secs(60);
/// How long what is waited for may take.
const WAIT_MAX: Duration = Duration::from_secs(300);
/// Exit code of a run that was interrupted.
const INTERRUPTED: i32 = 130;

/// What the processes said of themselves, and when.
#[derive(Clone)]
pub(super) struct Moment {
    pub(super) at: Instant,
    pub(super) replay: ReplayStatus,
    pub(super) learner: LearnerStatus,
}

/// A launcher, which ends its processes when it is killed.
pub(super) struct Launched {
    launcher: Child,
    statuses: Statuses,
    folder: TempDir,
}

impl Launched {
    /// Starts `driml local` with these flags, which make the settings `config`, and waits until it listens.
    ///
    /// # Errors
    /// A run that ends before it listens, or does not listen in time.
    pub(super) fn start(flags: &[&str], config: &RunConfig) -> anyhow::Result<Self> {
        let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
        let endpoint = format!("unixsock-stream/{}", folder.path().join("s").display());
        let program = std::env::current_exe().context("finding this program's own file")?;
        let mut launcher = Command::new(program)
            .arg("local")
            .args(flags)
            .args(["--listen", &endpoint, "--run-dir"])
            .arg(folder.path().join("run"))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .context("starting the run")?;
        let session = reach(&mut launcher, &endpoint)?;
        let keys = Keys::new(NAMESPACE).map_err(anyhow::Error::msg)?;
        Ok(Self {
            statuses: Statuses::new(vec![session], keys, config.run.hash()),
            launcher,
            folder,
        })
    }

    /// What the processes say now; none while they do not answer, as they start after the replay server and end before it.
    ///
    /// # Errors
    /// The run has ended.
    pub(super) fn look(&mut self) -> anyhow::Result<Option<Moment>> {
        if let Some(status) = self.launcher.try_wait().context("looking at the run")? {
            bail!("the run has ended: {status}");
        }
        let answers = self.statuses.ask_replay();
        if answers.and_then(|()| self.statuses.ask_learner()).is_err() {
            return Ok(None);
        }
        Ok(Some(Moment {
            at: Instant::now(),
            replay: self.statuses.replay.clone(),
            learner: self.statuses.learner.clone(),
        }))
    }

    /// The first moment that is as `wanted`.
    ///
    /// # Errors
    /// The run ended, or it takes too long.
    pub(super) fn wait_until(
        &mut self,
        wanted: impl Fn(&ReplayStatus, &LearnerStatus) -> bool,
    ) -> anyhow::Result<Moment> {
        let started = Instant::now();
        loop {
            let moment = self.look()?;
            if let Some(moment) = moment.filter(|it| wanted(&it.replay, &it.learner)) {
                return Ok(moment);
            }
            ensure!(
                started.elapsed() < WAIT_MAX,
                "the run has not come as far as is to be measured within {} s",
                WAIT_MAX.as_secs()
            );
            std::thread::sleep(POLL);
        }
    }

    /// `first`, and a moment some seconds after it.
    ///
    /// # Errors
    /// The run ended, or does not answer.
    pub(super) fn watch(&mut self, first: Moment, seconds: f64) -> anyhow::Result<[Moment; 2]> {
        let until = first.at + Duration::from_secs_f64(seconds);
        std::thread::sleep(until.saturating_duration_since(Instant::now()));
        let last = self.wait_until(|_, _| true)?;
        Ok([first, last])
    }

    /// Ends the run as Ctrl-C does, and gives its summary.
    ///
    /// # Errors
    /// It does not end as it should.
    pub(super) fn interrupt(mut self) -> anyhow::Result<Summary> {
        self.statuses.close();
        kill(Pid::from_raw(self.launcher.id() as i32), Signal::SIGINT)
            .context("interrupting the run")?;
        self.end(INTERRUPTED)
    }

    /// Waits until the run has come to its end by itself, and gives its summary.
    ///
    /// # Errors
    /// It does not end as it should.
    pub(super) fn finish(mut self) -> anyhow::Result<Summary> {
        self.statuses.close();
        self.end(0)
    }

    fn end(&mut self, code: i32) -> anyhow::Result<Summary> {
        let status = self.launcher.wait().context("waiting for the run")?;
        ensure!(status.code() == Some(code), "the run failed: {status}");
        Summary::read(&RunFolder::new(self.folder.path().join("run")))
    }
}

impl Drop for Launched {
    fn drop(&mut self) {
        // It may have ended, and been waited for, already.
        let _ = self.launcher.kill();
        let _ = self.launcher.wait();
    }
}

/// A session to the run as soon as it listens.
fn reach(launcher: &mut Child, endpoint: &str) -> anyhow::Result<zenoh::Session> {
    let endpoints = Endpoints {
        listen: Vec::new(),
        connect: vec![endpoint.to_owned()],
    };
    let deadline = Instant::now() + LISTEN_MAX;
    loop {
        match session::open(&endpoints) {
            Ok(session) => return Ok(session),
            Err(e) if Instant::now() > deadline => return Err(e.into()),
            Err(e) => tracing::debug!("the run does not listen yet: {e}"),
        }
        if let Some(status) = launcher.try_wait().context("looking at the run")? {
            bail!("the run ended before it listened: {status}");
        }
    }
}
