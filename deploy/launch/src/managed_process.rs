//! A child process of a run: starts it, watches it, asks it to stop, and waits for several of them together.
//! This module does not know what the processes do or in which order they end.

use std::{
    ffi::OsStr,
    os::unix::process::{CommandExt, ExitStatusExt},
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    time::{Duration, Instant},
};

use anyhow::{Context, ensure};
use driml_machine::{
    error::EXIT_INTERRUPTED,
    process_env::program_path,
    units::{duration, proc_kib},
};
use driml_protocol::Shutdown;
use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};

use crate::{console::Screen, process_log::ProcessLog};

/// A process that fails within this time of its start would fail again after a restart.
const EARLY_FAILURE_MAX: Duration = Duration::from_secs(10);
/// How long a killed process may take to end.
const KILLED_MAX: Duration = Duration::from_secs(30);
const POLL: Duration = Duration::from_millis(20);

/// A child process that was started. Dropping this kills it.
#[derive(Debug)]
pub struct ManagedProcess {
    /// The process's name: `replay-server`, `learner`, `actor-0`.
    pub name: String,
    child: Child,
    started: Instant,
    /// The log that this process writes for the child; none if the child's output goes elsewhere.
    pub(crate) log: Option<ProcessLog>,
}

/// The environment variable that sets the number of threads that a process uses for arithmetic.
pub const THREADS_VARIABLE: &str = "RAYON_NUM_THREADS";

/// Flags for a child that must exit when this process does. They name this process, because it may have died before the child
/// looks up its parent.
pub fn exit_with_parent_flags() -> [String; 2] {
    ["--exit-with-parent".into(), std::process::id().to_string()]
}

/// The command that starts this program with other arguments and `threads` threads for arithmetic. The child exits when this process
/// does, from which it inherits the rest of its environment.
pub fn program_command(args: &[impl AsRef<OsStr>], threads: u32) -> Command {
    let mut command = Command::new(program_path());
    command.env(THREADS_VARIABLE, threads.to_string());
    command.args(args).args(exit_with_parent_flags());
    command.stdin(Stdio::null());
    command
}

impl ManagedProcess {
    /// Starts a process in its own process group, so that Ctrl-C does not reach it.
    pub fn spawn(name: &str, mut command: Command) -> anyhow::Result<Self> {
        let child = command.process_group(0).spawn();
        Ok(Self {
            name: name.into(),
            child: child.with_context(|| format!("starting {name}"))?,
            started: Instant::now(),
            log: None,
        })
    }

    /// [`Self::spawn`] with a log, which is written into the folder `logs`. The process's warnings are shown on `screen`.
    pub fn start(
        name: &str,
        mut command: Command,
        logs: &Path,
        screen: &Screen,
    ) -> anyhow::Result<Self> {
        let mut log = ProcessLog::open(name, logs)?;
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut process = Self::spawn(name, command)?;
        let pipes = (process.child.stdout.take(), process.child.stderr.take());
        log.follow(pipes.0.expect("it is piped"), screen)?;
        log.follow(pipes.1.expect("it is piped"), screen)?;
        process.log = Some(log);
        Ok(process)
    }

    /// Whether the process ended in a way that a restart may fix: it exited in order, a signal other than SIGABRT killed it, or it
    /// had run for longer than `EARLY_FAILURE_MAX`. SIGABRT comes from a broken invariant of our own.
    pub(crate) fn is_restartable(&mut self) -> bool {
        let is_external = |signal| signal != Signal::SIGABRT as i32;
        let ran_long = self.started.elapsed() > EARLY_FAILURE_MAX;
        self.exit_status().is_some_and(|status| {
            is_orderly_exit(status) || status.signal().is_some_and(is_external) || ran_long
        })
    }

    /// Returns an error if the process has ended.
    pub fn check_alive(&mut self) -> anyhow::Result<()> {
        ensure!(self.exit_status().is_none(), "{}", self.exit_report());
        Ok(())
    }

    /// The exit status of the process, if it has ended.
    pub fn exit_status(&mut self) -> Option<ExitStatus> {
        // An error means that the child does not exist any more, which cannot happen before it was waited for.
        self.child.try_wait().ok().flatten()
    }

    /// Asks the process to drain and exit.
    pub fn ask_to_stop(&mut self) {
        if self.exit_status().is_some() {
            return;
        }
        // Nothing else waits for the child, so its PID cannot belong to another process yet.
        if let Err(e) = kill(Pid::from_raw(self.child.id() as i32), Signal::SIGTERM) {
            tracing::debug!("asking {} to stop: {e}", self.name);
        }
    }

