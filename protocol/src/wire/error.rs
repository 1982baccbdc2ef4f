//! Why bytes from another process were rejected: each fault with a sentence, and a remedy if there is one.
//! Rejected bytes never cause a panic.

use std::fmt::Display;

/// Why a message was rejected, by its receiver or before it was sent.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[allow(missing_docs, reason = "each message says it")]
pub enum CodecError {
    #[error(
        "the message has {have} bytes, not the {need} that it needs: it was cut off or padded on the way"
    )]
    Length { have: usize, need: usize },
    #[error(
        "the message does not start with DRML: the sender is not part of DRIML, or the bytes were damaged"
    )]
    Magic,
    #[error(
        "the sender speaks protocol version {theirs}, this process version {ours}: run the same build of driml everywhere"
    )]
    Version { theirs: u16, ours: u16 },
    #[error("a message of kind {theirs} came where kind {ours} is expected")]
    Kind { theirs: u16, ours: u16 },
    #[error(
        "the message belongs to run spec {theirs:016x}, this process runs {ours:016x}: start every process with the same settings, or let actors and learner fetch them with --connect"
    )]
    RunSpec { theirs: u64, ours: u64 },
    #[error(
        "the message is in the name of {}, but came at the key {key:?}: a process sends only in its own name",
        .actor.map_or("the learner".into(), |actor| format!("actor {actor}"))
    )]
    Actor { actor: Option<u32>, key: String },
    #[error("the message's checksum is wrong: it was damaged on the way")]
    Checksum,
    #[error("the message's header is invalid: {0}")]
    Header(String),
    #[error(
        "the message has {have} bytes, more than the {max} allowed: use smaller chunks or batches"
    )]
    TooLarge { have: usize, max: usize },
}

impl CodecError {
    /// Returns [`CodecError::Header`] with the reason `why`, unless `is_valid`.
    pub(crate) fn check(is_valid: bool, why: impl Display) -> Result<(), Self> {
        match is_valid {
            true => Ok(()),
            false => Err(Self::Header(why.to_string())),
        }
    }

    pub(crate) const fn check_size(have: usize, max: usize) -> Result<(), Self> {
        match have > max {
            true => Err(Self::TooLarge { have, max }),
            false => Ok(()),
        }
    }
}
