//! Measures whole runs of `driml local` with real processes, observed as by any client: one run to its end, or growing numbers of actors,
//! each for some seconds. The bench only ends the runs, and does not judge how well they learn.

use std::{
    thread,
    time::{Duration, Instant},
};

use anyhow::{bail, ensure};
use driml_launch::{
    console::{self, align_columns},
    managed_process::ManagedProcess,
    output,
    run_folder::{RunFolder, Summary},
    view::{Poller, ServerConnection},
};
use driml_machine::{error::EXIT_INTERRUPTED, units::format_number};
use driml_protocol::{LearnerStatus, ReplayStatus};
use tempfile::TempDir;

use crate::{
    report::{Bench, Measurement},
    settings::{self, AGENT, WORLD},
    subprocess,
};

/// The number of updates before the measurement: by then all threads run and all memory is allocated.
const WARMUP_UPDATES: u64 = 10;
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// The time-out of each wait, including that for the end of a run.
const WAIT_MAX: Duration = Duration::from_secs(300);
const ACTORS: [u32; 6] = [1, 2, 4, 8, 16, 32];
/// Replay ratios, and at each how far either side may run ahead, in transitions. At the first ratio the actors wait for the learner, at the
/// second they limit the run.
const RATIOS: [(f64, u64); 2] = [(8.0, 256), (0.1, 10_000)];

/// Measures updates and frames per second of a run, the share of time in which the learner computes, and each process's peak memory.
pub(super) fn measure(frames: Option<u64>, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    procgen_sys::Engine::install(&mut console::eprintln)?;
    let frames = frames.unwrap_or(bench.flags.unless_quick(12_000, 5_000));
    let threads = format!("local.learner_threads={}", bench.flags.threads);
    let mut run = Run::start(&["--frames", &frames.to_string()], &[&threads])?;
    let samples = run.watch_to_end()?;
    let summary = run.finish(0)?;
    let [before, after] = samples.each_ref().map(|it| &it.learner);
    let computing = after.computing_s - before.computing_s;
    let waiting = after.waiting_s - before.waiting_s;
    let share = 100.0 * computing / (computing + waiting);
    let updates = per_second(&samples, |it| it.learner.updates);
    let frames = per_second(&samples, |it| it.replay.transitions_inserted);
    ensure!(
        frames > 0.0,
        "all frames were stored before the measurement began: add --frames with a larger number"
    );
    let computes = "share of its time in which the learner computes";
    let figures = &mut bench.figures;
    figures.record("updates", updates, "updates/s");
    figures.record("frames", frames, "frames/s");
    figures.record(computes, share, "%");
    let memory = summary.rss_mib_max.iter();
    for (process, mib) in memory.filter_map(|(process, mib)| Some((process, (*mib)?))) {
        figures.record(format!("memory of {process}"), mib, "MiB");
    }
    Ok(())
}

/// Measures runs at both ratios with growing numbers of actors, as figures and as a table.
pub(super) fn scale(
    actors: &[u32],
    seconds: Option<u32>,
    bench: &mut Bench<'_>,
) -> anyhow::Result<()> {
    procgen_sys::Engine::install(&mut console::eprintln)?;
    let actors = match actors {
        [] => bench.flags.unless_quick(&ACTORS[..], &ACTORS[..2]),
        asked => asked,
    };
    let seconds = seconds.unwrap_or(bench.flags.unless_quick(5, 2));
    let mut rows = Vec::new();
    for (ratio, slack) in RATIOS {
        for &actors in actors {
            let mut heads = ["ratio", "actors"].map(String::from).to_vec();
            let mut row = vec![ratio.to_string(), actors.to_string()];
            for (column, value) in measure_columns(actors, ratio, slack, seconds)? {
                row.push(value.map_or("-".into(), format_number));
                if let Some(value) = value {
                    let what = format!("ratio {ratio}, {actors} actors: {column}");
                    let unit = column.clone();
                    bench.figures.add(Measurement { what, value, unit });
                }
                heads.push(column);
            }
            console::eprintln(&format!("  {}", row.join("  ")));
            if rows.is_empty() {
                rows.push(heads);
            }
            rows.push(row);
        }
    }
    let columns: Vec<_> = (0..rows[0].len()).collect();
    bench.table = Some(align_columns(&rows, &columns));
    Ok(())
}

