//! Mutual TLS between machines: a certificate for each process, whose common name is its role, and what each role may do.
//! It makes no certificates: `deploy/certs.sh` does.
//!
//! It is the TLS 1.3 inside QUIC. zenoh has TLS over TCP too, whose link in 1.10.2 reads and writes one rustls connection from two
//! threads without a lock (<https://github.com/eclipse-zenoh/zenoh/issues/2557>): with a learner and an actor on 2 cores a link was
//! closed after 2 s and the replay server ended by an invalid instruction after 4 s. QUIC has a stream for each direction.
//!
//! zenoh's access control compares common names as a whole, it knows no patterns. So each actor has its own name, `actor-N`,
//! and the replay server has rules for each number below [`ACTORS_MAX`].

mod access;
mod credentials;

pub(crate) use access::rules;
pub use access::{ACTORS_MAX, Role};
pub use credentials::{Credentials, TlsError, authority_path};
