//! `driml watch` and `driml status`: the live lines, metrics and summary of a run that other commands have started, on any machine.
//! These commands only ask: the run does not depend on whether it is watched.

mod watched;

use std::{path::PathBuf, time::Duration};

use anyhow::{Context, bail, ensure};
use clap::Args;
use driml_machine::{
    error::{Interrupted, usage},
    units::count,
};
use driml_protocol::{LogLimiter, Shutdown, reach};
use serde::Serialize;

use self::watched::WatchedRun;
use crate::{
    checkpoint_choice::read_config,
    console, resume,
    run_folder::{
        Outcome, Progress, RunFolder, Summary, format_commands, plot_command, read_last_row,
        read_progress,
    },
    view::{
        Poller, PrometheusFlag, actions_needed, describe_recovery, missing_shards, run_json,
        status_page,
    },
};

/// What `driml watch` does with a run.
#[derive(Debug, Args)]
pub struct WatchFlags {
    /// Write settings, metrics and summary into this folder; a folder of the same run is continued
    #[arg(long, value_name = "DIR")]
    run_dir: Option<PathBuf>,
    /// Write TensorBoard events into that folder
    #[arg(long, requires = "run_dir")]
    tensorboard: bool,
    #[command(flatten)]
    exported: PrometheusFlag,
}

/// What `driml status` does with a run.
#[derive(Debug, Default, Args)]
pub struct StatusFlags {
    /// Repeat every two seconds until the run is over or Ctrl-C, and exit with code 0; without it, exit with code 1 unless the run is
    /// healthy
    #[arg(long)]
    watch: bool,
    /// Print one JSON object per answer
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    exported: PrometheusFlag,
}

const PAGE_PERIOD: Duration = Duration::from_secs(2);

/// Prints a page or a JSON object about a run, which `open` finds. If no process can be asked, the run's `folder`, if it is known, tells
/// how the run ended, or that its launcher still runs.
///
/// # Errors
/// A file that cannot be written; [`Interrupted`] if Ctrl-C came before the first page; without `--watch`, a run in which a process is
/// missing, gone or unresponsive.
pub fn status(
    open: impl Fn() -> anyhow::Result<Poller>,
    folder: Option<&RunFolder>,
    flags: &StatusFlags,
) -> anyhow::Result<()> {
    let mut found = Some(open());
    let interrupted = Shutdown::on_signals(None)?;
    let mut poller: Option<Poller> = None;
    let mut look = || -> anyhow::Result<(String, bool, bool)> {
        let poller = match &mut poller {
            Some(poller) => poller,
            none => {
                let found = found.take().unwrap_or_else(&open);
                let poller = none.insert(flags.exported.check_found(found)?);
                // At the first poll, a process may not be reachable yet.
                poller.poll();
                if interrupted.wait_timeout(poller.pause()) {
                    return Err(Interrupted.into());
                }
                poller
            }
        };
        let mut view = poller.poll().clone();
        // Until this process has observed the run for long enough, the launcher knows the speed.
        view.speed = view.speed.or_else(|| read_last_row(folder?));
        let view = &view;
        flags.exported.write(view)?;
        if let Some(folder) = folder.filter(|_| view.servers_ended()) {
            read_endpoints(folder)?;
        }
        let text = match flags.json {
            true => run_json(view)?,
            false => status_page(view, console::page_width()),
        };
        Ok((text, actions_needed(view).is_empty(), view.is_over()))
    };
    let is_well = loop {
        let seen = look().or_else(|e| {
            let unreachable = e.downcast::<UnreachableRun>()?;
            // A launcher that runs may start its replay server, for the first time or again.
            let is_over = !folder.is_some_and(RunFolder::is_locked);
            anyhow::Ok((unreachable.text(flags.json)?, unreachable.is_well, is_over))
        });
        let (text, is_well, is_over) = seen?;
        let is_read = match flags.watch && !flags.json {
            true => console::print_page(&text)?,
            false => console::print_unless_closed(&text)?,
        };
        if !(flags.watch && is_read) || is_over || interrupted.wait_timeout(PAGE_PERIOD) {
            break is_well;
        }
    };
    ensure!(is_well || flags.watch, "the run is not healthy");
    Ok(())
}

/// Watches a run that was `found`: shows and records it until it is over. The file for Prometheus tells whether the run answers. If
/// `driml train` stops, the run's `folder`, if it is known, tells how it ended.
///
/// # Errors
/// A file that cannot be written; [`Interrupted`]; replay servers that do not answer for as long as the run's processes wait for them, that
/// have exited with a replay in memory, or that serve another run.
pub fn run(
    found: anyhow::Result<Poller>,
    folder: Option<&RunFolder>,
    flags: &WatchFlags,
) -> anyhow::Result<()> {
    let found = flags.exported.check_found(found);
    if let (Err(e), Some(dir)) = (&found, &flags.run_dir)
        && e.is::<UnreachableRun>()
    {
        bail!(usage!("nothing is written into {}: {e}", dir.display()));
    }
    let watched = found.and_then(|poller| watch(poller, folder, flags));
    watched.or_else(|e| console::print(&e.downcast::<UnreachableRun>()?.text(false)?))
}

