//! One process's connection to a run: queries, replies, publications and subscriptions, each message at its own key.
//! The caller decides what to request, and sets time-outs and retries.

use std::{marker::PhantomData, time::Duration};

use zenoh::{
    Session, Wait, bytes::ZBytes, liveliness::LivelinessToken, pubsub::Subscriber,
    qos::CongestionControl, sample::Sample,
};

use crate::{
    session::{self, PendingReply, SessionError},
    wire::{
        codec,
        error::CodecError,
        keys::{Keys, Peer},
        message::{Keyed, Message, Request},
    },
};

/// A connection to a run: a session, the run's keys and the hash of its spec.
/// Clones share the session.
#[derive(Clone, Debug)]
pub struct RunClient {
    session: Session,
    keys: Keys,
    spec_hash: u64,
}

/// An encoded message of type `M`, which may be sent several times.
#[derive(Clone, Debug)]
pub struct EncodedMessage<M> {
    bytes: ZBytes,
    /// The actor that the message names as its sender, if any.
    actor: Option<u32>,
    message: PhantomData<fn() -> M>,
}

impl<M: Message> EncodedMessage<M> {
    /// Encodes a message without a payload for the run with this hash.
    pub fn new(message: &M, spec_hash: u64) -> Result<Self, CodecError> {
        Self::with_payload(message, ZBytes::new(), spec_hash)
    }

    /// Encodes a message with a payload, which is not copied.
    pub fn with_payload(message: &M, payload: ZBytes, spec_hash: u64) -> Result<Self, CodecError> {
        let head = codec::encode_head(spec_hash, message, &payload.to_bytes())?;
        let mut writer = ZBytes::writer();
        writer.append(ZBytes::from(head));
        writer.append(payload);
        Ok(Self {
            bytes: writer.finish(),
            actor: message.actor(),
            message: PhantomData,
        })
    }

    /// Returns the bytes of prefix, header and payload.
    pub fn into_bytes(self) -> ZBytes {
        self.bytes
    }
}

impl RunClient {
    /// Creates a client of the run with these keys and this hash of its spec.
    pub const fn new(session: Session, keys: Keys, spec_hash: u64) -> Self {
        Self {
            session,
            keys,
            spec_hash,
        }
    }

    /// The session, for everything but sending messages, such as closing it or watching the liveliness of others.
    pub const fn session(&self) -> &Session {
        &self.session
    }

    /// The run's keys.
    pub const fn keys(&self) -> &Keys {
        &self.keys
    }

    /// The hash of the run's spec.
    pub const fn spec_hash(&self) -> u64 {
        self.spec_hash
    }

    /// Sends a request without a payload and waits for its reply.
    ///
    /// # Errors
    /// No process answers, the reply is late, or it cannot be read. In all cases but the last, the caller may retry.
    pub fn ask<R: Request>(
        &self,
        request: &R,
        timeout: Duration,
    ) -> Result<R::Reply, SessionError> {
        self.send(self.encode(request)?, timeout)?.wait()
    }

    /// Fetches a message by an empty query, such as a status.
    pub fn fetch<M: Keyed>(&self, timeout: Duration) -> Result<M, SessionError> {
        self.query::<M, M>(self.keys.key::<M>(), ZBytes::new(), timeout)?
            .wait()
    }

    /// Encodes a request, which may then be sent several times.
    pub fn encode<R: Request>(&self, request: &R) -> Result<EncodedMessage<R>, SessionError> {
        self.encode_with(request, ZBytes::new())
    }

    /// Encodes a request with a payload, which is not copied.
    pub fn encode_with<R: Request>(
        &self,
        request: &R,
        payload: ZBytes,
    ) -> Result<EncodedMessage<R>, SessionError> {
        let encoded = EncodedMessage::with_payload(request, payload, self.spec_hash);
        encoded.map_err(|why| SessionError::Failed(format!("{}: {why}", self.keys.key::<R>())))
    }

    /// Sends a request. Requests of one priority arrive in the order in which they were sent.
    ///
    /// # Errors
    /// zenoh rejects the request. The caller may retry.
    pub fn send<R: Request>(
        &self,
        request: EncodedMessage<R>,
        timeout: Duration,
    ) -> Result<PendingReply<R::Reply>, SessionError> {
        let key = match request.actor {
            Some(actor) => self.keys.actor_key::<R>(actor),
            None => self.keys.learner_key::<R>(),
        };
        self.query::<R, R::Reply>(key, request.bytes, timeout)
    }

    fn query<K: Keyed, M: Message>(
        &self,
        key: String,
        payload: ZBytes,
        timeout: Duration,
    ) -> Result<PendingReply<M>, SessionError> {
        let (session, hash) = (&self.session, Some(self.spec_hash));
        session::send(session, key, payload, K::PRIORITY, timeout, hash)
    }

    /// Publishes a message to all current subscribers. A message that is lost on the way is not sent again.
    pub fn publish<M: Keyed>(&self, message: &M) -> zenoh::Result<()> {
        let encoded = EncodedMessage::new(message, self.spec_hash)?;
        self.session
            .put(self.keys.key::<M>(), encoded.bytes)
            .congestion_control(CongestionControl::Drop)
            .priority(M::PRIORITY)
            .wait()
    }

    /// Calls `on_message` at each publication of `M`, until the returned subscriber is dropped. The call runs on the thread that reads the
    /// socket, so it must not block.
    pub fn subscribe<M: Keyed>(
        &self,
        on_message: impl Fn(Result<M, CodecError>) + Send + Sync + 'static,
    ) -> zenoh::Result<Subscriber<()>> {
        let spec_hash = self.spec_hash;
        self.session
            .declare_subscriber(self.keys.key::<M>())
            .callback(move |sample: Sample| {
                let bytes = sample.payload().to_bytes();
                on_message(codec::decode(&bytes, Some(spec_hash)).map(|(message, _)| message));
            })
            .wait()
    }

    /// Shows other processes that `who` is connected, until the returned token is dropped.
    pub fn declare_alive(&self, who: Peer) -> zenoh::Result<LivelinessToken> {
        let token = self.session.liveliness();
        token.declare_token(self.keys.liveliness_key(who)).wait()
    }
}
