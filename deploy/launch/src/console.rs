//! Everything that this program writes to stdout and stderr: messages, the log, progress bars, results.
//! A closed terminal or pipe is not an error in this module; `driml_protocol::Shutdown` notices it.

use std::{
    collections::BTreeMap,
    fmt,
    io::{self, ErrorKind, IsTerminal, Write, stderr},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use anyhow::Context as _;
use console::Term;
use driml_machine::units::count;
use driml_protocol::{LogLimiter, last_warning, lock};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing::{Event, Level, Metadata, Subscriber, field::Field};
use tracing_subscriber::{
    EnvFilter, Layer, Registry,
    filter::{FilterExt, dynamic_filter_fn},
    layer::{Context as LayerContext, SubscriberExt},
    util::SubscriberInitExt,
};

const DRAWS_PER_SECOND: u8 = 20;
/// How often progress is printed as a plain line without a progress bar.
const PLAIN_PERIOD: Duration = Duration::from_secs(10);

/// Writes a line to stderr, wrapped at words on a terminal. A line that cannot be written is dropped, as the run continues after a closed
/// pipe or on a full disk.
pub fn eprintln(text: &str) {
    // A single write, so that lines of several threads do not mix.
    let _ = stderr().write_all(format!("{}\n", wrap(text, " ", 2)).as_bytes());
}

/// Writes a command's result to stdout; a closed pipe is not an error.
pub fn print(text: &str) -> anyhow::Result<()> {
    print_unless_closed(text).map(drop)
}

/// [`print`] that returns false if the pipe is closed.
pub(crate) fn print_unless_closed(text: &str) -> anyhow::Result<bool> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if !is_closed(&e) => Err(e).context("writing to stdout"),
        written => Ok(written.is_ok()),
    }
}

/// [`print_unless_closed`] for a page. On a terminal the page replaces the one before; elsewhere pages follow each other.
pub(crate) fn print_page(text: &str) -> anyhow::Result<bool> {
    if io::stdout().is_terminal() {
        // If this fails, so does the printing.
        let _ = Term::stdout().clear_screen();
    }
    print_unless_closed(text)
}

/// [`print`] for lines that a narrow terminal would break inside words: a wrapped line continues after `indent` blanks.
pub fn print_wrapped(text: &str, indent: usize) -> anyhow::Result<()> {
    match io::stdout().is_terminal() {
        true => print(&wrap(text, " ", indent)),
        false => print(text),
    }
}

/// Breaks the lines of `text` at `separator`, so that no line is wider than the terminal where that is possible. A wrapped line
/// continues after `indent` blanks.
pub fn wrap(text: &str, separator: &str, indent: usize) -> String {
    let size = Term::stderr().size_checked();
    let width = size.map_or(usize::MAX, |it| it.1.into());
    wrap_to(text, separator, indent, width)
}

/// The columns of a page on stdout: 80, or those of a narrower terminal.
pub(crate) fn page_width() -> usize {
    let size = Term::stdout().size_checked();
    size.map_or(80, |it| usize::from(it.1).min(80))
}

/// [`wrap`] to a width in characters. A break leaves no blanks at the end of its line.
pub(crate) fn wrap_to(text: &str, separator: &str, indent: usize, width: usize) -> String {
    let mut lines = String::new();
    for line in text.split_inclusive('\n') {
        let mut column = 0;
        for (number, word) in line.split(separator).enumerate() {
            let length = word.trim_end_matches('\n').chars().count();
            if number > 0 && column + separator.len() + length > width {
                lines.truncate(lines.trim_end_matches(' ').len());
                lines.push('\n');
                lines.extend(std::iter::repeat_n(' ', indent));
                column = indent;
            } else if number > 0 {
                lines.push_str(separator);
                column += separator.len();
            }
            lines.push_str(word);
            column += length;
        }
    }
    lines
}

/// Formats rows as lines with aligned columns: to the right for the columns in `right`, to the left for all others.
pub fn align_columns(rows: &[Vec<String>], right: &[usize]) -> String {
    let width_of = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let cell = |(column, cell): (usize, &String)| {
        let width = width_of(column);
        match right.contains(&column) {
            true => format!("{cell:>width$}"),
            false => format!("{cell:<width$}"),
        }
    };
    let line = |row: &Vec<String>| {
        let line: Vec<_> = row.iter().enumerate().map(cell).collect();
        format!("{}\n", line.join("  ").trim_end())
    };
    rows.iter().map(line).collect()
}

/// Whether writing failed because the pipe's reader has exited or the terminal was closed.
fn is_closed(e: &io::Error) -> bool {
    e.kind() == ErrorKind::BrokenPipe || e.raw_os_error() == Some(nix::libc::EIO)
}

