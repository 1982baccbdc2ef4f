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

use driml_protocol::{LogLimiter, Shutdown, fail_point, lock};

/// Maximum segments that wait for a flush. One more causes a flush before anything else is written.
const WAITING_MAX: usize = 32;

struct Unflushed {
    segments: BTreeMap<u64, Arc<File>>,
    /// The folder, if a segment was created in it since the last flush.
    folder: Option<Arc<File>>,
    /// Segments of which a flush failed. The system says so once, and may then take what it has lost for written.
    lost: BTreeSet<u64>,
    /// Segments with smaller numbers were removed, perhaps during a flush.
    oldest: u64,
    /// When the last flush began that succeeded while no segment was lost.
    flushed: Instant,
}

impl Unflushed {
    fn forget_removed(&mut self) {
        self.segments = self.segments.split_off(&self.oldest);
        self.lost = self.lost.split_off(&self.oldest);
    }
}

struct Shared {
    unflushed: Mutex<Unflushed>,
    /// Allows one flush at a time, so that a caller's flush is complete when it returns.
    flushing: Mutex<()>,
}

impl Shared {
    fn flush(&self) -> io::Result<()> {
        let _one = lock(&self.flushing);
        let begun = Instant::now();
        let mut unflushed = lock(&self.unflushed);
        let segments = std::mem::take(&mut unflushed.segments);
        let folder = unflushed.folder.take();
        drop(unflushed);
        let mut lost = None;
        let flushed = segments
            .iter()
            .try_for_each(|(&number, file)| file.sync_data().inspect_err(|_| lost = Some(number)))
            .and_then(|()| folder.as_ref().map_or(Ok(()), |folder| folder.sync_all()));
        let mut unflushed = lock(&self.unflushed);
        if flushed.is_err() {
            // To be flushed again next time.
            unflushed.segments.extend(segments);
            unflushed.folder = unflushed.folder.take().or(folder);
            unflushed.lost.extend(lost);
            unflushed.forget_removed();
        } else if unflushed.lost.is_empty() {
            unflushed.flushed = begun;
        }
        flushed
    }
}

/// The thread that flushes. Dropping this ends the thread and flushes once more.
pub(super) struct Syncer {
    shared: Arc<Shared>,
    folder: Arc<File>,
    stop: Shutdown,
    thread: Option<JoinHandle<()>>,
}

impl Syncer {
    /// Starts to flush every `period`, or, if `period` is zero, at each call of [`Syncer::written`].
    pub(super) fn start(folder: File, period: Duration) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            unflushed: Mutex::new(Unflushed {
                segments: BTreeMap::new(),
                folder: None,
                lost: BTreeSet::new(),
                oldest: 0,
                flushed: Instant::now(),
            }),
            flushing: Mutex::default(),
        });
        let stop = Shutdown::default();
        let mut thread = None;
        if !period.is_zero() {
            let (shared, stop) = (shared.clone(), stop.clone());
            let named = std::thread::Builder::new().name("replay-fsync".into());
            thread = Some(named.spawn(move || work(&shared, &stop, period))?);
        }
        Ok(Self {
            shared,
            folder: Arc::new(folder),
            stop,
            thread,
        })
    }

    pub(super) fn opened(&self, number: u64, file: Arc<File>) {
        let mut unflushed = lock(&self.shared.unflushed);
        unflushed.segments.insert(number, file);
        unflushed.folder = Some(self.folder.clone());
        let too_many = unflushed.segments.len() > WAITING_MAX;
        drop(unflushed);
        if too_many {
            self.flush();
        }
    }

    /// Returns the seconds since the last successful flush began; 0 if each write is flushed and none has failed.
    pub(super) fn flushed_s(&self) -> f64 {
        let unflushed = lock(&self.shared.unflushed);
        match self.thread.is_none() && unflushed.segments.is_empty() {
            true => 0.0,
            false => unflushed.flushed.elapsed().as_secs_f64(),
        }
    }

    /// Segment `number`, the oldest, was removed and need not be flushed.
    pub(super) fn removed(&self, number: u64) {
        let mut unflushed = lock(&self.shared.unflushed);
        unflushed.oldest = number + 1;
        unflushed.forget_removed();
    }

    /// Whether a flush of segment `number` failed. Always false if each write is flushed, as a failed write is then repeated.
    pub(super) fn has_lost(&self, number: u64) -> bool {
        self.thread.is_some() && lock(&self.shared.unflushed).lost.contains(&number)
    }

    /// Notes a write to segment `number`. If each write is flushed, flushes it and returns the disk's error.
    pub(super) fn written(&self, number: u64, file: &Arc<File>) -> io::Result<()> {
        let mut unflushed = lock(&self.shared.unflushed);
        let segments = &mut unflushed.segments;
        segments.entry(number).or_insert_with(|| file.clone());
        drop(unflushed);
        match self.thread {
            Some(_) => Ok(()),
            None => self.shared.flush(),
        }
    }

    pub(super) fn flushed(&self) -> io::Result<()> {
        self.shared.flush()
    }

    /// Flushes now. A failure is logged as a warning.
    pub(super) fn flush(&self) {
        if let Err(e) = self.flushed() {
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
        self.flush();
    }
}

fn work(shared: &Shared, stop: &Shutdown, period: Duration) {
    let mut said = LogLimiter::default();
    while !stop.wait_timeout(period) {
        fail_point::reach("replay-fsync");
        if let Err(e) = shared.flush()
            && let Some(more) = said.due()
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
        syncer.opened(1, file("/dev/null".as_ref()));
        assert!(syncer.flushed().is_err());
        // The system reports the failure once.
        syncer.opened(1, file(folder.path()));
        assert!(syncer.flushed().is_ok());
        let least = begun.elapsed().as_secs_f64();
        assert!(syncer.flushed_s() >= least);
        syncer.removed(1);
        // As if the failing flush had begun before it was removed.
        syncer.opened(1, file("/dev/null".as_ref()));
        assert!(syncer.flushed().is_err());
        let asked = Instant::now();
        assert!(syncer.flushed().is_ok());
        assert!(syncer.flushed_s() <= asked.elapsed().as_secs_f64());
    }
}
