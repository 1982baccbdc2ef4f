//! Threads that answer questions, so that the threads on which zenoh receives never wait.
//! What the answers are is each part's own.
//!
//! zenoh calls back on the thread that reads the socket. Were it to send megabytes from there, or to wait for anything, nothing
//! would be read meanwhile, and where the other side is busy with sending here, both would wait for ever.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
        mpsc,
    },
    thread::JoinHandle,
};

use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    query::{Query, Queryable},
};

use crate::process::fault;

/// Questions that wait for a thread; whoever asks one more hears at once that nobody answers, and asks again.
const WAITING_MAX: usize = 4096;
/// Bytes of the questions that wait for a thread: a few hundred chunks of Procgen. Beyond it one question may wait, so that
/// one of any size is answered in the end; whoever asks one more hears at once that nobody answers, and asks again.
const WAITING_BYTES_MAX: usize = 1 << 29;

/// Threads and the queue to them. The threads end when this and everything that it declared are dropped.
#[derive(Debug)]
pub struct Answering {
    questions: mpsc::SyncSender<Query>,
    waiting_bytes: Arc<AtomicUsize>,
    threads: Vec<JoinHandle<()>>,
}

fn payload_bytes(query: &Query) -> usize {
    query.payload().map_or(0, ZBytes::len)
}

impl Answering {
    /// Starts `threads` threads, each of which answers one question after the other with `answer`.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn start(
        name: &str,
        threads: usize,
        answer: impl Fn(Query) + Clone + Send + 'static,
    ) -> std::io::Result<Self> {
        let (questions, waiting) = mpsc::sync_channel::<Query>(WAITING_MAX);
        let waiting = Arc::new(Mutex::new(waiting));
        let waiting_bytes = Arc::<AtomicUsize>::default();
        let work = |i: usize| {
            let (waiting, answer, bytes) = (waiting.clone(), answer.clone(), waiting_bytes.clone());
            let point = name.to_owned();
            let next = move || {
                fault::point(&point);
                let waiting = waiting.lock().unwrap_or_else(PoisonError::into_inner);
                let query = waiting.recv().ok()?;
                bytes.fetch_sub(payload_bytes(&query), Ordering::Relaxed);
                Some(query)
            };
            std::thread::Builder::new()
                .name(format!("{name}-{i}"))
                .spawn(move || std::iter::from_fn(next).for_each(answer))
        };
        let threads = (0..threads).map(work).collect::<Result<_, _>>()?;
        Ok(Self {
            questions,
            waiting_bytes,
            threads,
        })
    }

    /// Takes the questions asked at `key`, until the result is dropped. No other part need be asked: the answer is complete.
    ///
    /// # Errors
    /// zenoh refused.
    pub fn declare(&self, session: &Session, key: String) -> zenoh::Result<Queryable<()>> {
        let (questions, waiting_bytes) = (self.questions.clone(), self.waiting_bytes.clone());
        let take = move |query: Query| {
            let bytes = payload_bytes(&query);
            let before = waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
            // A query that is dropped ends: its asker hears that nobody answers.
            if before > WAITING_BYTES_MAX || questions.try_send(query).is_err() {
                waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
                tracing::debug!("more questions than can wait; whoever asked asks again");
            }
        };
        session
            .declare_queryable(key)
            .complete(true)
            .callback(take)
            .wait()
    }

    /// The threads, to be waited for.
    pub fn into_threads(self) -> Vec<JoinHandle<()>> {
        self.threads
    }
}
