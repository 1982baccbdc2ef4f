//! `driml watch`: the launcher's live view, metrics and summary for a run that others have started, on any machine.
//! It asks and never tells: the run goes on whether or not it is watched.

mod folder;
mod outputs;
mod prometheus;
mod watched;

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use driml_machine::error::{Interrupted, usage};
use driml_protocol::Seldom;

use crate::{
    console,
    interrupts::Interrupts,
    live_view::recovery,
    run_folder::{Outcome, RunFolder, commands, plot},
    status::{self, Connection, Snapshot},
};
pub use outputs::Outputs;
use prometheus::PrometheusFile;
use watched::Watched;

/// How often the run is asked.
const POLL: Duration = Duration::from_secs(1);
/// The same once all frames are in: the learner's last word is not to be missed, as its process may end soon after.
const LAST_POLL: Duration = Duration::from_millis(200);

/// Asks a run once, as `driml status` does, and prints what it is told; on request as JSON.
///
/// # Errors
/// The run is not well: somebody is missing, gone or silent. A file that cannot be written; [`Interrupted`].
pub fn once(mut connection: Connection, outputs: &Outputs, json: bool) -> anyhow::Result<()> {
    let snapshot = status::run(&mut connection, None, false, json)?;
    connection.close();
    if let Some(path) = &outputs.prometheus
        && let Some(failed) = PrometheusFile::new(path).write(&snapshot)
    {
        bail!("{failed}");
    }
    match snapshot.well {
        true => Ok(()),
        false => bail!("the run is not well: {}", snapshot.to_go_on.join("; ")),
    }
}

/// Waits for replay servers that read their replay back from disk, as long as it takes, and says how far they are; the first answer
/// of all of them.
///
/// # Errors
/// One that has died instead and does not come back; [`Interrupted`].
fn wait_until_known(
    connection: &mut Connection,
    interrupts: &Interrupts,
) -> anyhow::Result<Snapshot> {
    let silent_max = Duration::from_millis(connection.config.learner.unreachable_max_ms);
    let (mut heard, mut said) = (Instant::now(), Seldom::default());
    loop {
        let snapshot = connection.ask();
        if snapshot.is_answered() && connection.after_updates.is_some() {
            return Ok(snapshot);
        }
        if snapshot.is_answered() || snapshot.recovering().next().is_some() {
            heard = Instant::now();
        }
        let is_another_run = snapshot.servers.iter().any(|it| it.is_another_run);
        if is_another_run || heard.elapsed() > silent_max {
            bail!("{}", snapshot.to_go_on.join("; "));
        }
        if said.due().is_some() {
            for (server, progress) in snapshot.recovering() {
                console::line(&recovery(&server.endpoint, progress));
            }
            if snapshot.is_answered() {
                console::line("no learner has joined the run yet: waiting for it");
            }
        }
        if interrupts.wait_timeout(POLL) > 0 {
            return Err(Interrupted.into());
        }
    }
}

/// Shows and records a run until it is over, or until Ctrl-C, which leaves the run alone.
///
/// # Errors
/// A folder that cannot be written to; replay servers that are silent for as long as the run's parts wait for them, or that serve
/// another run; [`Interrupted`].
pub fn run(mut connection: Connection, outputs: &Outputs) -> anyhow::Result<()> {
    let interrupts = Interrupts::listen(None).context("listening for signals")?;
    let mut snapshot = connection.ask();
    let mut file = outputs.prometheus.as_deref().map(PrometheusFile::new);
    if let Some(failed) = file.as_mut().and_then(|it| it.write(&snapshot)) {
        return Err(usage!("--prometheus: {failed}").into());
    }
    let goes_on = |folder: &RunFolder| folder.metrics().exists();
    let is_unknown =
        outputs.run_dir.as_ref().is_some_and(goes_on) && connection.after_updates.is_none();
    if is_unknown || snapshot.recovering().next().is_some() {
        // What the run has done so far is not known before.
        snapshot = wait_until_known(&mut connection, &interrupts)?;
    }
    let mut watched = Watched::new(&connection, &snapshot, outputs)?;
    let ended = loop {
        match watched.take(&snapshot, &mut connection) {
            Ok(false) => {}
            Ok(true) => break Ok(Outcome::Finished),
            Err(e) => break Err(e),
        }
        let pause = match watched.all_frames_are_in() {
            true => LAST_POLL,
            false => POLL,
        };
        if interrupts.wait_timeout(pause) > 0 {
            break Ok(Outcome::Interrupted);
        }
        snapshot = connection.ask();
        if let Some(failed) = file.as_mut().and_then(|it| it.write(&snapshot)) {
            watched.say(&failed);
        }
    };
    connection.close();
    let summary = watched.conclude(*ended.as_ref().unwrap_or(&Outcome::Failed));
    let run_dir = outputs.run_dir.as_ref();
    match ended? {
        Outcome::Interrupted => {
            console::line("the run goes on without being watched");
            return Err(Interrupted.into());
        }
        Outcome::Finished | Outcome::Failed => {}
    }
    let text = match run_dir {
        Some(folder) => summary.describe(folder),
        None => format!("{}\n", summary.counts()),
    };
    console::print(&text)?;
    match run_dir {
        Some(folder) => {
            summary.write(folder)?;
            console::print(&commands(&[plot(folder)]))
        }
        None => Ok(()),
    }
}