    /// Kills the process at once.
    pub fn kill(&mut self) {
        if let Err(e) = self.child.kill() {
            tracing::debug!("killing {}: {e}", self.name);
        }
    }

    /// Waits until the process has ended, until `deadline`, or until `abort` returns true.
    pub fn wait_until(
        &mut self,
        deadline: Instant,
        abort: impl Fn() -> bool,
    ) -> Option<ExitStatus> {
        while self.exit_status().is_none() && Instant::now() < deadline && !abort() {
            std::thread::sleep(POLL);
        }
        let status = self.exit_status();
        if let (Some(_), Some(log)) = (status, &mut self.log) {
            log.finish();
        }
        status
    }

    /// Resident memory, MiB; none once the process has ended.
    pub fn rss_mib(&mut self) -> Option<f64> {
        if self.exit_status().is_some() {
            return None;
        }
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        Some(proc_kib(&status, "VmRSS:")? as f64 / 1024.0)
    }

    /// How the process ended, and its error or the last lines of its log, as one message.
    pub fn exit_report(&mut self) -> String {
        let status = self.wait_until(Instant::now(), || false);
        let how = match status.map(|it| (it.code(), it.signal())) {
            None => "is still running".into(),
            Some((Some(code), _)) => format!("exited with code {code}"),
            Some((None, Some(signal))) => {
                let name = Signal::try_from(signal).map_or("", Signal::as_str);
                format!("was killed by signal {signal} {name}")
            }
            Some((None, None)) => "exited".into(),
        };
        let log = self.log.as_ref().map_or(String::new(), |log| {
            format!(" (log: {}){}", log.path.display(), log.last_lines())
        });
        format!("{} {how}{log}", self.name)
    }
}

impl Drop for ManagedProcess {
    fn drop(&mut self) {
        self.kill();
        // The exit status is missing if the kernel cannot end the process, for example because a driver hangs.
        let end = self.wait_until(Instant::now() + KILLED_MAX, || false);
        if end.is_none() {
            tracing::warn!("{} (process {}) does not exit", self.name, self.child.id());
        }
    }
}

/// Whether a process exited because its run is over or because it was asked to stop.
pub(crate) fn is_orderly_exit(status: ExitStatus) -> bool {
    status.success() || status.code() == Some(EXIT_INTERRUPTED.into())
}

/// Waits for processes to end, after SIGTERM to each if `send_sigterm`. Kills those that do not end in time, or when `now` is raised, and
/// reports failures. A process that dies of a SIGTERM before it listens for signals has not failed: it has nothing to save.
pub fn stop_processes<'a>(
    processes: impl IntoIterator<Item = &'a mut ManagedProcess>,
    send_sigterm: bool,
    drain_max: Duration,
    now: &Shutdown,
) -> Vec<String> {
    let mut processes: Vec<_> = processes.into_iter().collect();
    if send_sigterm {
        processes.iter_mut().for_each(|it| it.ask_to_stop());
    }
    let deadline = Instant::now() + drain_max;
    let mut failures = Vec::new();
    for process in processes {
        match process.wait_until(deadline, || now.is_set()) {
            Some(status) if is_orderly_exit(status) => {}
            Some(status) if send_sigterm && status.signal() == Some(Signal::SIGTERM as i32) => {}
            Some(_) => failures.push(process.exit_report()),
            None => {
                if !now.is_set() {
                    failures.push(format!(
                        "{} did not exit within {} and was killed",
                        process.name,
                        duration(drain_max)
                    ));
                }
                process.kill();
                process.wait_until(Instant::now() + KILLED_MAX, || false);
            }
        }
    }
    failures
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_that_dies_of_the_request_to_stop_has_stopped() {
        let logs = tempfile::tempdir().unwrap();
        let stopped = |script: &str, ask| {
            let mut command = Command::new("sh");
            command.args(["-c", script]).stdin(Stdio::null());
            let screen = Screen::default();
            let started = ManagedProcess::start("script", command, logs.path(), &screen);
            let mut process = started.unwrap();
            let max = Duration::from_secs(60);
            stop_processes([&mut process], ask, max, &Shutdown::default())
        };
        assert_eq!(stopped("exec sleep 600", true), [] as [String; 0]);
        let killed = stopped("kill -TERM $$", false);
        assert!(killed[0].contains("signal 15 SIGTERM"), "{killed:?}");
        let failed = stopped("echo 'error: no room' >&2; exit 3", false);
        let ends = ("script exited with code 3", ".log): no room");
        let is_told = failed[0].starts_with(ends.0) && failed[0].ends_with(ends.1);
        assert!(is_told, "{failed:?}");
    }
}
