//! A panic in any thread ends the process: a process that has lost a thread looks alive but no longer works.
//! Nothing in this program catches a panic.

use std::{
    backtrace::{Backtrace, BacktraceStatus},
    panic::PanicHookInfo,
    sync::OnceLock,
    thread::ThreadId,
};

use driml_machine::limits;

/// The thread that ends the process, set once the exit code is decided.
static ENDING_THREAD: OnceLock<ThreadId> = OnceLock::new();

/// Makes every panic print its thread, place and message on stderr in one line, and then abort the process. For a panic of a library,
/// the line also names the resources of the system that are nearly used up: they may be the cause.
///
/// The launcher shows that line with the name of the process. If a launcher aborts, its processes exit in order.
pub fn abort_on_panic() {
    std::panic::set_hook(Box::new(|panic| {
        let thread = std::thread::current();
        if ENDING_THREAD.get().is_some_and(|it| *it != thread.id()) {
            #[cfg(test)]
            tests::STOPPED.store(true, std::sync::atomic::Ordering::Release);
            loop {
                std::thread::park();
            }
        }
        // The paths of this program's own sources are relative to the root of the repository.
        let scarce = match panic.location() {
            Some(place) if place.file().starts_with('/') => limits::scarce_resources(),
            _ => Vec::new(),
        };
        write_stderr(&panic_line(panic, thread.name(), &scarce));
        let trace = Backtrace::capture();
        if trace.status() == BacktraceStatus::Captured {
            write_stderr(&trace.to_string());
        }
        std::process::abort();
    }));
}

/// Notes that this thread now ends the process, and that the exit code is decided.
///
/// During the exit, libraries destroy their global state. A library's thread that still uses that state panics (zenoh's shared
/// memory does so). That must not change the exit code any more, so the hook parks such a thread silently.
pub fn mark_process_ending() {
    ENDING_THREAD.get_or_init(|| std::thread::current().id());
}

/// Writes without a buffer and without the lock of `std::io::stderr`, which another thread may hold forever.
fn write_stderr(text: &str) {
    // Nothing can be done if stderr is closed.
    let _ = nix::unistd::write(std::io::stderr(), format!("{text}\n").as_bytes());
}

fn panic_line(panic: &PanicHookInfo<'_>, thread: Option<&str>, scarce: &[String]) -> String {
    let message = panic.payload();
    let text = message.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| message.downcast_ref::<&str>().copied());
    let message = text.unwrap_or("without a message");
    // The message of `assert_eq!` has several lines.
    let message: Vec<_> = message.lines().map(str::trim).collect();
    let place = panic.location().map(|it| format!(" at {it}"));
    let place = place.unwrap_or_default();
    let why = match scarce.join("; ") {
        scarce if scarce.is_empty() => "this is a bug in the program, which aborts".to_owned(),
        scarce => format!("the program aborts, and the system is short of this: {scarce}"),
    };
    let (thread, message) = (thread.unwrap_or("without a name"), message.join("; "));
    format!("error: the thread {thread} panicked{place}: {message}; {why}")
}

#[cfg(test)]
mod tests {
    use std::{
        fs::File,
        os::unix::process::ExitStatusExt,
        process::Command,
        sync::atomic::{AtomicBool, Ordering},
        time::{Duration, Instant},
    };

    use zenoh::{Wait, shm::ShmProviderBuilder};

    use super::*;

    pub(super) static STOPPED: AtomicBool = AtomicBool::new(false);

    /// Set in the child process that panics, to the name of the case.
    const CHILD: &str = "DRIML_TEST_PANICS";

    fn panic_in_child(case: &str) -> ! {
        abort_on_panic();
        if case == "library" {
            let pool = ShmProviderBuilder::default_backend(1 << 12).wait().unwrap();
            let open = || File::open("/dev/null").ok();
            let _files: Vec<_> = std::iter::from_fn(open).collect();
            // zenoh makes its metadata with the first allocation.
            let _ = pool.alloc(1).wait();
        }
        if case == "ending" {
            mark_process_ending();
        }
        let thread = std::thread::spawn(|| panic!("too late"));
        let started = Instant::now();
        while case == "ending" && started.elapsed() < Duration::from_secs(60) {
            if STOPPED.load(Ordering::Acquire) {
                std::process::exit(3);
            }
            std::thread::yield_now();
        }
        // A backtrace may take longer.
        let _ = thread.join();
        std::process::exit(4);
    }

    /// A library's panic also names what was scarce. While the process ends, a panic does not change how.
    #[test]
    fn a_panic_aborts_a_process_that_does_not_end_already() {
        if let Ok(case) = std::env::var(CHILD) {
            panic_in_child(&case);
        }
        let scarce = "; the program aborts, and the system is short of this: 60 of at most 60 files are open: raise the limit";
        for (case, code, signal, said) in [
            ("ending", Some(3), None, [""; 2]),
            ("running", None, Some(6), [" panicked at ", ": too late; "]),
            ("library", None, Some(6), ["zenoh-shm", scarce]),
        ] {
            let mut command = Command::new("sh");
            command.args(["-c", "ulimit -n 60 && exec \"$0\" \"$@\""]);
            command.arg(std::env::current_exe().unwrap());
            let name = "panics::tests::a_panic_aborts_a_process_that_does_not_end_already";
            command.args(["--exact", name, "--nocapture"]);
            let ended = command.env(CHILD, case).output().unwrap();
            let status = (ended.status.code(), ended.status.signal());
            assert_eq!(status, (code, signal), "{ended:?}");
            let stderr = String::from_utf8(ended.stderr).unwrap();
            let line = stderr.lines().find(|line| line.starts_with("error: "));
            let line = line.unwrap_or_default();
            assert_eq!(line.is_empty(), said[0].is_empty(), "{stderr}");
            assert!(said.iter().all(|it| line.contains(it)), "{stderr}");
        }
    }
}