/// Returns a row of the table: what was measured of a run with `actors` actors, from its start until it was watched for `seconds`.
fn measure_columns(
    actors: u32,
    ratio: f64,
    slack: u64,
    seconds: u32,
) -> anyhow::Result<Vec<(String, Option<f64>)>> {
    let ratio = format!("replay.replay_ratio={ratio}");
    let slack = format!("replay.slack_transitions={slack}");
    let sets = [
        &*ratio,
        &*slack,
        "replay.capacity_transitions=20000",
        "replay.transitions_max=1000000000000",
    ];
    let started = Instant::now();
    let mut run = Run::start(&["--actors", &actors.to_string()], &sets)?;
    let acting = run.wait_for(|now| now.replay.actors_acting >= actors)?;
    let first = run.wait_for(|now| now.learner.updates > 2)?;
    let until = first.at + Duration::from_secs(seconds.into());
    thread::sleep(until.saturating_duration_since(Instant::now()));
    let samples = [first, run.wait_for(|_| true)?];
    run.launcher.ask_to_stop();
    let summary = run.finish(EXIT_INTERRUPTED.into())?;
    let frames = per_second(&samples, |it| it.replay.transitions_inserted);
    let updates = per_second(&samples, |it| it.learner.updates);
    // From the launcher's start to the last actor's first frame.
    let all_act_after_s = (acting.at - started).as_secs_f64();
    let mut columns = vec![
        ("frames/s".to_owned(), Some(frames)),
        ("updates/s".to_owned(), Some(updates)),
        ("all act after s".to_owned(), Some(all_act_after_s)),
    ];
    let replay = &samples[1].replay;
    for (name, unit, quantiles) in [
        ("answer", "ms", replay.answer_ms),
        ("insert", "ms", replay.insert_ms),
        ("weights behind", "s", replay.weights_behind_s),
        ("weights behind", "updates", replay.weights_behind_updates),
    ] {
        columns.push((format!("{name} p50 {unit}"), quantiles.map(|it| it.p50)));
        columns.push((format!("{name} p99 {unit}"), quantiles.map(|it| it.p99)));
    }
    let memory = summary.rss_mib_max.values().flatten().sum();
    columns.push(("MiB of all".to_owned(), Some(memory)));
    let whole = &summary.replay;
    columns.push(("retried".to_owned(), Some(whole.chunks_retried as f64)));
    columns.push(("lost".to_owned(), Some(whole.transitions_lost as f64)));
    Ok(columns)
}

fn per_second([first, last]: &[StatusSample; 2], count: fn(&StatusSample) -> u64) -> f64 {
    let seconds = (last.at - first.at).as_secs_f64();
    (count(last) - count(first)) as f64 / seconds
}

struct StatusSample {
    at: Instant,
    replay: ReplayStatus,
    learner: LearnerStatus,
}

/// A run of bigfish with driml-ada. Dropping the value ends the run.
struct Run {
    launcher: ManagedProcess,
    poller: Poller,
    folder: TempDir,
}

impl Run {
    /// Starts `driml local` with these flags and settings, and waits until it listens.
    fn start(flags: &[&str], sets: &[&str]) -> anyhow::Result<Self> {
        let config = settings::run_config(WORLD, AGENT, "paper", sets)?;
        let folder = output::temporary_folder()?;
        let endpoint = format!("unixsock-stream/{}", folder.path().join("s").display());
        let run_dir = folder.path().join("run").display().to_string();
        let args = [&["local", "--no-play", "--run-dir", &*run_dir][..], flags].concat();
        let launcher = subprocess::start("launcher", &args, &endpoint, sets, folder.path())?;
        let reached = ServerConnection::open("replay-server", &endpoint, config.run.hash())?;
        Ok(Self {
            poller: Poller::new(&config, vec![reached]),
            launcher,
            folder,
        })
    }

    /// Requests the statuses; `None` while a process does not answer, as they start after the replay server and end before it.
    fn sample_status(&mut self) -> anyhow::Result<Option<StatusSample>> {
        self.launcher.check_alive()?;
        let answers = self.poller.poll_replay();
        let answers = answers.and_then(|()| self.poller.poll_learner());
        Ok(answers.is_ok().then(|| StatusSample {
            at: Instant::now(),
            replay: self.poller.view.replay.clone(),
            learner: self.poller.view.learner.clone(),
        }))
    }

    fn wait_for(&mut self, wanted: impl Fn(&StatusSample) -> bool) -> anyhow::Result<StatusSample> {
        let started = Instant::now();
        loop {
            if let Some(sample) = self.sample_status()?.filter(&wanted) {
                return Ok(sample);
            }
            ensure!(
                started.elapsed() < WAIT_MAX,
                "the run was not ready to be measured within {} s",
                WAIT_MAX.as_secs()
            );
            thread::sleep(POLL_INTERVAL / 2);
        }
    }

    /// Returns the first sample after the learner's warm-up, and the last one at which both sides were still at work.
    fn watch_to_end(&mut self) -> anyhow::Result<[StatusSample; 2]> {
        let (mut first, mut last) = (None, None);
        // The run ends by itself; then it does not answer.
        while let Ok(sample) = self.sample_status() {
            thread::sleep(POLL_INTERVAL);
            let Some(sample) = sample else { continue };
            if sample.replay.finished || sample.learner.finished {
                break;
            }
            if sample.learner.updates >= WARMUP_UPDATES {
                last = Some(sample);
                first = first.or_else(|| last.take());
            }
        }
        match (first, last) {
            (Some(first), Some(last)) => Ok([first, last]),
            _ => {
                let failed = self.launcher.exit_status().is_some_and(|it| !it.success());
                ensure!(!failed, "{}", self.launcher.exit_report());
                bail!("the run was over within {WARMUP_UPDATES} updates: give it more --frames")
            }
        }
    }

    fn finish(mut self, code: i32) -> anyhow::Result<Summary> {
        self.poller.close();
        let deadline = Instant::now() + WAIT_MAX;
        let end = self.launcher.wait_until(deadline, || false);
        let code_of_end = end.and_then(|end| end.code());
        ensure!(code_of_end == Some(code), "{}", self.launcher.exit_report());
        Summary::read(&RunFolder::new(self.folder.path().join("run")))
    }
}
