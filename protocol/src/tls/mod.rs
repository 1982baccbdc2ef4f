//! Mutual TLS between machines: a certificate for each process, whose common name is its role, and the rights of each role.
//! `deploy/certs.sh` makes the certificates; this module only uses them.
//!
//! QUIC contains this TLS, version 1.3. zenoh also has TLS over TCP, but in 1.10.2 its link uses one rustls connection from two threads
//! without a lock (<https://github.com/eclipse-zenoh/zenoh/issues/2557>): with a learner and an actor on 2 cores, a link closed after 2 s
//! and the replay server crashed on an invalid instruction after 4 s. QUIC has a stream for each direction.
//!
//! zenoh's access control compares whole common names and has no patterns. So each actor has its own name, `actor-N`, and the replay server
//! has rules for each number below [`ACTORS_MAX`].

mod access;
mod credentials;

pub(crate) use access::access_rules;
pub use access::{ACTORS_MAX, Role};
pub use credentials::{Credentials, TlsError, authority_path};