/// Waits until the replay servers have read their replay back and a learner has joined. Prints the progress; fails if they are silent.
fn wait_until_known(
    poller: &mut Poller,
    exported: &PrometheusFlag,
    interrupted: &Shutdown,
) -> anyhow::Result<()> {
    let silent_max = Duration::from_millis(poller.config.learner.unreachable_max_ms);
    let mut limiter = LogLimiter::default();
    loop {
        let view = poller.poll();
        exported.write(view)?;
        if view.servers_answered() && view.after_updates.is_some() {
            return Ok(());
        }
        let is_another_run = view.servers.iter().any(|it| it.is_another_run);
        if is_another_run || view.replay_silence.length() > silent_max {
            bail!("{}", actions_needed(view).join("; "));
        }
        if limiter.admit().is_some() {
            for (server, progress) in view.recovering() {
                console::eprintln(&describe_recovery(&server.name, progress));
            }
            if view.servers_answered() {
                console::eprintln("no learner has joined the run yet: waiting for it");
            }
        }
        if interrupted.wait_timeout(poller.pause()) {
            return Err(Interrupted.into());
        }
    }
}

/// Shows and records a run until it is over, or until Ctrl-C, after which the run continues.
fn watch(mut poller: Poller, run: Option<&RunFolder>, flags: &WatchFlags) -> anyhow::Result<()> {
    let folder = flags.run_dir.as_ref().map(RunFolder::new);
    let interrupted = Shutdown::on_signals(None).context("listening for signals")?;
    poller.poll();
    flags.exported.write(&poller.view)?;
    let is_begun = |folder: &RunFolder| folder.metrics().exists();
    let is_unknown = folder.as_ref().is_some_and(is_begun) && poller.view.after_updates.is_none();
    if is_unknown || poller.view.recovering().next().is_some() {
        // Before that, it is not known what the run has done so far.
        wait_until_known(&mut poller, &flags.exported, &interrupted)?;
    }
    if let Some(missing) = missing_shards(&poller.view) {
        bail!(usage!("{missing}"));
    }
    let mut watched = WatchedRun::new(&poller, folder.as_ref(), flags.tensorboard)?;
    let mut has_warned = false;
    let ended = loop {
        match watched.show_and_record(&mut poller) {
            Ok(false) => {}
            Ok(true) => break Ok(Outcome::Finished),
            Err(e) => break Err(e),
        }
        let is_cut_short = poller.view.servers_ended() && !poller.view.is_over();
        let continues = match run {
            // A launcher that runs may restart its replay server, or play the last checkpoint after its servers have exited.
            Some(run) if run.is_locked() => Ok(()),
            Some(run) if is_cut_short => read_endpoints(run).map(drop),
            _ => watched.check_continues(&poller),
        };
        if let Err(e) = continues {
            break Err(e);
        }
        if interrupted.wait_timeout(poller.pause()) {
            break Ok(Outcome::Interrupted);
        }
        poller.poll();
        if let Err(failed) = flags.exported.write(&poller.view)
            && !std::mem::replace(&mut has_warned, true)
        {
            watched.display.screen.print_line(&failed.0);
        }
    };
    poller.close();
    let outcome = *ended.as_ref().unwrap_or(&Outcome::Failed);
    let summary = watched.finish(&mut poller.view, outcome);
    let error = ended.as_ref().err();
    let unseen = error.and_then(|e| e.downcast_ref::<UnreachableRun>());
    let whole = unseen.filter(|it| it.finished);
    let whole = whole.and_then(|it| it.summary.as_ref());
    if let Some((whole, folder)) = whole.zip(folder.as_ref()) {
        whole.write(folder)?;
        let metrics = folder.metrics();
        console::eprintln(&format!("{} lacks the run's last rows", metrics.display()));
    }
    if ended? == Outcome::Interrupted {
        console::eprintln("the run continues without being watched");
        return Err(Interrupted.into());
    }
    match &folder {
        Some(folder) => {
            console::print_wrapped(&summary.describe(folder), 2)?;
            summary.write(folder)?;
            console::print(&format_commands(&[plot_command(folder)]))
        }
        None => console::print_wrapped(&format!("{}\n", summary.describe_counts()), 2),
    }
}

