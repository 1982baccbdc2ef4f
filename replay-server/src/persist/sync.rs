//! Flushes the log to the disk once a period, on a separate thread.
//! Written data survives the death of the process without a flush; flushed data survives a power cut too.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io,
    sync::{Arc, Mutex},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use driml_protocol::{LogLimiter, Shutdown, atomic_write, fail_point, lock, spawn};

/// Maximum segments that wait for a flush. One more causes a flush before anything else is written.
const UNFLUSHED_SEGMENTS_MAX: usize = 32;

struct FlushState {
    segments: BTreeMap<u64, Arc<File>>,
    /// The folder, if a segment was created in it since the last flush.
    folder: Option<Arc<File>>,
    /// Segments of which a flush failed. The system says so once, and may then take what it has lost for written.
    failed: BTreeSet<u64>,
    /// Segments with smaller numbers were removed, perhaps during a flush.
    oldest: u64,
    /// When the last flush began that succeeded while no segment was lost.
    last_flush: Instant,
}

impl FlushState {
    fn forget_removed(&mut self) {
        self.segments = self.segments.split_off(&self.oldest);
        self.failed = self.failed.split_off(&self.oldest);
    }
}

struct Flusher {
    state: Mutex<FlushState>,
    /// Allows one flush at a time, so that a caller's flush is complete when it returns.
    flushing: Mutex<()>,
}

impl Flusher {
    fn flush(&self) -> io::Result<()> {
        let _one = lock(&self.flushing);
        let begun = Instant::now();
        let mut state = lock(&self.state);
        let segments = std::mem::take(&mut state.segments);
        let folder = state.folder.take();
        drop(state);
        let mut failed = None;
        let flushed = segments
            .iter()
            .try_for_each(|(&number, file)| file.sync_data().inspect_err(|_| failed = Some(number)))
            .and_then(|()| folder.as_deref().map_or(Ok(()), atomic_write::sync_folder));
        let mut state = lock(&self.state);
        if flushed.is_err() {
            // To be flushed again next time.
            state.segments.extend(segments);
            state.folder = state.folder.take().or(folder);
            state.failed.extend(failed);
            state.forget_removed();
        } else if state.failed.is_empty() {
            state.last_flush = begun;
        }
        flushed
    }
}

/// The thread that flushes. Dropping this ends the thread and flushes once more.
pub(super) struct Syncer {
    flusher: Arc<Flusher>,
    folder: Arc<File>,
    stop: Shutdown,
    thread: Option<JoinHandle<()>>,
}

impl Syncer {
    /// Starts to flush every `period`, or, if `period` is zero, at each call of [`Syncer::after_write`].
    pub(super) fn start(folder: File, period: Duration) -> io::Result<Self> {
        let flusher = Arc::new(Flusher {
            state: Mutex::new(FlushState {
                segments: BTreeMap::new(),
                folder: None,
                failed: BTreeSet::new(),
                oldest: 0,
                last_flush: Instant::now(),
            }),
            flushing: Mutex::default(),
        });
        let stop = Shutdown::default();
        let mut thread = None;
        if !period.is_zero() {
            let (flusher, stop) = (flusher.clone(), stop.clone());
            let flush = move || flush_periodically(&flusher, &stop, period);
            thread = Some(spawn("replay-fsync", flush)?);
        }
        Ok(Self {
            flusher,
            folder: Arc::new(folder),
            stop,
            thread,
        })
    }

    pub(super) fn add_segment(&self, number: u64, file: Arc<File>) {
        let mut state = lock(&self.flusher.state);
        state.segments.insert(number, file);
        state.folder = Some(self.folder.clone());
        let too_many = state.segments.len() > UNFLUSHED_SEGMENTS_MAX;
        drop(state);
        if too_many {
            self.flush_or_warn();
        }
    }

    /// Returns the seconds since the last successful flush began; 0 if each write is flushed and none has failed.
    pub(super) fn since_flush_s(&self) -> f64 {
        let state = lock(&self.flusher.state);
        match self.thread.is_none() && state.segments.is_empty() {
            true => 0.0,
            false => state.last_flush.elapsed().as_secs_f64(),
        }
    }

    /// Segment `number`, the oldest, was removed and need not be flushed.
    pub(super) fn forget_segment(&self, number: u64) {
        let mut state = lock(&self.flusher.state);
        state.oldest = number + 1;
        state.forget_removed();
    }

    /// Whether a flush of segment `number` failed. Always false if each write is flushed, as a failed write is then repeated.
    pub(super) fn has_failed(&self, number: u64) -> bool {
        self.thread.is_some() && lock(&self.flusher.state).failed.contains(&number)
    }

    /// Notes a write to segment `number`. If each write is flushed, flushes it and returns the disk's error.
    pub(super) fn after_write(&self, number: u64, file: &Arc<File>) -> io::Result<()> {
        let mut state = lock(&self.flusher.state);
        state.segments.entry(number).or_insert_with(|| file.clone());
        drop(state);
        match self.thread {
            Some(_) => Ok(()),
            None => self.flusher.flush(),
        }
    }

    pub(super) fn try_flush(&self) -> io::Result<()> {
        self.flusher.flush()
    }

    /// Flushes now. A failure is logged as a warning.
    pub(super) fn flush_or_warn(&self) {
        if let Err(e) = self.try_flush() {
            tracing::warn!("the replay's log was not flushed: {e}");
        }
    }
}

impl Drop for Syncer {
    fn drop(&mut self) {
        self.stop.set();
        if let Some(Err(_)) = self.thread.take().map(JoinHandle::join) {
            tracing::error!("the thread that flushes the replay's log panicked");
        }
        self.flush_or_warn();
    }
}

fn flush_periodically(flusher: &Flusher, stop: &Shutdown, period: Duration) {
    let mut log_limiter = LogLimiter::default();
    while !stop.wait_timeout(period) {
        fail_point::reach("replay-fsync");
        if let Err(e) = flusher.flush()
            && let Some(more) = log_limiter.admit()
        {
            tracing::error!(
                "the replay's log was not flushed, a power cut may lose what was stored since: {e}{more}"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_failed_flush_lost_stays_unflushed_until_its_segment_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let file = |path| Arc::new(File::open(path).unwrap());
        let opened = File::open(folder.path()).unwrap();
        let syncer = Syncer::start(opened, Duration::from_secs(3600)).unwrap();
        let begun = Instant::now();
        syncer.add_segment(1, file("/dev/null".as_ref()));
        assert!(syncer.try_flush().is_err());
        // The system reports the failure once.
        syncer.add_segment(1, file(folder.path()));
        assert!(syncer.try_flush().is_ok());
        let least = begun.elapsed().as_secs_f64();
        assert!(syncer.since_flush_s() >= least);
        syncer.forget_segment(1);
        // As if the failing flush had begun before it was removed.
        syncer.add_segment(1, file("/dev/null".as_ref()));
        assert!(syncer.try_flush().is_err());
        let asked = Instant::now();
        assert!(syncer.try_flush().is_ok());
        assert!(syncer.since_flush_s() <= asked.elapsed().as_secs_f64());
    }
}