/// Formats an error with its causes, each once: the text of many errors already contains their cause.
pub fn describe_error(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        if text.is_empty() {
            text = cause;
        } else if !text.ends_with(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

/// Joins lines of the form `lost WHAT: WHY` that have the same cause into one. Other lines come first, unchanged.
pub(crate) fn join_losses(lines: impl IntoIterator<Item = String>) -> Vec<String> {
    let mut by_cause = BTreeMap::<String, Vec<String>>::new();
    let mut joined = Vec::new();
    for line in lines {
        let lost = line.strip_prefix("lost ");
        match lost.and_then(|it| it.split_once(": ")) {
            Some((what, why)) => by_cause.entry(why.into()).or_default().push(what.into()),
            None => joined.push(line),
        }
    }
    let lost = by_cause.iter();
    joined.extend(lost.map(|(why, what)| format!("lost {}: {why}", what.join(", "))));
    joined
}

/// The log filter for zenoh and quinn, at any level of driml's own crates.
///
/// zenoh warns of each failed attempt to reach an absent process, which driml judges itself, so only zenoh's errors are logged. Some
/// are off too. Its session reports messages that arrive while it closes, as at the end of every run. Its handlers report replies
/// that are not wanted any more. The only error of its token module, `Unknown token`, comes up now and then over QUIC: a process that
/// leaves drops its liveliness token while its link closes. quinn's warnings are off. Warnings of zenoh's QUIC link stay: they name
/// rejected connections, of which the other side learns only that they failed.
const THIRD_PARTY_FILTER: &str = "zenoh=error,zenoh::api::session=off,zenoh::api::handlers=off,\
                         zenoh::net::routing::hat::broker::token=off,zenoh_link_commons::quic=warn,quinn=error";

fn default_filter(level: &str) -> String {
    format!("warn,driml={level},{THIRD_PARTY_FILTER}")
}

/// The log filter for a value of `DRIML_LOG`. A level alone applies to driml's own crates only, as zenoh's lines would bury theirs.
/// Any other value is used unchanged: `off`, for example, applies to everything.
fn filter_for(wanted: &str) -> String {
    let level = wanted.trim().to_ascii_lowercase();
    match level.as_str() {
        "trace" | "debug" | "info" | "warn" | "error" => default_filter(&level),
        _ => wanted.to_owned(),
    }
}

/// Sends the log to stderr. `DRIML_LOG` sets what is logged: a level for driml's own crates, or a filter in the syntax of `RUST_LOG`.
pub fn log_to_stderr() {
    let default = || EnvFilter::new(default_filter("info"));
    let wanted = std::env::var("DRIML_LOG").ok().filter(|it| !it.is_empty());
    let is_debugged = wanted.is_some();
    let filter = wanted.map_or_else(default, |wanted| {
        EnvFilter::try_new(filter_for(&wanted)).unwrap_or_else(|e| {
            eprintln(&format!(
                "DRIML_LOG={wanted} is not a filter ({e}) and is ignored; use for example debug"
            ));
            default()
        })
    });
    // A client without a certificate may try to connect ten times a second.
    let rejections = Mutex::new(LogLimiter::default());
    let rare = dynamic_filter_fn(move |it: &Metadata<'_>, _: &LayerContext<'_, Registry>| {
        let is_rejection =
            it.target().starts_with("zenoh_link_commons::quic") && *it.level() <= Level::WARN;
        !is_rejection || lock(&rejections).admit().is_some()
    });
    let log = tracing_subscriber::fmt::layer()
        .with_writer(|| LogWriter)
        // It would report a stderr that cannot be written to with `eprintln!`, which panics then.
        .log_internal_errors(false)
        .with_ansi(stderr().is_terminal())
        // Module paths are for debugging only.
        .with_target(is_debugged)
        .with_filter(filter.clone().and(rare.with_max_level_hint(Level::TRACE)));
    tracing_subscriber::registry()
        .with(log)
        .with(LastWarning.with_filter(filter))
        .init();
}

/// Cuts off what zenoh adds to a rejected QUIC connection: the place in its sources, and a hint that is false, as all share one socket.
fn without_place(text: &str) -> String {
    let said = text.split(" at /").next();
    let said = said.filter(|it| it.contains("QUIC acceptor failed"));
    let cut = |it: &str| it.trim_end().to_owned() + &text[text.trim_end().len()..];
    said.map_or_else(|| text.to_owned(), cut)
}

/// Writes the log to stderr, a line per call.
struct LogWriter;

impl Write for LogWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let text = without_place(&String::from_utf8_lossy(line));
        stderr().write_all(text.as_bytes()).map(|()| line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        stderr().flush()
    }
}

/// A log layer that keeps the last warning or error, which this process reports in its status.
struct LastWarning;

impl<S: Subscriber> Layer<S> for LastWarning {
    fn on_event(&self, event: &Event<'_>, _: LayerContext<'_, S>) {
        if *event.metadata().level() <= Level::WARN {
            let mut text = String::new();
            event.record(&mut |field: &Field, value: &dyn fmt::Debug| {
                if field.name() == "message" {
                    text = without_place(&format!("{value:?}"));
                }
            });
            last_warning::set(text);
        }
    }
}

/// For how long one line about a full disk stands for the lines of all processes and files.
const FULL_DISK_PERIOD: Duration = Duration::from_secs(600);
/// The texts of the system's errors about a full disk.
const FULL_DISK_CAUSES: [&str; 2] = ["No space left on device", "Disk quota exceeded"];

/// Where messages go: stderr, above a progress bar if there is one and stderr is a terminal. Clones share the bar, but each
/// has a separate time of its next plain line.
#[derive(Clone, Debug, Default)]
pub struct Screen {
    bar: Option<ProgressBar>,
    full_disk: Arc<Mutex<LogLimiter>>,
    next_plain_line: Option<Instant>,
}

impl Screen {
    /// A screen with a progress bar of this length and `template` on a terminal, and without a bar elsewhere.
    ///
    /// # Panics
    /// The template is invalid. Templates are constants, and a test makes each.
    pub fn new(length: u64, template: &str) -> Self {
        let target = ProgressDrawTarget::stderr_with_hz(DRAWS_PER_SECOND);
        let bar = (!target.is_hidden()).then(|| {
            let style = ProgressStyle::with_template(template);
            let style = style.expect("the template is a constant, and a test makes one");
            ProgressBar::with_draw_target(Some(length), target).with_style(style)
        });
        Self {
            bar,
            next_plain_line: Some(Instant::now() + PLAIN_PERIOD),
            ..Self::default()
        }
    }

    /// The progress bar, if there is one.
    pub const fn bar(&self) -> Option<&ProgressBar> {
        self.bar.as_ref()
    }

    /// Writes one line. A line about a full disk is left out if another one was written less than ten minutes ago.
    pub fn print_line(&self, text: &str) {
        let is_full = FULL_DISK_CAUSES.iter().any(|it| text.contains(it));
        let admitted = || lock(&self.full_disk).admit_within(FULL_DISK_PERIOD);
        if is_full && admitted().is_none() {
            return;
        }
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln(text)),
            None => eprintln(text),
        }
    }

    pub(crate) fn print_lines(&self, lines: impl IntoIterator<Item = String>) {
        lines.into_iter().for_each(|it| self.print_line(&it));
    }

    /// Shows progress beside the bar, or every ten seconds in a plain line. The argument of `text` is true for text beside the bar.
    pub fn show(&mut self, position: u64, text: impl FnOnce(bool) -> String) {
        let now = Instant::now();
        if let Some(bar) = &self.bar {
            bar.set_position(position);
            bar.set_message(text(true));
            // The cursor is now behind the bar, where a terminal shows `^C` in a line that removing the bar does not count.
            let _ = stderr().write_all(b"\r");
        } else if self.next_plain_line.is_none_or(|next| now >= next) {
            self.next_plain_line = Some(now + PLAIN_PERIOD);
            self.print_line(&text(false));
        }
    }

    /// Removes the progress bar, and reports how many lines about a full disk were left out.
    pub fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        let more = lock(&self.full_disk).take_suppressed();
        if more > 0 {
            let more = count(more, "further line");
            eprintln(&format!("left out {more} about the full disk"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_is_said_once() {
        let full = || io::Error::from_raw_os_error(nix::libc::ENOSPC);
        let inner = anyhow::Error::new(full());
        let said = describe_error(&inner.context("writing x").context("saving"));
        assert_eq!(said, format!("saving: writing x: {}", full()));

        #[derive(Debug, thiserror::Error)]
        #[error("cannot write x: {source}")]
        struct NamesItsCause {
            source: io::Error,
        }
        let named = anyhow::Error::new(NamesItsCause { source: full() });
        let said = describe_error(&named.context("saving"));
        assert_eq!(said, format!("saving: cannot write x: {}", full()));
    }

    #[test]
    fn no_word_is_broken_in_a_narrow_terminal() {
        let text = "name    one two three\nx       four\n";
        assert_eq!(wrap_to(text, " ", 8, 80), text);
        let narrow = "name    one two\n        three\nx       four\n";
        assert_eq!(wrap_to(text, " ", 8, 16), narrow);
        let facts = "frames 1 of 2  updates 3 of 4";
        let narrow = "frames 1 of 2\nupdates 3 of 4";
        assert_eq!(wrap_to(facts, "  ", 0, 20), narrow);
    }

    #[test]
    fn a_level_alone_is_for_driml_s_own_crates() {
        for (wanted, driml) in [("debug", "debug"), (" TRACE", "trace"), ("error", "error")] {
            let filter = filter_for(wanted);
            let begins = format!("warn,driml={driml},zenoh=error,");
            assert!(filter.starts_with(&begins), "{filter}");
            assert!(EnvFilter::try_new(&filter).is_ok(), "{filter}");
        }
        for raw in ["off", "debug,zenoh=info", "driml_actor=trace"] {
            assert_eq!(filter_for(raw), raw);
        }
    }

    #[test]
    fn a_full_disk_is_one_line() {
        let screen = Screen::new(1, "{msg}");
        for name in ["a.csv", "b.csv", "c.csv"] {
            screen.print_line(&format!("{name}: No space left on device (os error 28)"));
        }
        screen.print_line("learner is gone");
        assert_eq!(lock(&screen.full_disk).take_suppressed(), 2);

        let lost = "lost 2 rows of a: full\nx\nlost 1 row of b: full";
        let joined = join_losses(lost.lines().map(str::to_owned));
        assert_eq!(joined, ["x", "lost 2 rows of a, 1 row of b: full"]);
    }
}
