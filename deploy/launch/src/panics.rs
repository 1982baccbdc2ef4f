//! A panic in any thread ends the process: one that goes on without one of its threads looks alive and no longer does its work.
//! Nothing in this program catches a panic.

use std::{
    backtrace::{Backtrace, BacktraceStatus},
    panic::PanicHookInfo,
};

/// Makes every panic say thread, place and message on stderr in one line, and then abort the process.
///
/// The launcher shows that line and says which process it was; processes whose launcher aborts end in order.
pub fn end_the_process() {
    std::panic::set_hook(Box::new(|panic| {
        say(&line(panic, std::thread::current().name()));
        let trace = Backtrace::capture();
        if trace.status() == BacktraceStatus::Captured {
            say(&trace.to_string());
        }
        std::process::abort();
    }));
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
