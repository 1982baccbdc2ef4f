//! Threads that answer queries, so that the threads on which zenoh receives never block.
//! Each process supplies the function that replies.
//!
//! zenoh calls back on the thread that reads the socket. A callback that sends megabytes or waits would stop the reading. If the other side
//! were sending too, both sides would deadlock.

use std::{
    marker::PhantomData,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    thread::JoinHandle,
};

use zenoh::{
    Wait,
    bytes::ZBytes,
    query::{Query, Queryable},
};

use crate::{
    client::{EncodedMessage, RunClient},
    messages::recovering::Recovering,
    process::{fail_point, spawn},
    session,
    wire::{
        buffers::{Buffer, BufferPool},
        codec,
        error::CodecError,
        keys::Keys,
        message::{Message, Request},
    },
};

/// Most queries in the queue. A query beyond this is dropped; its sender is notified at once and retries.
const QUEUE_MAX: usize = 4096;
/// Payload bytes in the queue after which queries are dropped, a few hundred chunks of Procgen. Only the bytes before a query count, so
/// that a query of any size is answered in the end. The sender of a dropped query retries.
const QUEUE_BYTES_MAX: usize = 1 << 29;

/// A request that has arrived and has yet to be answered.
#[derive(Debug)]
pub struct Incoming<R: Request>(Responder<R::Reply>);

impl<R: Request> Incoming<R> {
    /// Reads a request without payload.
    pub fn read(&self) -> Result<R, CodecError> {
        let read = self.receive(&BufferPool::new(0));
        read.map(|(request, _)| request)
    }

    /// Reads a request and copies its payload into private memory from `pool`. A request at another process's key is an error.
    pub fn receive(&self, pool: &BufferPool) -> Result<(R, Buffer), CodecError> {
        let (query, spec_hash) = (&self.0.query, Some(self.0.spec_hash));
        let nothing = ZBytes::new();
        let bytes = query.payload().unwrap_or(&nothing);
        let (request, payload): (R, _) =
            codec::decode_from(bytes.reader(), bytes.len(), pool, spec_hash)?;
        // Where each process has its own key, access control guards only the key, so the request must come at the key of its sender.
        let (key, actor) = (query.key_expr().as_str(), request.actor());
        if R::KEY_PER_ACTOR && Keys::parse_actor(key) != actor {
            let key = key.to_owned();
            return Err(CodecError::Actor { actor, key });
        }
        Ok((request, payload))
    }

    /// Returns the responder that sends the reply.
    pub fn into_responder(self) -> Responder<R::Reply> {
        self.0
    }
}

/// Sends one reply of type `M`. If it is dropped without a reply, the sender of the query is notified at once.
#[derive(Debug)]
pub struct Responder<M> {
    query: Query,
    spec_hash: u64,
    reply: PhantomData<fn() -> M>,
}

impl<M: Message> Responder<M> {
    /// Sends the reply. A failure is logged, and the requester retries.
    pub fn reply(self, reply: &M) {
        self.send(EncodedMessage::new(reply, self.spec_hash));
    }

    /// Sends the reply with a payload, like [`Responder::reply`].
    pub fn reply_with(self, reply: &M, payload: ZBytes) {
        self.send(EncodedMessage::with_payload(reply, payload, self.spec_hash));
    }

    /// Answers, in place of a reply, that the replay is still being read back from disk.
    pub fn retry_later(self, recovering: &Recovering) {
        match EncodedMessage::new(recovering, self.spec_hash) {
            Ok(encoded) => session::reply_error(&self.query, encoded.into_bytes()),
            Err(e) => tracing::error!("a reply about the recovery was not sent: {e}"),
        }
    }

    fn send(&self, encoded: Result<EncodedMessage<M>, CodecError>) {
        match encoded {
            Ok(encoded) => session::answer(&self.query, encoded.into_bytes()),
            Err(e) => tracing::error!("a reply of kind {} was not sent: {e}", M::NAME),
        }
    }
}

/// An item in the queue of the threads.
enum Work {
    Query(Query),
    /// A rejected query: the bytes of its payload.
    Rejected(usize),
}

/// Answers requests `R` of the client's run until the returned queryable is dropped, which also ends the returned threads. Each of `threads`
/// threads calls `answer` for one request after another. The reply is complete: zenoh need query no other process.
///
/// A request of more than `bytes_max` bytes is dropped before anything is copied, and `on_rejected` is called with its bytes.
pub fn answer_queries<R: Request + 'static>(
    client: &RunClient,
    name: &str,
    threads: usize,
    bytes_max: usize,
    answer: impl Fn(Incoming<R>) + Clone + Send + 'static,
    on_rejected: impl Fn(usize) + Clone + Send + 'static,
) -> zenoh::Result<(Queryable<()>, Vec<JoinHandle<()>>)> {
    let spec_hash = client.spec_hash();
    let (work, queue) = crossbeam_channel::bounded::<Work>(QUEUE_MAX);
    let queued_bytes = Arc::<AtomicUsize>::default();
    let thread = |i: usize| {
        let (queue, bytes) = (queue.clone(), queued_bytes.clone());
        let (answer, on_rejected) = (answer.clone(), on_rejected.clone());
        let point = name.to_owned();
        let next = move || {
            fail_point::reach(&point);
            queue.recv().ok()
        };
        let handle = move |work| match work {
            Work::Query(query) => {
                bytes.fetch_sub(payload_bytes(&query), Ordering::Relaxed);
                answer(Incoming(Responder {
                    query,
                    spec_hash,
                    reply: PhantomData,
                }));
            }
            Work::Rejected(bytes) => on_rejected(bytes),
        };
        let work = move || std::iter::from_fn(next).for_each(handle);
        spawn(format!("{name}-{i}"), work)
    };
    let threads = (0..threads).map(thread).collect::<Result<_, _>>()?;
    let enqueue = move |query: Query| {
        let bytes = payload_bytes(&query);
        if bytes > bytes_max {
            // If the queue is full, this report is lost; it is one of very many.
            let _ = work.try_send(Work::Rejected(bytes));
            return;
        }
        let before = queued_bytes.fetch_add(bytes, Ordering::Relaxed);
        // Dropping a query notifies its sender at once.
        if before > QUEUE_BYTES_MAX || work.try_send(Work::Query(query)).is_err() {
            queued_bytes.fetch_sub(bytes, Ordering::Relaxed);
            tracing::debug!("more queries than can wait; the sender retries");
        }
    };
    let queryable = client.session().declare_queryable(client.keys().key::<R>());
    let queryable = queryable.complete(true).callback(enqueue).wait()?;
    Ok((queryable, threads))
}

fn payload_bytes(query: &Query) -> usize {
    query.payload().map_or(0, ZBytes::len)
}
