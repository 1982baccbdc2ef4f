//! Watches for reasons to exit, as long as the process runs: a signal, a closed terminal or stderr, a dead parent.
//! The caller decides whether a reason means to drain or to exit at once.

use std::{
    fs,
    os::{fd::AsFd, unix::process::parent_id},
    time::Duration,
};

use nix::{
    poll::{PollFd, PollFlags, PollTimeout, poll},
    sys::signal::Signal as SignalNumber,
};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::{fail_point, spawn};

/// How often a process checks whether its parent and the reader of stderr still exist.
const CHECK_PERIOD: Duration = Duration::from_millis(500);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ExitReason {
    /// A request: SIGINT (Ctrl-C) or SIGTERM.
    Request,
    /// The terminal was closed (SIGHUP), the reader of stderr exited, or the parent died.
    Abandoned,
}

/// Calls `on_reason` at each reason, on a thread of this `name`, until the process exits. `parent` is the number of the
/// process whose death is a reason, even if it died before this call.
///
/// SIGHUP stays ignored if it is ignored at the start, as under `nohup`.
pub(super) fn watch(
    name: &'static str,
    parent: Option<u32>,
    mut on_reason: impl FnMut(ExitReason) + Send + 'static,
) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (mut interrupt, mut terminate, mut hangup) = {
        let _inside = runtime.enter();
        // With a handler, a file at its size limit (`ulimit -f`) causes a write error, like a full disk; without one, this signal kills the
        // process. The handler stays after the drop.
        drop(signal(SignalKind::from_raw(SignalNumber::SIGXFSZ as i32))?);
        (
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
            // `None` if the kernel's table shows that the signal was ignored before this process started.
            match is_bit_set("SigIgn:", SignalNumber::SIGHUP as u32 - 1) {
                true => None,
                false => Some(signal(SignalKind::hangup())?),
            },
        )
    };
    let watching = async move {
        let mut check = tokio::time::interval(CHECK_PERIOD);
        let mut abandoned = false;
        loop {
            fail_point::reach(name);
            let reason = tokio::select! {
                _ = interrupt.recv() => ExitReason::Request,
                _ = terminate.recv() => ExitReason::Request,
                () = wait_for_signal(&mut hangup) => ExitReason::Abandoned,
                // Reported once, because the state does not change back.
                _ = check.tick(), if !abandoned => {
                    abandoned = has_lost_reader(std::io::stderr()) || parent.is_some_and(|pid| parent_id() != pid);
                    if !abandoned {
                        continue;
                    }
                    ExitReason::Abandoned
                }
            };
            on_reason(reason);
        }
    };
    spawn(name, move || runtime.block_on(watching)).map(drop)
}

/// Waits for the signal; without one, never returns.
async fn wait_for_signal(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}

/// Whether a bit is set in one of this process's signal or capability masks, named as in `/proc/PID/status`.
pub(crate) fn is_bit_set(mask: &str, bit: u32) -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    is_bit_set_in(&status, mask, bit)
}

fn is_bit_set_in(status: &str, mask: &str, bit: u32) -> bool {
    let bits = status.lines().find_map(|line| line.strip_prefix(mask));
    let bits = bits.and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok());
    bits.is_some_and(|bits| bits >> bit & 1 == 1)
}

/// Whether an output has lost its reader: the pipe's reader exited, or the terminal was closed. A file that cannot be written does not
/// count.
fn has_lost_reader(output: impl AsFd) -> bool {
    let mut output = [PollFd::new(output.as_fd(), PollFlags::empty())];
    let found = poll(&mut output, PollTimeout::ZERO);
    let events = output[0].revents().unwrap_or(PollFlags::empty());
    // `poll` always reports these two.
    found.is_ok() && events.intersects(PollFlags::POLLERR | PollFlags::POLLHUP)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pipe_is_gone_with_its_reader() {
        let (reader, writer) = std::io::pipe().unwrap();
        assert!(!has_lost_reader(&writer));
        drop(reader);
        assert!(has_lost_reader(&writer));
        assert!(!has_lost_reader(tempfile::tempfile().unwrap()));
        assert!(!has_lost_reader(fs::File::open("/dev/null").unwrap()));
    }

    #[test]
    fn the_kernels_table_says_which_bits_are_set() {
        let status = "Name:\tx\nCapPrm:\t0000000000004000\nCapEff:\t000001ff00000001\n";
        let set = (0..64).filter(|&bit| is_bit_set_in(status, "CapEff:", bit));
        assert!(set.eq([0_u32].into_iter().chain(32..41)));
        assert!(!is_bit_set_in(status, "SigIgn:", 0));
    }
}
