//! The output of a child process: each line goes to its log file, warnings and errors also to the screen, and the last lines are kept.
//! On a full disk, lines wait in memory as the rows of a table do.

use std::{
    collections::VecDeque,
    io::{BufRead, BufReader, Read},
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
    thread::JoinHandle,
};

use anyhow::Context;
use driml_protocol::{fail_point, lock, spawn};

use crate::{console::Screen, run_folder::AppendLog};

/// How many of the last lines are kept, to be shown if the process fails.
const TAIL_LINES_MAX: usize = 8;
/// Lines kept in memory while the file cannot be written; each new line makes another attempt to write all of them.
const WAITING_MAX: usize = 1000;

#[derive(Debug)]
pub(crate) struct ProcessLog {
    name: String,
    pub(crate) path: PathBuf,
    state: Arc<Mutex<LogState>>,
    threads: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct LogState {
    file: AppendLog,
    /// The last lines. They begin with the error line with which the process ended, if there is one: its causes may take several lines.
    tail: VecDeque<String>,
}

impl ProcessLog {
    /// Opens the log in the folder `logs`, which is made if it is missing.
    pub(crate) fn open(name: &str, logs: &Path) -> anyhow::Result<Self> {
        std::fs::create_dir_all(logs).with_context(|| format!("making {}", logs.display()))?;
        let path = logs.join(format!("{name}.log"));
        let state = LogState {
            file: AppendLog::open(&path, format!("the log of {name}"), "line", WAITING_MAX)?,
            tail: VecDeque::new(),
        };
        Ok(Self {
            name: name.into(),
            path,
            state: Arc::new(Mutex::new(state)),
            threads: Vec::new(),
        })
    }

    /// Copies what comes through `pipe`, on a separate thread, until the other end is closed.
    pub(crate) fn follow(
        &mut self,
        pipe: impl Read + Send + 'static,
        screen: &Screen,
    ) -> anyhow::Result<()> {
        let (name, state, screen) = (self.name.clone(), self.state.clone(), screen.clone());
        let copy_lines = move || {
            let point = format!("log of {name}");
            for line in BufReader::new(pipe).split(b'\n') {
                fail_point::reach(&point);
                let Ok(line) = line else { return };
                let line = String::from_utf8_lossy(&line).into_owned();
                let shown = is_warning(&line).then(|| format!("{name}: {line}"));
                let said = lock(&state).add(line);
                screen.print_lines(shown.into_iter().chain(said));
            }
        };
        let thread = spawn(format!("log of {}", self.name), copy_lines);
        self.threads.push(thread.context("starting a thread")?);
        Ok(())
    }

    /// The error with which the process ended, if it printed one, or else its last lines.
    pub(crate) fn last_lines(&self) -> String {
        let state = lock(&self.state);
        let lines = state.tail.iter().map(|line| format!("\n  {line}"));
        let lines: String = lines.collect();
        match lines.strip_prefix("\n  error: ") {
            // The error and the lines after it say everything.
            Some(error) => format!(": {error}"),
            None if lines.is_empty() => String::new(),
            None => format!("; its last lines:{lines}"),
        }
    }

    /// How many lines could not be written, and why; none if all were written.
    pub(crate) fn loss_message(&self) -> Option<String> {
        lock(&self.state).file.loss_message()
    }

    /// Waits until everything that the process wrote is in the log. The process must have ended, and no other process may hold the
    /// other ends of the pipes.
    pub(crate) fn finish(&mut self) {
        for thread in self.threads.drain(..) {
            thread.join().expect("a panic has ended the process");
        }
    }
}

impl LogState {
    /// Adds a line. Returns a warning the first time that a line cannot be written.
    fn add(&mut self, line: String) -> Option<String> {
        let warning = self.file.add([format!("{line}\n").into_bytes()]);
        let is_error = |line: &String| line.starts_with("error: ");
        if is_error(&line) {
            self.tail.clear();
        } else if self.tail.len() == TAIL_LINES_MAX {
            // The error line stays.
            let oldest = usize::from(self.tail.front().is_some_and(is_error));
            self.tail.remove(oldest);
        }
        self.tail.push_back(line);
        warning
    }
}

/// Whether a log line is a warning or an error: the level is the second word, after the time. The `error:` line with which a process
/// ends does not count, as the exit report contains it.
fn is_warning(line: &str) -> bool {
    matches!(line.split_whitespace().nth(1), Some("WARN" | "ERROR"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_and_worse_reach_the_screen() {
        for (is_one, line) in [
            (true, "2026-01-01T00:00:00.1Z  WARN driml_actor: rejected"),
            (true, "2026-01-01T00:00:00.1Z ERROR driml_actor: gone"),
            (false, "error: it is in the exit report"),
            (false, "2026-01-01T00:00:00.1Z  INFO driml_actor: an ERROR"),
            (false, ""),
        ] {
            assert_eq!(is_warning(line), is_one, "{line}");
        }
    }

    #[test]
    fn a_log_keeps_its_last_lines() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = ProcessLog::open("actor-0", folder.path()).unwrap();
        let lines: String = (0..10).map(|n| format!("line {n}\n")).collect();
        let screen = Screen::default();
        log.follow(std::io::Cursor::new(lines.clone()), &screen)
            .unwrap();
        log.finish();
        assert_eq!(std::fs::read_to_string(&log.path).unwrap(), lines);
        let said = log.last_lines();
        assert!(said.starts_with("; its last lines:\n  line 2\n") && said.ends_with("line 9"));
        assert_eq!(log.loss_message(), None);
        for line in ["error: it failed. Its last words:", "no", "more"] {
            lock(&log.state).add(line.into());
        }
        let error = ": it failed. Its last words:\n";
        assert_eq!(log.last_lines(), format!("{error}  no\n  more"));
        for n in 0..10 {
            lock(&log.state).add(format!("line {n}"));
        }
        let said = log.last_lines();
        assert!(said.starts_with(&format!("{error}  line 3\n")), "{said}");
    }
}
