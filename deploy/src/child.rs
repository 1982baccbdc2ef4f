//! One part of a run as a child process: started, watched, logged, asked to stop.
//! It does not know what the parts do or in which order they end.

use std::{
    collections::VecDeque,
    fs::File,
    io::{BufRead, BufReader, Read, Write},
    os::unix::process::{CommandExt, ExitStatusExt},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Arc, Mutex},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_protocol::fault;
use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};

use crate::console::Screen;

/// Last lines of a part's log that are kept to be shown if it fails.
const TAIL_LINES_MAX: usize = 8;
/// How often a part that should end is looked at.
const POLL: Duration = Duration::from_millis(20);

/// A started part.
#[derive(Debug)]
pub(crate) struct Part {
    /// Its name: `replay-server`, `learner`, `actor-0`.
    pub(crate) name: String,
    /// Where its output goes.
    pub(crate) log: PathBuf,
    child: Child,
    end: Option<ExitStatus>,
    tail: Arc<Mutex<VecDeque<String>>>,
    pumps: Vec<JoinHandle<()>>,
}

/// What suits candle in every part: its second pool spins while it waits, which costs more than it gives on busy cores, and
/// glibc returns each large tensor to the system and faults it in again unless told to keep it.
const FOR_CANDLE: [(&str, &str); 3] = [
    ("CANDLE_NUM_THREADS", "1"),
    ("MALLOC_MMAP_THRESHOLD_", "1000000000"),
    ("MALLOC_TRIM_THRESHOLD_", "10000000000"),
];

/// Gives a process the environment of every part, with so many threads for arithmetic.
pub(crate) fn suit_candle(command: &mut Command, threads: u32) {
    command
        .env("RAYON_NUM_THREADS", threads.to_string())
        .envs(FOR_CANDLE);
}

/// Flags for a child that is to end when this process does. They name this process, as it may have died before the child looks
/// who its parent is.
pub(crate) fn exit_with_this_process() -> [String; 2] {
    ["--exit-with-parent".into(), std::process::id().to_string()]
}

impl Part {
    /// Starts this program with other arguments, in a process group of its own so that Ctrl-C does not reach it. It ends when
    /// this process does.
    ///
    /// # Errors
    /// The log cannot be written, or the process not started.
    pub(crate) fn start(
        name: &str,
        args: &[String],
        threads: u32,
        logs: &Path,
        screen: &Screen,
    ) -> anyhow::Result<Self> {
        let log = logs.join(format!("{name}.log"));
        let program = std::env::current_exe().context("finding this program's own file")?;
        let file = File::options().create(true).append(true).open(&log);
        let file = file.with_context(|| format!("making {}", log.display()))?;
        let mut command = Command::new(program);
        suit_candle(&mut command, threads);
        let mut child = command
            .args(args)
            .args(exit_with_this_process())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0)
            .spawn()
            .with_context(|| format!("starting {name}"))?;
        let tail = Arc::new(Mutex::new(VecDeque::new()));
        let file = Arc::new(Mutex::new(file));
        let (out, err) = (child.stdout.take(), child.stderr.take());
        let pipes: [Option<Box<dyn Read + Send>>; 2] = [
            out.map(|pipe| Box::new(pipe) as _),
            err.map(|pipe| Box::new(pipe) as _),
        ];
        let mut part = Self {
            name: name.into(),
            log,
            child,
            end: None,
            tail,
            pumps: Vec::new(),
        };
        for pipe in pipes.into_iter().flatten() {
            let pump = Pump {
                name: name.into(),
                file: file.clone(),
                tail: part.tail.clone(),
                screen: screen.clone(),
            };
            let thread = std::thread::Builder::new().name(format!("log of {name}"));
            part.pumps.push(
                thread
                    .spawn(move || pump.run(pipe))
                    .context("starting a thread")?,
            );
        }
        Ok(part)
    }

    /// The process's number.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// How it ended, if it has.
    pub(crate) fn end(&mut self) -> Option<ExitStatus> {
        if self.end.is_none() {
            // An error here means that there is no such child any more, which cannot be before it was waited for.
            self.end = self.child.try_wait().ok().flatten();
        }
        self.end
    }

    /// Asks it to drain and end.
    pub(crate) fn ask_to_stop(&mut self) {
        self.signal(Signal::SIGTERM);
    }

    /// Ends it at once.
    pub(crate) fn kill(&mut self) {
        self.signal(Signal::SIGKILL);
    }

    fn signal(&mut self, signal: Signal) {
        // Once it was waited for, its number may belong to another process.
        if self.end().is_none() {
            let pid = Pid::from_raw(self.child.id() as i32);
            if let Err(e) = kill(pid, signal) {
                tracing::debug!("sending {signal} to {}: {e}", self.name);
            }
        }
    }

    /// Waits for its end until `deadline`, or until `hurry` says that there is no time for that.
    pub(crate) fn wait_until(
        &mut self,
        deadline: Instant,
        hurry: impl Fn() -> bool,
    ) -> Option<ExitStatus> {
        while self.end().is_none() && Instant::now() < deadline && !hurry() {
            std::thread::sleep(POLL);
        }
        if self.end.is_some() {
            // Nobody else holds the pipes' other ends, so these threads see their end too.
            self.pumps.drain(..).for_each(|pump| drop(pump.join()));
        }
        self.end
    }

    /// Resident memory, MiB; none once it has ended.
    pub(crate) fn rss_mib(&mut self) -> Option<f64> {
        if self.end().is_some() {
            return None;
        }
        rss_mib(&std::fs::read_to_string(format!("/proc/{}/status", self.pid())).ok()?)
    }

    /// How and with which last words it ended, for a person.
    pub(crate) fn obituary(&mut self) -> String {
        self.wait_until(Instant::now(), || false);
        let how = match self.end {
            None => "is still running".into(),
            Some(status) => match (status.code(), status.signal()) {
                (Some(code), _) => format!("ended with exit code {code}"),
                (None, Some(signal)) => {
                    let name = Signal::try_from(signal).map_or("", Signal::as_str);
                    format!("was ended by signal {signal} {name}")
                }
                (None, None) => "ended".into(),
            },
        };
        let tail = self
            .tail
            .lock()
            .expect("no thread panics while holding the lines");
        let lines: String = tail.iter().map(|line| format!("\n  {line}")).collect();
        let last = if lines.is_empty() {
            String::new()
        } else {
            format!("; its last lines:{lines}")
        };
        format!("{} {how} (log: {}){last}", self.name, self.log.display())
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        self.kill();
        let _ = self.child.wait();
    }
}

