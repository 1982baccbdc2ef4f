//! Flushes the log to the disk once a period, on a separate thread.
//! What the process has written survives its death without this; what the machine has flushed survives a power cut too.

use std::{
    fs::File,
    io,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use driml_protocol::{Seldom, Shutdown, fault};

/// Segments that wait to be flushed; with one more they are flushed before anything else is written.
const OPEN_MAX: usize = 32;

/// What the thread flushes next.
#[derive(Default)]
struct Files {
    /// The segment that is written, and older ones that are not flushed yet, by their numbers.
    open: Vec<(u64, Arc<File>)>,
    /// The folder, if a file was made or removed.
    folder: Option<Arc<File>>,
}

struct Shared {
    files: Mutex<Files>,
    dirty: AtomicBool,
    /// One flush at a time: a caller that asks for another one gets it done, not only begun.
    flushing: Mutex<()>,
    /// When the last flush that succeeded began.
    flushed: Mutex<Instant>,
}

impl Shared {
    fn new() -> Self {
        Self {
            files: Mutex::default(),
            dirty: AtomicBool::new(false),
            flushing: Mutex::default(),
            flushed: Mutex::new(Instant::now()),
        }
    }

    fn flushed(&self) -> MutexGuard<'_, Instant> {
        self.flushed.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn files(&self) -> MutexGuard<'_, Files> {
        self.files.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The thread; dropping this flushes once more and ends it.
pub(super) struct Syncer {
    shared: Arc<Shared>,
    folder: Arc<File>,
    stop: Shutdown,
    thread: Option<JoinHandle<()>>,
}

impl Syncer {
    /// Flushes every `period`, or, where that is zero, whenever [`Syncer::written`] is called.
    pub(super) fn start(folder: File, period: Duration) -> io::Result<Self> {
        let (shared, stop) = (Arc::new(Shared::new()), Shutdown::default());
        let mut thread = None;
        if !period.is_zero() {
            let (shared, stop) = (shared.clone(), stop.clone());
            let work = move || work(&shared, &stop, period);
            thread = Some(
                std::thread::Builder::new()
                    .name("replay-fsync".into())
                    .spawn(work)?,
            );
        }
        Ok(Self {
            shared,
            folder: Arc::new(folder),
            stop,
            thread,
        })
    }

    /// Segment `number` is written from now on, and was made just now.
    pub(super) fn opened(&self, number: u64, file: Arc<File>) {
        let mut files = self.shared.files();
        files.open.push((number, file));
        files.folder = Some(self.folder.clone());
        let too_many = files.open.len() > OPEN_MAX;
        drop(files);
        self.shared.dirty.store(true, Ordering::Release);
        if too_many {
            self.flush();
        }
    }

    /// Seconds since a flush began that succeeded; 0 where each write is flushed and all were.
    pub(super) fn flushed_s(&self) -> f64 {
        if self.thread.is_none() && !self.shared.dirty.load(Ordering::Acquire) {
            return 0.0;
        }
        self.shared.flushed().elapsed().as_secs_f64()
    }

    /// Segment `number` is gone, and need not be flushed.
    pub(super) fn removed(&self, number: u64) {
        self.shared.files().open.retain(|(open, _)| *open != number);
    }

    /// Something was written to the newest file; where each write is flushed, the disk may refuse.
    pub(super) fn written(&self) -> io::Result<()> {
        self.shared.dirty.store(true, Ordering::Release);
        match self.thread {
            Some(_) => Ok(()),
            None => flush(&self.shared),
        }
    }

    pub(super) fn flushed(&self) -> io::Result<()> {
        flush(&self.shared)
    }

    /// Flushes now; a disk that refuses is a warning.
    pub(super) fn flush(&self) {
        if let Err(e) = self.flushed() {
            tracing::warn!("the replay's log was not flushed at the end: {e}");
        }
    }
}

impl Drop for Syncer {
    fn drop(&mut self) {
        self.stop.set();
        match self.thread.take().map(JoinHandle::join) {
            None | Some(Ok(())) => {}
            Some(Err(_)) => tracing::error!("the thread that flushes the replay's log panicked"),
        }
        self.flush();
    }
}

fn work(shared: &Shared, stop: &Shutdown, period: Duration) {
    let mut said = Seldom::default();
    while !stop.wait_timeout(period) {
        fault::point("replay-fsync");
        if let Err(e) = flush(shared)
            && let Some(more) = said.due()
        {
            tracing::error!(
                "the replay's log was not flushed, a power cut may lose what was stored since: {e}{more}"
            );
        }
    }
}

/// Flushes what was written since the last time.
fn flush(shared: &Shared) -> io::Result<()> {
    let _one = shared
        .flushing
        .lock()
        .unwrap_or_else(PoisonError::into_inner);
    let begun = Instant::now();
    if shared.dirty.swap(false, Ordering::AcqRel) {
        let files = shared.files();
        let (open, folder) = (files.open.clone(), files.folder.clone());
        drop(files);
        if let Err(e) = flush_all(&open, folder.as_deref()) {
            // What was not flushed is due the next time again.
            shared.dirty.store(true, Ordering::Release);
            return Err(e);
        }
        let mut files = shared.files();
        // Older ones are not written any more.
        if let Some((newest, _)) = open.last() {
            files.open.retain(|(number, _)| number >= newest);
            if files.open.last().is_none_or(|(number, _)| number == newest) {
                files.folder = None;
            }
        }
    }
    *shared.flushed() = begun;
    Ok(())
}

fn flush_all(open: &[(u64, Arc<File>)], folder: Option<&File>) -> io::Result<()> {
    for (_, file) in open {
        file.sync_data()?;
    }
    folder.map_or(Ok(()), File::sync_all)
}
