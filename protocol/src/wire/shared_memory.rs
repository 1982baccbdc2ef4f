//! When messages may go through shared memory: what the system grants a process, and whether such messages arrive.
//! Buffers are handled in `buffers`.

use std::{
    fs::File,
    time::{Duration, Instant},
};

use nix::sys::{
    resource::{Resource, getrlimit, setrlimit},
    statvfs::statvfs,
};

use crate::process::{lock_file, termination::is_bit_set};

/// The folder in which the operating system keeps memory that processes of one host share.
pub const FOLDER: &str = "/dev/shm";
/// Bytes of zenoh's metadata in [`FOLDER`] for each process that creates shared memory: 32,768 headers of 32 bytes, 32,768 words of 8.
pub const METADATA_BYTES: usize = 40 << 15;
/// Bytes that zenoh keeps in [`FOLDER`] for each session.
pub const SESSION_BYTES: usize = 12 << 10;
/// How long a process waits for others that allocate shared memory at the same time; each takes milliseconds.
const LOCK_WAIT_MAX: Duration = Duration::from_secs(10);
/// How often a waiting process checks whether the others are done.
const TICK: Duration = Duration::from_millis(2);
/// Messages that arrive through the socket after a loss in shared memory, before shared memory is tried again.
const AVOID_COUNT: u32 = 64;
/// After this many losses without an arrival in between, shared memory is not tried again.
const LOSSES_MAX: u32 = 2;
/// After this many failed allocations in a row, far more than messages in use at a time, a warning says that memory may be lost.
const MISSES_MAX: u32 = 64;
/// Number of the capability by which a process may lock as much memory as it likes (`capabilities(7)`).
const CAP_IPC_LOCK: u32 = 14;

/// Decides whether to try shared memory, by the fate of the messages that went through it.
#[derive(Debug, Default)]
pub struct Trust {
    /// Messages that still have to arrive through the socket.
    avoid_left: u32,
    losses_in_a_row: u32,
    misses_in_a_row: u32,
}

impl Trust {
    /// Whether the next message may go through shared memory.
    pub const fn may_use(&self) -> bool {
        self.avoid_left == 0
    }

    /// Records that a message in shared memory was not answered. The next ones go through the socket; after two losses in a row, all do.
    pub fn record_loss(&mut self) {
        // Messages that are lost together are one loss.
        self.losses_in_a_row += u32::from(self.may_use());
        if self.may_use() && self.losses_in_a_row == LOSSES_MAX {
            tracing::warn!(
                "messages in shared memory do not arrive, so all go through sockets from now on, which is slower; the other side may \
                 not be allowed to lock memory: raise its `ulimit -l`, or --set transport.shared_memory=false"
            );
        }
        self.avoid_left = AVOID_COUNT;
    }

    /// Records whether shared memory was free for a message; if not, the message goes through the socket.
    pub fn record_allocation(&mut self, is_free: bool) {
        let misses = self.misses_in_a_row.saturating_add(1);
        self.misses_in_a_row = if is_free { 0 } else { misses };
        if self.misses_in_a_row == MISSES_MAX {
            tracing::warn!(
                "no shared memory is free, so messages go through sockets, which is slower; a process that was killed may hold it: start \
                 this one again to free it"
            );
        }
    }

    /// Records that a message has arrived, through shared memory or through the socket. An unanswered one counts for nothing: the other
    /// process may be down.
    pub const fn record_arrival(&mut self, in_shared_memory: bool) {
        if in_shared_memory {
            self.losses_in_a_row = 0;
        } else if self.losses_in_a_row < LOSSES_MAX {
            self.avoid_left = self.avoid_left.saturating_sub(1);
        }
    }
}

/// Bytes of shared memory for `count` buffers of `bytes` each, plus a quarter and 64 KiB for the allocator's metadata and gaps.
pub const fn pool_bytes(count: usize, bytes: usize) -> usize {
    count.saturating_mul(bytes) / 4 * 5 + (1 << 16)
}

/// Bytes of [`FOLDER`] that a process with a pool of `pool` bytes takes.
pub const fn process_bytes(pool: usize) -> usize {
    pool.next_multiple_of(1 << 12) + METADATA_BYTES + SESSION_BYTES
}

/// Returns the free bytes in [`FOLDER`].
pub fn free_bytes() -> Result<u64, String> {
    statvfs(FOLDER)
        .map(|it| it.blocks_available().saturating_mul(it.fragment_size()))
        .map_err(|e| format!("{FOLDER}: {e}"))
}

