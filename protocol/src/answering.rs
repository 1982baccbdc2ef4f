//! Threads that answer questions, so that the threads on which zenoh receives never wait.
//! What the answers are is each part's own.
//!
//! zenoh calls back on the thread that reads the socket. Were it to send megabytes from there, or to wait for anything, nothing
//! would be read meanwhile, and where the other side is busy with sending here, both would wait for ever.

use std::{
    sync::{Arc, Mutex, PoisonError, mpsc},
    thread::JoinHandle,
};

use zenoh::{
    Session, Wait,
    query::{Query, Queryable},
};

/// Questions that wait for a thread; whoever asks one more hears nothing and asks again.
const WAITING_MAX: usize = 4096;

/// Threads and the queue to them. The threads end when this and everything that it declared are dropped.
#[derive(Debug)]
pub struct Answering {
    questions: mpsc::SyncSender<Query>,
    threads: Vec<JoinHandle<()>>,
}

impl Answering {
    /// Starts `threads` threads, each of which answers one question after the other with `answer`.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn start(
        name: &str,
        threads: usize,
        answer: impl Fn(&Query) + Clone + Send + 'static,
    ) -> std::io::Result<Self> {
        let (questions, waiting) = mpsc::sync_channel::<Query>(WAITING_MAX);
        let waiting = Arc::new(Mutex::new(waiting));
        let work = |i: usize| {
            let (waiting, answer) = (waiting.clone(), answer.clone());
            let next = move || {
                let waiting = waiting.lock().unwrap_or_else(PoisonError::into_inner);
                waiting.recv().ok()
            };
            std::thread::Builder::new()
                .name(format!("{name}-{i}"))
                .spawn(move || std::iter::from_fn(next).for_each(|query| answer(&query)))
        };
        let threads = (0..threads).map(work).collect::<Result<_, _>>()?;
        Ok(Self { questions, threads })
    }

    /// Takes the questions asked at `key`, until the result is dropped.
    ///
    /// # Errors
    /// zenoh refused.
    pub fn declare(&self, session: &Session, key: String) -> zenoh::Result<Queryable<()>> {
        let questions = self.questions.clone();
        let take = move |query| {
            if questions.try_send(query).is_err() {
                tracing::warn!("more questions than can wait; whoever asked asks again");
            }
        };
        session.declare_queryable(key).callback(take).wait()
    }

    /// The threads, to be waited for.
    pub fn into_threads(self) -> Vec<JoinHandle<()>> {
        self.threads
    }
}
