//! A short run of `driml local` with its real processes, watched from outside as any client could.
//! It changes nothing about the run, and says nothing about how well it learns.

use std::time::Duration;

use anyhow::bail;
use driml_launch::console;

use crate::{
    flags::BenchSystemArgs,
    launched::{Launched, Moment},
    measurements::Measurement,
    settings,
};

/// Frames of the run, and of a quick one.
const FRAMES: (u64, u64) = (12_000, 2_500);
/// Updates before the first that counts: by then all threads run and all memory is taken.
const WARMUP_UPDATES: u64 = 10;
/// How often the run is looked at.
const POLL: Duration = Duration::from_millis(100);
const AGENT: &str = "driml-ada";

/// Updates and frames a second, the share of time in which the learner computes, and the highest memory of each process.
///
/// # Errors
/// A run that failed, or was over before it could be looked at.
pub(super) fn measure(args: &BenchSystemArgs) -> anyhow::Result<Vec<Measurement>> {
    procgen_sys::Engine::install(&mut console::line)?;
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &[])?;
    let frames = args.frames.unwrap_or(match args.flags.quick {
        true => FRAMES.1,
        false => FRAMES.0,
    });
    let (frames, threads) = (
        frames.to_string(),
        format!("local.learner_threads={}", args.flags.threads),
    );
    let flags = [
        "--env",
        settings::WORLD,
        "--agent",
        AGENT,
        "--frames",
        &frames,
        "--set",
        &threads,
    ];
    let mut run = Launched::start(&flags, &config)?;
    let [first, last] = watch(&mut run)?;
    let summary = run.finish()?;

    let seconds = (last.at - first.at).as_secs_f64();
    let rate = |first: u64, last: u64| (last - first) as f64 / seconds;
    let computing = last.learner.computing_s - first.learner.computing_s;
    let waiting = last.learner.waiting_s - first.learner.waiting_s;
    let updates = rate(first.learner.updates, last.learner.updates);
    let stored = |moment: &Moment| moment.replay.transitions_inserted;
    let mut figures = vec![
        Measurement::found("updates", updates, "updates/s"),
        Measurement::found("frames", rate(stored(&first), stored(&last)), "frames/s"),
        Measurement::found(
            "share of its time in which the learner computes",
            100.0 * computing / (computing + waiting),
            "%",
        ),
    ];
    figures.extend(summary.rss_mib_max.iter().filter_map(|(process, mib)| {
        let what = format!("memory of {process}");
        Some(Measurement::found(what, mib.as_f64()?, "MiB"))
    }));
    Ok(figures)
}

/// The first moment after the learner's warm-up, and the last one at which both sides were still at work.
fn watch(run: &mut Launched) -> anyhow::Result<[Moment; 2]> {
    let (mut first, mut last) = (None, None);
    // The run ends by itself; then it can no longer be looked at.
    while let Ok(moment) = run.look() {
        std::thread::sleep(POLL);
        let Some(moment) = moment else { continue };
        if moment.replay.finished || moment.learner.finished {
            break;
        }
        if moment.learner.updates >= WARMUP_UPDATES {
            last = Some(moment);
            first = first.or_else(|| last.take());
        }
    }
    match (first, last) {
        (Some(first), Some(last)) => Ok([first, last]),
        _ => bail!("the run was over within {WARMUP_UPDATES} updates: give it more --frames"),
    }
}
