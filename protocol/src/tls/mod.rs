//! Mutual TLS between machines: a certificate for each part, whose common name is its role, and what each role may do.
//! It makes no certificates: `deploy/certs.sh` does.
//!
//! It is the TLS 1.3 inside QUIC. zenoh has TLS over TCP too, whose link in 1.10.2 reads and writes one rustls connection from two
//! threads without a lock (<https://github.com/eclipse-zenoh/zenoh/issues/2557>): with a learner and an actor on 2 cores a link was
//! closed after 2 s and the replay server ended by an invalid instruction after 4 s. QUIC has a stream for each direction.
//!
//! zenoh's access control compares common names as a whole, it knows no patterns. So each actor has a name of its own, `actor-N`,
//! and the replay server has rules for each number below [`ACTORS_MAX`].

mod access;
mod credentials;
mod handshake;
mod reports;
mod sentences;

pub(crate) use access::rules;
pub use credentials::{Credentials, authority_path};
pub(crate) use handshake::check;
pub use reports::{ACCESS_TARGET, HANDSHAKE_TARGET, Report, listen, overhear};
pub use sentences::TlsError;

/// Actors that certificates can name: 0 to this many, less one. The access rules of all of them are made when a replay server
/// starts, and take memory.
pub const ACTORS_MAX: u32 = 1024;

/// What a part is, and the common name of its certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The actor of this number.
    Actor(u32),
    /// The learner.
    Learner,
    /// A replay server: the side that listens.
    ReplayServer,
    /// Whoever only looks.
    Observer,
}

impl std::fmt::Display for Role {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Actor(number) => write!(f, "actor-{number}"),
            Self::Learner => f.write_str("learner"),
            Self::ReplayServer => f.write_str("replay-server"),
            Self::Observer => f.write_str("observer"),
        }
    }
}

impl Role {
    /// How `deploy/certs.sh` is told to make the certificate of this role in DIR.
    fn how_to_make(self) -> String {
        match self {
            Self::Actor(number) => format!("--actors {}", number.saturating_add(1)),
            Self::ReplayServer => "--host NAME_OR_ADDRESS".into(),
            Self::Learner | Self::Observer => String::new(),
        }
    }
}
