//! Starts a world's process, exchanges messages with it under a time-out, and ends it with all processes that it started.
//! It does not know the protocol.

use std::collections::VecDeque;
use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use tracing::Level;

use crate::error::EnvError;

const SHELL: &str = "/bin/sh";

/// The guard's script: waits until the actor is gone, however it ended, and kills the process group, including itself.
const GUARD: &str = "read -r line; sleep 1; kill -KILL 0";

/// The most lines of stderr that an error quotes.
const STDERR_TAIL_MAX: usize = 12;

/// The most lines of stderr that are logged per second; the log then says how many were left out.
const LOG_LINES_PER_SECOND_MAX: usize = 50;

/// The most characters of such a line; the rest is cut off.
const LINE_CHARS_MAX: usize = 400;

/// The most bytes of a line that declares a world; a longer line is cut off, and so invalid. Limits lines of stderr too.
const LINE_BYTES_MAX: usize = 64 * 1024;

/// How long a process may take to end once its stdin is closed, or once it closed its stdout.
const EXIT_WAIT_MAX: Duration = Duration::from_secs(2);

/// How often to check whether a process that does not reply still exists.
const POLL_MAX: Duration = Duration::from_millis(500);

/// How often to check whether a process has ended, once it should.
const EXIT_CHECK_INTERVAL: Duration = Duration::from_millis(5);

/// The current exchange with a process: its description in errors, and its time-out.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exchange {
    /// The description, such as "in the middle of a step".
    pub(super) doing: &'static str,
    /// The time-out of each reply.
    pub(super) timeout: Duration,
    pub(super) timeout_setting: &'static str,
}

/// A world's process, with its guard.
///
/// The guard leads a process group that both belong to. What the command starts ends with the group, unless it leaves the group.
pub(super) struct WorldProcess {
    command: String,
    pub(super) exchange: Exchange,
    guard: Child,
    child: Child,
    /// The process's stdin; `None` once the process was told to end.
    stdin: Option<ChildStdin>,
    stdout: ChildStdout,
    stderr_tail: Arc<Mutex<VecDeque<String>>>,
    /// Disconnected once stderr has ended.
    stderr_closed: Receiver<()>,
}

impl WorldProcess {
    /// Starts the command for a first exchange, and logs its stderr at `level`.
    pub(super) fn start(command: &str, exchange: Exchange, level: Level) -> io::Result<Self> {
        let mut guard = Command::new(SHELL)
            .args(["-c", GUARD])
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .process_group(0)
            .spawn()?;
        let started = Command::new(SHELL)
            .args(["-c", command])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(guard.id() as i32)
            .spawn();
        let mut child = match started {
            Ok(child) => child,
            Err(e) => {
                guard.kill()?;
                guard.wait()?;
                return Err(e);
            }
        };
        let pipe = "it was asked for as a pipe";
        let (stdin, stdout) = (child.stdin.take(), child.stdout.take().expect(pipe));
        let stderr_tail = Arc::new(Mutex::new(VecDeque::new()));
        let (stderr_open, stderr_closed) = channel();
        let (stderr, log) = (child.stderr.take().expect(pipe), Arc::clone(&stderr_tail));
        let builder = thread::Builder::new().name("world-stderr".into());
        builder.spawn(move || {
            log_stderr(BufReader::new(stderr), &log, |text| match level {
                Level::INFO => tracing::info!("world: {text}"),
                _ => tracing::debug!("world: {text}"),
            });
            // Disconnects `stderr_closed`.
            drop(stderr_open);
        })?;
        Ok(Self {
            command: command.into(),
            exchange,
            guard,
            child,
            stdin,
            stdout,
            stderr_tail,
            stderr_closed,
        })
    }

    /// Writes to the process. A closed pipe is not reported here but when the reply is read, as a reply may precede the end.
    pub(super) fn write(&mut self, text: &str) -> Result<(), EnvError> {
        let stdin = self.stdin.as_mut();
        match stdin.map_or(Ok(()), |it| it.write_all(text.as_bytes())) {
            Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(self.io_error(&e)),
            _ => Ok(()),
        }
    }

