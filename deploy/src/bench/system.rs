//! A short run of `driml local` with its real processes, watched from outside as any client could.
//! It changes nothing about the run, and says nothing about how well it learns.

use std::{
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use driml_protocol::{
    Keys, LearnerStatus, ReplayStatus,
    session::{self, Endpoints},
};

use crate::{
    bench::{figures::Figure, settings},
    cli::{BenchSystemArgs, NAMESPACE},
    config::RunConfig,
    console,
    statuses::Statuses,
};

/// Frames of the run, and of a quick one.
const FRAMES: (u64, u64) = (12_000, 2_500);
/// Updates before the first that counts: by then all threads run and all memory is taken.
const WARMUP_UPDATES: u64 = 10;
/// How often the run is looked at.
const POLL: Duration = Duration::from_millis(100);
/// How long the run may take to listen.
const LISTEN_MAX: Duration = Duration::from_secs(60);
const AGENT: &str = "driml-ada";

/// Updates and frames a second, the share of time in which the learner computes, and the highest memory of each process.
///
/// # Errors
/// A run that failed, or was over before it could be looked at.
pub(super) fn measure(args: &BenchSystemArgs) -> anyhow::Result<Vec<Figure>> {
    procgen_sys::Engine::install(&mut console::line)?;
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &[])?;
    let frames = args.frames.unwrap_or(match args.flags.quick {
        true => FRAMES.1,
        false => FRAMES.0,
    });
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    let endpoint = format!("unixsock-stream/{}", folder.path().join("s").display());
    let run_dir = folder.path().join("run");
    let mut run = Run(Command::new(
        std::env::current_exe().context("finding this program's own file")?,
    )
    .args(["local", "--env", settings::WORLD, "--agent", AGENT])
    .args(["--frames", &frames.to_string(), "--listen", &endpoint])
    .args([
        "--set",
        &format!("local.learner_threads={}", args.flags.threads),
    ])
    .arg("--run-dir")
    .arg(&run_dir)
    .stdin(Stdio::null())
    .stdout(Stdio::null())
    .spawn()
    .context("starting the run")?);
    let [first, last] = run.watch(&endpoint, &config)?;
    let status = run.0.wait().context("waiting for the run")?;
    ensure!(status.success(), "the run failed: {status}");

    let seconds = (last.at - first.at).as_secs_f64();
    let rate = |first: u64, last: u64| (last - first) as f64 / seconds;
    let computing = last.learner.computing_s - first.learner.computing_s;
    let waiting = last.learner.waiting_s - first.learner.waiting_s;
    let updates = rate(first.learner.updates, last.learner.updates);
    let stored = |moment: &Moment| moment.replay.transitions_inserted;
    let mut figures = vec![
        Figure::found("updates", updates, "updates/s"),
        Figure::found("frames", rate(stored(&first), stored(&last)), "frames/s"),
        Figure::found(
            "share of its time in which the learner computes",
            100.0 * computing / (computing + waiting),
            "%",
        ),
    ];
    let path = run_dir.join("summary.json");
    let text = std::fs::read(&path).with_context(|| format!("reading {}", path.display()))?;
    let summary: serde_json::Value = serde_json::from_slice(&text)?;
    let memory = summary["rss_mib_max"].as_object().into_iter().flatten();
    figures.extend(memory.filter_map(|(process, mib)| {
        Some(Figure::found(
            format!("memory of {process}"),
            mib.as_f64()?,
            "MiB",
        ))
    }));
    Ok(figures)
}

/// A launcher, which ends its parts when it is killed.
struct Run(Child);

impl Drop for Run {
    fn drop(&mut self) {
        // It may have ended, and been waited for, already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What the parts said of themselves, and when.
struct Moment {
    at: Instant,
    replay: ReplayStatus,
    learner: LearnerStatus,
}

impl Run {
    /// The first moment after the learner's warm-up, and the last one at which both sides were still at work.
    fn watch(&mut self, endpoint: &str, config: &RunConfig) -> anyhow::Result<[Moment; 2]> {
        let keys = Keys::new(NAMESPACE).map_err(anyhow::Error::msg)?;
        let mut statuses = Statuses::new(vec![self.reach(endpoint)?], keys, config.run.hash());
        let (mut first, mut last) = (None, None);
        while self.0.try_wait().context("looking at the run")?.is_none() {
            std::thread::sleep(POLL);
            if statuses
                .ask_replay()
                .and_then(|()| statuses.ask_learner())
                .is_err()
            {
                // The parts start after the replay server, and end before it.
                continue;
            }
            let (replay, learner) = (statuses.replay.clone(), statuses.learner.clone());
            if replay.finished || learner.finished {
                break;
            }
            if learner.updates >= WARMUP_UPDATES {
                let at = Instant::now();
                last = Some(Moment {
                    at,
                    replay,
                    learner,
                });
                first = first.or_else(|| last.take());
            }
        }
        statuses.close();
        match (first, last) {
            (Some(first), Some(last)) => Ok([first, last]),
            _ => bail!("the run was over within {WARMUP_UPDATES} updates: give it more --frames"),
        }
    }

    /// A session to the run as soon as it listens.
    fn reach(&mut self, endpoint: &str) -> anyhow::Result<zenoh::Session> {
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
            if let Some(status) = self.0.try_wait().context("looking at the run")? {
                bail!("the run ended before it listened: {status}");
            }
        }
    }
}
