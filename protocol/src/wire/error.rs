//! Why bytes from another process were refused: each fault with a sentence, and what to do where something can be done.
//! A refused message is never a panic.

/// Why bytes were refused. None of these is ever a panic.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum CodecError {
    /// Fewer or more bytes than the prefix promises.
    #[error(
        "the message has {have} bytes, not the {need} that it needs: it was cut off or padded on the way"
    )]
    Length {
        /// Bytes at hand.
        have: usize,
        /// Bytes that the prefix promises.
        need: usize,
    },
    /// Not one of our messages.
    #[error(
        "the message does not start with DRML: the sender is not part of DRIML, or the bytes were damaged"
    )]
    Magic,
    /// Another protocol version.
    #[error(
        "the sender speaks protocol version {theirs}, this process version {ours}: run the same build of driml everywhere"
    )]
    Version {
        /// What the message says.
        theirs: u16,
        /// What this process has, or expects here.
        ours: u16,
    },
    /// Another kind than this place takes.
    #[error("a message of kind {theirs} came where kind {ours} is expected")]
    Kind {
        /// What the message says.
        theirs: u16,
        /// What this process has, or expects here.
        ours: u16,
    },
    /// A message of a run with other settings.
    #[error(
        "the message belongs to run spec {theirs:016x}, this process runs {ours:016x}: start every process with the same settings, or let actors and learner fetch them with --connect"
    )]
    RunSpec {
        /// The hash in the message.
        theirs: u64,
        /// What this process has, or expects here.
        ours: u64,
    },
    /// A message of one actor at the key of another.
    #[error(
        "the message speaks for {} at the key {key:?}: each process speaks for itself alone",
        .actor.map_or("the learner".into(), |actor| format!("actor {actor}"))
    )]
    Actor {
        /// Whom the message speaks for; none is the learner.
        actor: Option<u32>,
        /// Where it came.
        key: String,
    },
    /// Bytes that were changed on the way.
    #[error("the message's checksum is wrong: it was damaged on the way")]
    Checksum,
    /// A header that does not decode, or is inconsistent with its payload.
    #[error("the message's header makes no sense: {0}")]
    Header(String),
    /// Larger than a message may be.
    #[error(
        "the message has {have} bytes, more than the {max} allowed: use smaller chunks or batches"
    )]
    TooLarge {
        /// Bytes at hand.
        have: usize,
        /// The most that both sides accept.
        max: usize,
    },
}

impl CodecError {
    /// Refuses more than `max` bytes.
    pub(crate) const fn check_size(have: usize, max: usize) -> Result<(), Self> {
        match have > max {
            true => Err(Self::TooLarge { have, max }),
            false => Ok(()),
        }
    }
}
