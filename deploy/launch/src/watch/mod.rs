//! `driml watch`: the launcher's live view, metrics and summary for a run that others have started, on any machine.
//! It asks and never tells: the run goes on whether or not it is watched.

mod folder;
mod prometheus;
mod watched;

use std::{path::PathBuf, time::Duration};

use anyhow::{Context, bail};
use driml_machine::error::{Interrupted, usage};

use crate::{
    console,
    interrupts::Interrupts,
    run_folder::{Outcome, RunFolder},
    status::{self, Connection},
};
use prometheus::PrometheusFile;
use watched::Watched;

/// How often the run is asked.
const POLL: Duration = Duration::from_secs(1);
/// The same once all frames are in: the learner's last word is not to be missed, as its process may end soon after.
const LAST_POLL: Duration = Duration::from_millis(200);

/// What is left of a run that is watched.
#[derive(Clone, Debug, Default)]
pub struct Outputs {
    /// Where settings, metrics and summary go; none to only look.
    pub run_dir: Option<RunFolder>,
    /// Write TensorBoard's events there, too.
    pub tensorboard: bool,
    /// Where the numbers go in Prometheus' text format, at each answer.
    pub prometheus: Option<PathBuf>,
}

/// Asks a run once, as `driml status` does, and prints what it is told; on request as JSON.
///
/// # Errors
/// The run is not well: somebody is missing, gone or silent. A file that cannot be written; [`Interrupted`].
pub fn once(mut connection: Connection, outputs: &Outputs, json: bool) -> anyhow::Result<()> {
    let snapshot = status::run(&mut connection, false, json)?;
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
    let mut watched = Watched::new(&connection, &snapshot, outputs)?;
    let ended = loop {
        match watched.take(&snapshot) {
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
            let folder = folder.display();
            console::print(&format!(
                "  driml plot {folder} --out plot.png              return, losses, k and speed\n"
            ))
        }
        None => Ok(()),
    }
}
