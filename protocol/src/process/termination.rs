//! Reasons for a process to exit: a signal, a closed terminal or stderr, a dead parent. It listens for the process's whole life.
//! What a sign means, a wish to drain or to end at once, is for the caller.

use std::{
    fs,
    ops::ControlFlow,
    os::{fd::AsFd, unix::process::parent_id},
    time::Duration,
};

use nix::{
    poll::{PollFd, PollFlags, PollTimeout, poll},
    sys::signal::Signal as Number,
};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::fail_point;

/// How often it is looked whether parent and stderr are still there.
const LOOK: Duration = Duration::from_millis(500);

/// Why a process should end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum EndSign {
    /// It was requested: SIGINT (Ctrl-C) or SIGTERM.
    Asked,
    /// The terminal was closed (SIGHUP), the reader of stderr exited, or the parent died.
    Abandoned,
}

/// Calls `on_sign` at each sign, on a thread of this `name`, until it breaks or the process ends. `parent` is the process whose
/// death is a sign, given by its number: if it died before this process looked, that is seen too.
///
/// SIGHUP is left ignored where it is ignored at the start, as `nohup` does it.
pub(super) fn listen(
    name: &'static str,
    parent: Option<u32>,
    mut on_sign: impl FnMut(EndSign) -> ControlFlow<()> + Send + 'static,
) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (mut interrupt, mut terminate, mut hangup) = {
        let _inside = runtime.enter();
        // A file at its size limit (`ulimit -f`) becomes a write error, like a full disk; without a handler this signal would kill
        // the process. The handler stays.
        drop(signal(SignalKind::from_raw(Number::SIGXFSZ as i32))?);
        (
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
            // None where it was set to be ignored before this process started, by the kernel's own table.
            match is_set("SigIgn:", Number::SIGHUP as u32 - 1) {
                true => None,
                false => Some(signal(SignalKind::hangup())?),
            },
        )
    };
    let listening = async move {
        let mut look = tokio::time::interval(LOOK);
        let mut abandoned = false;
        loop {
            fail_point::reach(name);
            let sign = tokio::select! {
                _ = interrupt.recv() => EndSign::Asked,
                _ = terminate.recv() => EndSign::Asked,
                () = received(&mut hangup) => EndSign::Abandoned,
                // Said once: it stays so.
                _ = look.tick(), if !abandoned => {
                    abandoned = is_gone(std::io::stderr()) || parent.is_some_and(|pid| parent_id() != pid);
                    if !abandoned {
                        continue;
                    }
                    EndSign::Abandoned
                }
            };
            if on_sign(sign).is_break() {
                return;
            }
        }
    };
    std::thread::Builder::new()
        .name(name.into())
        .spawn(move || runtime.block_on(listening))?;
    Ok(())
}

/// Waits for the signal; without one it never returns.
async fn received(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}

/// Whether a bit of one of this process's masks is set, by the name of the mask in `/proc/PID/status`.
pub(crate) fn is_set(mask: &str, bit: u32) -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    is_set_in(&status, mask, bit)
}

fn is_set_in(status: &str, mask: &str, bit: u32) -> bool {
    let bits = status.lines().find_map(|line| line.strip_prefix(mask));
    let bits = bits.and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok());
    bits.is_some_and(|bits| bits >> bit & 1 == 1)
}

/// Whether an output has lost its reader: the pipe's reader exited, or the terminal was closed. A file that cannot be written does not
/// count.
fn is_gone(output: impl AsFd) -> bool {
    let mut output = [PollFd::new(output.as_fd(), PollFlags::empty())];
    let found = poll(&mut output, PollTimeout::ZERO);
    let events = output[0].revents().unwrap_or(PollFlags::empty());
    // These two are always looked for.
    found.is_ok() && events.intersects(PollFlags::POLLERR | PollFlags::POLLHUP)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pipe_is_gone_with_its_reader() {
        let (reader, writer) = std::io::pipe().unwrap();
        assert!(!is_gone(&writer));
        drop(reader);
        assert!(is_gone(&writer));
        assert!(!is_gone(tempfile::tempfile().unwrap()));
        assert!(!is_gone(fs::File::open("/dev/null").unwrap()));
    }

    #[test]
    fn the_kernels_table_says_which_bits_are_set() {
        let status = "Name:\tx\nCapPrm:\t0000000000004000\nCapEff:\t000001ff00000001\n";
        let set = (0..64).filter(|&bit| is_set_in(status, "CapEff:", bit));
        assert!(set.eq([0_u32].into_iter().chain(32..41)));
        assert!(!is_set_in(status, "SigIgn:", 0));
    }
}
