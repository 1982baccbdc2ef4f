//! What is wrong with a certificate or a key, and what to do: a sentence each.
//! It checks nothing.

use std::path::PathBuf;

use super::role::{ACTORS_MAX, Role};

/// Why a process cannot use its certificate.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A number beyond what certificates can name.
    #[error(
        "actor {number} has no certificate: with --tls-dir actors have the numbers 0 to {last}, see --id",
        last = ACTORS_MAX - 1
    )]
    Number {
        /// The actor's number.
        number: u32,
    },
    /// A file that is not there.
    #[error(
        "{} is not there: the role {role} needs ca.pem, {role}.pem and {role}.key; `deploy/certs.sh {}` makes them, \
         beside the authority's key, and you copy them here",
        .path.display(), how(.path, *.role)
    )]
    Missing {
        /// The file of the certificate or key.
        path: PathBuf,
        /// Whose it is.
        role: Role,
    },
    /// A file that cannot be read.
    #[error("{} cannot be read: {why}; it belongs to the user who starts this part", .path.display())]
    Unreadable {
        /// The file of the certificate or key.
        path: PathBuf,
        /// What the system said.
        why: std::io::Error,
    },
    /// A file with something else in it.
    #[error(
        "{} holds no {what} in PEM: `deploy/certs.sh` makes such files; copy it again, or remove it and make it anew",
        .path.display()
    )]
    NotPem {
        /// The file of the certificate or key.
        path: PathBuf,
        /// What was expected.
        what: &'static str,
    },
    /// A key of another certificate.
    #[error(
        "{} is not the key of {}: they were made at different times; remove both and `deploy/certs.sh {}` makes them anew",
        .key.display(), .certificate.display(), how(.certificate, *.role)
    )]
    OtherKey {
        /// The key.
        key: PathBuf,
        /// The certificate.
        certificate: PathBuf,
        /// Whose they are.
        role: Role,
    },
    /// A certificate of another role.
    #[error(
        "{} is the certificate of {have:?}, not of {role:?}: each part has its own; `deploy/certs.sh {}` makes it",
        .path.display(), how(.path, *.role), have = .have, role = .role.to_string()
    )]
    OtherRole {
        /// The certificate.
        path: PathBuf,
        /// Its common name.
        have: String,
        /// The role that it is needed for.
        role: Role,
    },
    /// A certificate that is no longer good.
    #[error(
        "{} expired at {when}: remove it and its key, and `deploy/certs.sh {}` makes new ones; if it did not, this machine's clock is wrong",
        .path.display(), how(.path, *.role)
    )]
    Expired {
        /// The certificate.
        path: PathBuf,
        /// Until when it was good.
        when: String,
        /// Whose it is.
        role: Role,
    },
    /// A certificate that is not good yet.
    #[error(
        "{} is valid only from {when} on: this machine's clock is wrong, or that of the machine on which it was made",
        .path.display()
    )]
    NotYet {
        /// The certificate.
        path: PathBuf,
        /// From when on it is good.
        when: String,
    },
    /// A certificate of another authority.
    #[error(
        "{} was not signed by the authority of {} ({why}): take both from the same run of `deploy/certs.sh`",
        .path.display(), .authority.display()
    )]
    OtherAuthority {
        /// The certificate.
        path: PathBuf,
        /// The authority's.
        authority: PathBuf,
        /// What the check said.
        why: String,
    },
}

/// The arguments of `deploy/certs.sh` that make the files of `role` beside `path`.
fn how(path: &std::path::Path, role: Role) -> String {
    let folder = path.parent().unwrap_or(path).display();
    format!("{folder} {}", role.how_to_make()).trim_end().into()
}
