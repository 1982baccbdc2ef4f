//! Threads that answer queries, so that the threads on which zenoh receives never wait.
//! Each process decides what it replies.
//!
//! zenoh calls back on the thread that reads the socket. Were it to send megabytes from there, or to wait for anything, nothing
//! would be read meanwhile, and if the other side is sending too, both would wait forever.

use std::{
    marker::PhantomData,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    thread::JoinHandle,
};

use crossbeam_channel::Sender;
use zenoh::{
    Wait,
    bytes::ZBytes,
    query::{Query, Queryable},
};

use crate::{
    client::{RunClient, Sealed},
    messages::recovering::Recovering,
    process::fail_point,
    session,
    wire::{
        buffers::{Buffer, BufferPool},
        codec,
        error::CodecError,
        keys::Keys,
        message::{Message, Request},
    },
};

/// Queries that wait for a thread; one more is dropped, and its sender is told at once and retries.
const WAITING_MAX: usize = 4096;
/// Bytes of the queries that wait for a thread: a few hundred chunks of Procgen. Beyond it one query may wait, so that one of
/// any size is answered in the end; one more is dropped, and its sender retries.
const WAITING_BYTES_MAX: usize = 1 << 29;

/// A request that has arrived and waits for its reply.
#[derive(Debug)]
pub struct Incoming<R> {
    query: Query,
    spec_hash: u64,
    request: PhantomData<fn() -> R>,
}

impl<R: Request> Incoming<R> {
    /// Reads a request without payload.
    pub fn read(&self) -> Result<R, CodecError> {
        let read = self.receive(&BufferPool::new(0));
        read.map(|(request, _)| request)
    }

    /// Reads a request and copies its payload into own memory of `pool`; one that came at another process's key is an error.
    pub fn receive(&self, pool: &BufferPool) -> Result<(R, Buffer), CodecError> {
        let nothing = ZBytes::new();
        let bytes = self.query.payload().unwrap_or(&nothing);
        let (request, payload): (R, _) =
            codec::receive(bytes.reader(), bytes.len(), pool, Some(self.spec_hash))?;
        // One that speaks for an actor, or for the learner beside them, comes at its own key, which others may have no access to.
        let (key, actor) = (self.query.key_expr().as_str(), request.actor());
        if R::BY_ACTOR && Keys::actor(key) != actor {
            let key = key.to_owned();
            return Err(CodecError::Actor { actor, key });
        }
        Ok((request, payload))
    }

    /// What the reply goes through.
    pub fn into_responder(self) -> Responder<R::Reply> {
        Responder {
            query: self.query,
            spec_hash: self.spec_hash,
            reply: PhantomData,
        }
    }
}

/// The means to reply with an `M`; where it is dropped without a reply, the sender of the query is told at once.
#[derive(Debug)]
pub struct Responder<M> {
    query: Query,
    spec_hash: u64,
    reply: PhantomData<fn() -> M>,
}

impl<M: Message> Responder<M> {
    /// Sends the reply. That it cannot be sent is logged: its asker asks again.
    pub fn reply(self, reply: &M) {
        self.send(Sealed::new(reply, self.spec_hash));
    }

    /// Sends the reply with a payload, as [`Responder::reply`] does without.
    pub fn reply_with(self, reply: &M, payload: ZBytes) {
        self.send(Sealed::with_payload(reply, payload, self.spec_hash));
    }

    /// Says instead of a reply that there is none yet, as the replay is being read back from disk.
    pub fn put_off(self, recovering: &Recovering) {
        match Sealed::new(recovering, self.spec_hash) {
            Ok(sealed) => session::put_off(&self.query, sealed.into_bytes()),
            Err(e) => tracing::error!("that the replay is being read back was not said: {e}"),
        }
    }

    fn send(&self, sealed: Result<Sealed<M>, CodecError>) {
        match sealed {
            Ok(sealed) => session::answer(&self.query, sealed.into_bytes()),
            Err(e) => tracing::error!("a reply of kind {} was not sent: {e}", M::NAME),
        }
    }
}

/// What a thread of these is given.
enum Work {
    Query(Query),
    /// A query of so many bytes was too long, and who is told.
    TooLong(usize, Arc<dyn Fn(usize) + Send + Sync>),
}

/// Threads and the queue to them, for the requests `R`. The threads end when this and everything that it declared are dropped.
#[derive(Debug)]
pub struct QueryWorkers<R> {
    work: Sender<Work>,
    waiting_bytes: Arc<AtomicUsize>,
    threads: Vec<JoinHandle<()>>,
    request: PhantomData<fn() -> R>,
}

impl<R: Request + 'static> QueryWorkers<R> {
    /// Starts `threads` threads, each of which answers one request of the run `spec_hash` after the other with `answer`.
    pub fn start(
        name: &str,
        threads: usize,
        spec_hash: u64,
        answer: impl Fn(Incoming<R>) + Clone + Send + 'static,
    ) -> std::io::Result<Self> {
        let (work, waiting) = crossbeam_channel::bounded::<Work>(WAITING_MAX);
        let waiting_bytes = Arc::<AtomicUsize>::default();
        let thread = |i: usize| {
            let (waiting, answer, bytes) = (waiting.clone(), answer.clone(), waiting_bytes.clone());
            let point = name.to_owned();
            let next = move || {
                fail_point::reach(&point);
                waiting.recv().ok()
            };
            let handle = move |work| match work {
                Work::Query(query) => {
                    bytes.fetch_sub(payload_bytes(&query), Ordering::Relaxed);
                    answer(Incoming {
                        query,
                        spec_hash,
                        request: PhantomData,
                    });
                }
                Work::TooLong(bytes, refused) => refused(bytes),
            };
            std::thread::Builder::new()
                .name(format!("{name}-{i}"))
                .spawn(move || std::iter::from_fn(next).for_each(handle))
        };
        let threads = (0..threads).map(thread).collect::<Result<_, _>>()?;
        Ok(Self {
            work,
            waiting_bytes,
            threads,
            request: PhantomData,
        })
    }

    /// Takes the requests in the client's run, until the result is dropped, of at most `bytes_max` bytes: longer ones are dropped before
    /// anything is copied, and `refused` is told their bytes. No other process need be asked: the reply is complete.
    pub fn declare(
        &self,
        client: &RunClient,
        bytes_max: usize,
        refused: impl Fn(usize) + Send + Sync + 'static,
    ) -> zenoh::Result<Queryable<()>> {
        let (work, waiting_bytes) = (self.work.clone(), self.waiting_bytes.clone());
        let refused: Arc<dyn Fn(usize) + Send + Sync> = Arc::new(refused);
        let take = move |query: Query| {
            let bytes = payload_bytes(&query);
            if bytes > bytes_max {
                // Where it finds no room, it is one of very many.
                let _ = work.try_send(Work::TooLong(bytes, refused.clone()));
                return;
            }
            let before = waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
            // A dropped query ends: its sender is told at once.
            if before > WAITING_BYTES_MAX || work.try_send(Work::Query(query)).is_err() {
                waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
                tracing::debug!("more queries than can wait; the sender retries");
            }
        };
        let queryable = client.session().declare_queryable(client.keys().of::<R>());
        queryable.complete(true).callback(take).wait()
    }

    /// The threads, to be waited for.
    pub fn into_threads(self) -> Vec<JoinHandle<()>> {
        self.threads
    }
}

fn payload_bytes(query: &Query) -> usize {
    query.payload().map_or(0, ZBytes::len)
}