/// Resident memory in MiB from `/proc/PID/status`.
pub(crate) fn rss_mib(status: &str) -> Option<f64> {
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib / 1024.0)
}

/// Carries a part's output to its log, its warnings and errors to the screen too.
struct Pump {
    name: String,
    file: Arc<Mutex<File>>,
    tail: Arc<Mutex<VecDeque<String>>>,
    screen: Screen,
}

impl Pump {
    fn run(&self, pipe: impl Read) {
        let point = format!("log of {}", self.name);
        for line in BufReader::new(pipe).split(b'\n') {
            fault::point(&point);
            let Ok(line) = line else { return };
            let line = String::from_utf8_lossy(&line).into_owned();
            if let Ok(mut file) = self.file.lock()
                && let Err(e) = writeln!(file, "{line}")
            {
                // A full disk must not stop the run: the line still reaches the screen below if it matters.
                tracing::debug!("the log of {}: {e}", self.name);
            }
            if matters(&line) {
                self.screen.line(&format!("{}: {line}", self.name));
            }
            if let Ok(mut tail) = self.tail.lock() {
                if tail.len() == TAIL_LINES_MAX {
                    tail.pop_front();
                }
                tail.push_back(line);
            }
        }
    }
}

/// Whether a log line is a warning or worse: the level is the second word, after the time.
fn matters(line: &str) -> bool {
    let level = line.split_whitespace().nth(1);
    matches!(level, Some("WARN" | "ERROR"))
        || line.starts_with("error:")
        || line.contains("panicked at")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_and_worse_reach_the_screen() {
        assert!(matters(
            "2026-01-01T00:00:00.1Z  WARN driml_actor: weights were refused"
        ));
        assert!(matters("2026-01-01T00:00:00.1Z ERROR driml_actor: gone"));
        assert!(matters("error: nobody answers"));
        assert!(matters("thread 'main' panicked at src/lib.rs:1:1:"));
        assert!(!matters(
            "2026-01-01T00:00:00.1Z  INFO driml_actor: ERROR is a word here"
        ));
        assert!(!matters(""));
    }

    #[test]
    fn resident_memory_is_read_from_the_kernels_table() {
        assert_eq!(rss_mib("Name:\tdriml\nVmRSS:\t    2048 kB\n"), Some(2.0));
        assert_eq!(rss_mib("Name:\tdriml\n"), None);
    }
}