/// The state of a run of which no process can be asked.
#[derive(Debug, Serialize, thiserror::Error)]
#[error("{message}")]
pub struct UnreachableRun {
    /// Whether the run is complete and its processes have ended.
    finished: bool,
    message: String,
    summary: Option<Summary>,
    /// Text that follows the message in the output for a person.
    #[serde(skip)]
    details: String,
    /// Whether the run is finished, or will be without a person's help.
    #[serde(skip)]
    is_well: bool,
}

impl UnreachableRun {
    /// Returns the state, as one line of JSON or as text for a person.
    fn text(&self, as_json: bool) -> serde_json::Result<String> {
        Ok(match as_json {
            true => serde_json::to_string(self)? + "\n",
            false => format!("{}\n{}", self.message, self.details),
        })
    }
}

/// Reads the endpoints of a run's replay servers from its folder.
///
/// # Errors
/// [`UnreachableRun`] if no process can be asked. The folder has no settings: it is not a run's, or the processes of the run were
/// started by hand.
pub fn read_endpoints(folder: &RunFolder) -> anyhow::Result<Vec<String>> {
    let config = read_config(folder)?;
    let endpoints = std::fs::read_to_string(folder.endpoints()).unwrap_or_default();
    let mut lines = endpoints.lines();
    if lines.any(|it| reach::check_listening(it).is_ok()) {
        return Ok(endpoints.lines().map(str::to_owned).collect());
    }
    let run = folder.display();
    // A running launcher holds the lock, and so does a run in lockstep.
    let is_locked = folder.is_locked();
    let counts =
        |it: Progress| [count(it.frames, "frame"), count(it.episodes, "episode")].join(" and ");
    let saved = || {
        let (updates, _) = folder.newest_checkpoint()?;
        Some(format!("a checkpoint after {}", count(updates, "update")))
    };
    let so_far = read_progress(folder).map(counts).or_else(saved);
    let so_far = so_far.unwrap_or_else(|| "nothing".into());
    let mut state = UnreachableRun {
        finished: !is_locked && Summary::is_finished(folder),
        message: "the run is over".into(),
        summary: Summary::read(folder).ok(),
        details: String::new(),
        is_well: true,
    };
    if is_locked && endpoints.is_empty() {
        state.message = format!(
            "one process uses {run}, in lockstep, as `driml watch` or to play the last episodes, and answers no requests. metrics.csv has {so_far} so far"
        );
    } else if is_locked {
        let frames = read_progress(folder).map_or(0, |it| it.frames);
        let how = match frames >= config.frames() {
            true => "is stopping: all frames are stored and its replay server has exited",
            false => "is starting or stopping: no replay server listens",
        };
        state.message =
            format!("the run in {run} {how}. Its launcher still runs; retry in a moment");
    } else if let Some(summary) = state.summary.as_ref().filter(|_| state.finished) {
        state.details = summary.describe(folder);
    } else {
        let next = match resume::is_resumable(&config.world, folder) {
            true => format!("`driml train --resume {}` resumes it", folder.quoted()),
            false => "it has no checkpoint to resume from".into(),
        };
        state.is_well = false;
        state.message = format!(
            "no process runs in {run}, which holds {so_far}: {next}. For processes that were started by hand, use --connect ENDPOINT"
        );
    }
    Err(state.into())
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixListener;

    use super::*;
    use crate::testing::{config, run_folder};

    /// As on a file system without locks.
    #[test]
    fn a_server_that_listens_is_found_without_a_lock() {
        let (root, folder) = run_folder();
        let settings = config("smoke", "chain", "c51", &[]);
        std::fs::write(folder.config(), settings.to_toml()).unwrap();
        let socket = root.path().join("s");
        let endpoint = format!("unixsock-stream/{}", socket.display());
        std::fs::write(folder.endpoints(), &endpoint).unwrap();
        let found = || match read_endpoints(&folder) {
            Ok(endpoints) => endpoints.join(" "),
            Err(e) => e.downcast::<UnreachableRun>().unwrap().message,
        };
        let listener = UnixListener::bind(&socket).unwrap();
        assert_eq!(found(), endpoint);
        drop(listener);
        let said = found();
        assert!(said.starts_with("no process runs in "), "{said}");
        // As if the servers had exited after the poller was opened.
        let open = || Ok(Poller::new(&settings, Vec::new()));
        let said = status(open, Some(&folder), &StatusFlags::default());
        let said = said.unwrap_err().to_string();
        assert_eq!(said, "the run is not healthy");
        // As in a run in lockstep.
        std::fs::remove_file(folder.endpoints()).unwrap();
        let _lock = folder.lock().unwrap();
        let said = found();
        assert!(said.starts_with("one process uses "), "{said}");
    }
}
