//! A panic in any thread ends the process: one that goes on without one of its threads looks alive and no longer does its work.
//! Nothing in this program catches a panic.

use std::{
    backtrace::{Backtrace, BacktraceStatus},
    panic::PanicHookInfo,
    sync::OnceLock,
    thread::ThreadId,
};

/// The thread that ends the process, once it has decided how.
static ENDING: OnceLock<ThreadId> = OnceLock::new();

/// Makes every panic say thread, place and message on stderr in one line, and then abort the process.
///
/// The launcher shows that line and says which process it was; processes whose launcher aborts end in order.
pub fn end_the_process() {
    std::panic::set_hook(Box::new(|panic| {
        if ENDING
            .get()
            .is_some_and(|it| *it != std::thread::current().id())
        {
            #[cfg(test)]
            tests::STOPPED.store(true, std::sync::atomic::Ordering::Release);
            loop {
                std::thread::park();
            }
        }
        say(&line(panic, std::thread::current().name()));
        let trace = Backtrace::capture();
        if trace.status() == BacktraceStatus::Captured {
            say(&trace.to_string());
        }
        std::process::abort();
    }));
}

/// Says that this thread now ends the process, and with which code is decided.
///
/// While it does, what a library keeps for the whole process is taken down: a thread of the library's own that still looks at it
/// panics (zenoh's shared memory does so). That changes nothing any more, so such a thread is stopped without a word.
pub fn process_ends() {
    ENDING.get_or_init(|| std::thread::current().id());
}

/// Writes without the lock of `std::io::stderr`, which another thread may hold for ever, and without a buffer.
fn say(text: &str) {
    // Nothing is left to be done if stderr is gone.
    let _ = nix::unistd::write(std::io::stderr(), format!("{text}\n").as_bytes());
}

fn line(panic: &PanicHookInfo<'_>, thread: Option<&str>) -> String {
    let message = panic.payload();
    let message = message
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| message.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message");
    // What `assert_eq!` says takes several lines.
    let message: Vec<_> = message.lines().map(str::trim).collect();
    let place = panic
        .location()
        .map_or(String::new(), |it| format!(" at {it}"));
    format!(
        "error: the thread {} panicked{place}: {}; this is a fault of the program, which ends here",
        thread.unwrap_or("without a name"),
        message.join("; ")
    )
}

#[cfg(test)]
mod tests {
    use std::{
        os::unix::process::ExitStatusExt,
        process::Command,
        sync::atomic::{AtomicBool, Ordering},
        time::{Duration, Instant},
    };

    use super::*;

    /// A thread that panicked was stopped.
    pub(super) static STOPPED: AtomicBool = AtomicBool::new(false);

    /// Set where this test is the process that panics, to what it says before.
    const CHILD: &str = "DRIML_TEST_PANICS";

    #[test]
    fn a_panic_while_the_process_ends_does_not_change_how() {
        if let Ok(says) = std::env::var(CHILD) {
            end_the_process();
            if says == "ends" {
                process_ends();
            }
            let thread = std::thread::spawn(|| panic!("too late"));
            let started = Instant::now();
            while says == "ends" && started.elapsed() < Duration::from_secs(60) {
                if STOPPED.load(Ordering::Acquire) {
                    std::process::exit(3);
                }
                std::thread::yield_now();
            }
            // A backtrace may take longer.
            let _ = thread.join();
            std::process::exit(4);
        }
        let child = |says: &str| {
            let name = "panics::tests::a_panic_while_the_process_ends_does_not_change_how";
            let mut command = Command::new(std::env::current_exe().unwrap());
            command
                .args(["--exact", name, "--nocapture"])
                .env(CHILD, says);
            let ended = command.output().unwrap();
            let stderr = String::from_utf8(ended.stderr).unwrap();
            (ended.status, stderr.contains("panicked at"))
        };
        let (status, said) = child("ends");
        assert_eq!((status.code(), said), (Some(3), false));
        let (status, said) = child("goes on");
        assert_eq!((status.signal(), said), (Some(6), true));
    }
}