    /// Writes to a process that has sent all its replies; any more output is an error.
    pub(super) fn request(&mut self, text: &str) -> Result<(), EnvError> {
        let mut polled = [PollFd::new(self.stdout.as_fd(), PollFlags::POLLIN)];
        // If `poll` fails, so does reading the reply. A closed stdout has nothing to read, and reading the reply reports it.
        let _ = poll(&mut polled, PollTimeout::ZERO);
        let found = polled[0].revents();
        if found.is_some_and(|it| it.contains(PollFlags::POLLIN)) {
            let why = "wrote to stdout between two steps: print to stderr instead";
            return Err(self.error(why));
        }
        self.write(text)
    }

    pub(super) fn read_line(&mut self) -> Result<Vec<u8>, EnvError> {
        let (mut left, mut line) = (self.exchange.timeout, Vec::new());
        loop {
            // Reads a byte at a time, as later bytes do not belong to the line.
            match self.read_byte_within(&mut left)? {
                b'\n' => return Ok(line),
                _ if line.len() == LINE_BYTES_MAX => return Ok(line),
                byte => line.push(byte),
            }
        }
    }

    pub(super) fn read_byte(&mut self) -> Result<u8, EnvError> {
        let mut left = self.exchange.timeout;
        self.read_byte_within(&mut left)
    }

    /// Reads a byte within the time `left`, and takes the time that this took from it.
    fn read_byte_within(&mut self, left: &mut Duration) -> Result<u8, EnvError> {
        let mut byte = [0];
        match self.read_within(&mut byte, left) {
            Ok(0) => Err(self.exit_error()),
            Ok(_) => Ok(byte[0]),
            Err(e) if e.kind() == ErrorKind::TimedOut => {
                self.kill();
                let (doing, setting) = (self.exchange.doing, self.exchange.timeout_setting);
                let seconds = self.exchange.timeout.as_secs_f64();
                Err(self.dead_error(&format!(
                    "has not answered for {seconds} s {doing}, and was killed: if it needs longer, --set {setting}=N"
                )))
            }
            Err(source) => Err(self.io_error(&source)),
        }
    }

    fn read_within(&mut self, bytes: &mut [u8], left: &mut Duration) -> io::Result<usize> {
        loop {
            let (began, wait) = (Instant::now(), POLL_MAX.min(*left));
            let timeout = PollTimeout::try_from(wait).unwrap_or(PollTimeout::ZERO);
            let mut polled = [PollFd::new(self.stdout.as_fd(), PollFlags::POLLIN)];
            let found = poll(&mut polled, timeout);
            // The time in which this process was stopped does not count: the world may have been stopped too.
            *left -= wait.min(began.elapsed());
            match found {
                // The process has ended; one that it started may still hold its stdout open.
                Ok(0) if matches!(self.child.try_wait(), Ok(Some(_))) => return Ok(0),
                Ok(0) if left.is_zero() => return Err(ErrorKind::TimedOut.into()),
                Ok(0) | Err(nix::errno::Errno::EINTR) => {}
                Ok(_) => return self.stdout.read(bytes),
                Err(e) => return Err(e.into()),
            }
        }
    }

    /// Kills what is left of a process that has ended, and returns the error that says so.
    fn exit_error(&mut self) -> EnvError {
        self.stdin = None;
        let doing = self.exchange.doing;
        let how = match self.wait_for_exit(EXIT_WAIT_MAX) {
            Some(status) => format!("ended {doing} ({})", describe_status(status)),
            None => format!("closed its stdout {doing} without exiting, and was killed"),
        };
        self.kill();
        self.dead_error(&how)
    }