/// Checks that `bytes` bytes are free in [`FOLDER`]. The system grants more than there is, and kills the process that writes to it.
pub fn check_room(bytes: usize) -> Result<(), String> {
    let free = free_bytes()?;
    if free >= bytes as u64 {
        return Ok(());
    }
    Err(format!(
        "{FOLDER} has {:.1} MiB free, {:.1} MiB are needed: make it larger (`mount -o remount,size=1g {FOLDER}`, in a container \
         --shm-size=1g)",
        free as f64 / f64::from(1 << 20),
        bytes as f64 / f64::from(1 << 20),
    ))
}

/// Checks that this process may create a file of `bytes` bytes, because shared memory is a file.
pub(super) fn check_file_size(bytes: usize) -> Result<(), String> {
    let limit = getrlimit(Resource::RLIMIT_FSIZE).ok().map(|it| it.0);
    check_limit(limit, bytes, "write files of", "-f")
}

fn check_limit(limit: Option<u64>, bytes: usize, action: &str, option: &str) -> Result<(), String> {
    match limit {
        Some(limit) if limit < bytes as u64 => Err(format!(
            "this process may {action} {} KiB, {} KiB are needed: raise `ulimit {option}`",
            limit >> 10,
            bytes >> 10
        )),
        _ => Ok(()),
    }
}

/// Returns the shared memory that was granted; if none was, logs a warning with the reason and the effect.
pub fn granted<T>(asked: Result<T, String>) -> Option<T> {
    let warn = |why: &String| {
        tracing::warn!(
            "no shared memory, so messages go through sockets, which is slower: {why}; \
             --set transport.shared_memory=false asks for none"
        );
    };
    asked.inspect_err(warn).ok()
}

/// Calls `allocate` if `bytes` bytes are free in [`FOLDER`]. Processes that allocate at the same time take turns by a lock, so that all
/// together take no more than there is.
pub(super) fn allocate_in_turn<T>(
    bytes: usize,
    allocate: impl FnOnce() -> Result<T, String>,
) -> Result<T, String> {
    let folder = File::open(FOLDER).map_err(|e| format!("{FOLDER}: {e}"))?;
    let started = Instant::now();
    while matches!(lock_file::try_lock(&folder), Ok(false)) {
        if started.elapsed() > LOCK_WAIT_MAX {
            return Err(format!("{FOLDER} is locked by another process"));
        }
        std::thread::sleep(TICK);
    }
    check_room(bytes)?;
    allocate()
}

/// Checks that this process may lock `bytes` bytes, as zenoh locks the shared memory that it creates and that it reads.
pub fn check_lockable(bytes: usize) -> Result<(), String> {
    check_limit(lockable_bytes(), bytes, "lock memory of", "-l")
}

/// Returns the bytes that this process may lock; `None` if there is no limit. Raises the soft limit to the hard one.
pub fn lockable_bytes() -> Option<u64> {
    if is_bit_set("CapEff:", CAP_IPC_LOCK) {
        return None;
    }
    // A system without this limit reports an error when memory is locked.
    let (soft, hard) = getrlimit(Resource::RLIMIT_MEMLOCK).ok()?;
    // The soft limit still applies if it cannot be raised.
    let limit = match setrlimit(Resource::RLIMIT_MEMLOCK, hard, hard) {
        Ok(()) => hard,
        Err(_) => soft,
    };
    (limit != nix::sys::resource::RLIM_INFINITY).then_some(limit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn after_a_loss_sockets_serve_for_a_while_and_after_two_in_a_row_for_ever() {
        let mut trust = Trust::default();
        assert!(trust.may_use());
        // The second is one loss again, as something arrived in shared memory in between.
        for _ in 0..2 {
            trust.record_loss();
            for _ in 0..AVOID_COUNT {
                assert!(!trust.may_use(), "asked often, as while a server is down");
                trust.record_arrival(false);
            }
            assert!(trust.may_use());
            trust.record_arrival(true);
        }
        for _ in 0..2 {
            trust.record_loss();
            trust.record_loss();
            assert!(!trust.may_use());
            (0..AVOID_COUNT).for_each(|_| trust.record_arrival(false));
        }
        (0..10 * AVOID_COUNT).for_each(|_| trust.record_arrival(false));
        assert!(!trust.may_use());
    }
}