    /// Returns the error of a dead process, after waiting for the rest of its stderr.
    fn dead_error(&self, how: &str) -> EnvError {
        // Nothing is sent on this channel: this waits until it is disconnected.
        let _ = self.stderr_closed.recv_timeout(EXIT_WAIT_MAX);
        self.error(how)
    }

    /// Returns the error `how`, with the last lines of the process's stderr.
    pub(super) fn error(&self, how: &str) -> EnvError {
        let tail = self.stderr_tail.lock();
        let tail = tail.unwrap_or_else(PoisonError::into_inner);
        let tail: String = tail.iter().map(|line| format!("\n  {line}")).collect();
        let tail = match tail.is_empty() {
            true => tail,
            false => format!(". Its last output:{tail}"),
        };
        EnvError::Exec(format!("the world `{}` {how}{tail}", self.command))
    }

    pub(super) fn io_error(&self, source: &io::Error) -> EnvError {
        let doing = self.exchange.doing;
        self.error(&format!("cannot be used: {doing}: {source}"))
    }

    fn wait_for_exit(&mut self, wait_max: Duration) -> Option<ExitStatus> {
        let deadline = Instant::now() + wait_max;
        loop {
            match self.child.try_wait() {
                Ok(Some(status)) => return Some(status),
                Ok(None) if Instant::now() < deadline => thread::sleep(EXIT_CHECK_INTERVAL),
                Ok(None) | Err(_) => return None,
            }
        }
    }

    /// Kills the process, what it started, and the guard; waits for the process and the guard to end.
    fn kill(&mut self) {
        // The process may lead another group, as `timeout` does.
        for process in [&mut self.guard, &mut self.child] {
            if matches!(process.try_wait(), Ok(Some(_))) {
                continue;
            }
            // This fails for a process that leads no group.
            let _ = killpg(Pid::from_raw(process.id() as i32), Signal::SIGKILL);
            if let Err(e) = process.kill() {
                tracing::debug!("killing the world `{}`: {e}", self.command);
            }
        }
        for process in [&mut self.child, &mut self.guard] {
            if let Err(e) = process.wait() {
                tracing::debug!("waiting for the end of the world `{}`: {e}", self.command);
            }
        }
    }
}

impl Drop for WorldProcess {
    fn drop(&mut self) {
        self.stdin = None;
        self.wait_for_exit(EXIT_WAIT_MAX);
        self.kill();
    }
}

fn describe_status(status: ExitStatus) -> String {
    match status.code() {
        Some(127) => "exit status 127: the shell found no such command".into(),
        _ => status.to_string(),
    }
}

/// Logs the lines of a world's stderr, up to the limit per second, and keeps the last ones in `tail`.
pub(super) fn log_stderr(
    mut stderr: impl BufRead,
    tail: &Mutex<VecDeque<String>>,
    mut log: impl FnMut(&str),
) {
    let mut line = Vec::new();
    let (mut began, mut lines) = (Instant::now(), 0);
    loop {
        line.clear();
        let mut rest = (&mut stderr).take(LINE_BYTES_MAX as u64);
        let has_ended = !matches!(rest.read_until(b'\n', &mut line), Ok(1..));
        if has_ended || began.elapsed() >= Duration::from_secs(1) {
            let more = usize::saturating_sub(lines, LOG_LINES_PER_SECOND_MAX);
            if more > 0 {
                log(&format!("{more} more lines left out"));
            }
            (began, lines) = (Instant::now(), 0);
        }
        if has_ended {
            return;
        }
        let text = String::from_utf8_lossy(&line);
        let text: String = text.trim_end().chars().take(LINE_CHARS_MAX).collect();
        if text.is_empty() {
            continue;
        }
        lines += 1;
        if lines <= LOG_LINES_PER_SECOND_MAX {
            log(&text);
        }
        let mut tail = tail.lock().unwrap_or_else(PoisonError::into_inner);
        if tail.len() == STDERR_TAIL_MAX {
            tail.pop_front();
        }
        tail.push_back(text);
    }
}
