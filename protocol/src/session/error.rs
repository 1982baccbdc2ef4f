//! Why a session could not be opened, or a question not be answered.

use crate::{
    messages::recovering::Recovering, reach::Unreachable, tls::TlsError, wire::error::CodecError,
};

/// Why a message could not be exchanged.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The session could not be opened.
    #[error("opening a zenoh session (listen {listen:?}, connect {connect:?}): {why}")]
    Open {
        /// Endpoints to listen on.
        listen: Vec<String>,
        /// Endpoints to connect to.
        connect: Vec<String>,
        /// What zenoh said.
        why: String,
    },
    /// Nothing accepts connections where the session was to connect.
    #[error(transparent)]
    Unreachable(#[from] Unreachable),
    /// Something listens that does not speak this protocol.
    #[error(
        "something listens on {} that is not driml ({what}): is the endpoint right? If it is, its process may be suspended",
        .connect.join(", ")
    )]
    NotDriml {
        /// Endpoints to connect to.
        connect: Vec<String>,
        /// What it says, or that it says nothing.
        what: String,
    },
    /// No replay server lets this process in over QUIC. Whether none listens or one side rejects the other's certificate is known to
    /// zenoh alone, whose log has it on the side that rejects.
    #[error(
        "no replay server lets this process in on {}: is it running, with --tls-dir, and is the endpoint right (its port is one of UDP)? If \
         so, one side rejects the other's certificate: `driml doctor --tls-dir` on both machines and the replay server's log say why",
        .connect.join(", ")
    )]
    NotLetIn {
        /// Endpoints to connect to.
        connect: Vec<String>,
    },
    /// A certificate is not good.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// No process answers at this key.
    #[error("{key}: no process answers there")]
    NoAnswerer {
        /// Where it was asked.
        key: String,
    },
    /// No answer in time.
    #[error("{key}: no answer within {within_ms} ms")]
    NoReply {
        /// Where it was asked.
        key: String,
        /// How long the reply was waited for.
        within_ms: u128,
    },
    /// The replay server is reading its replay back from disk, and will answer then. It is there: this may be waited for as long as it
    /// takes.
    #[error("{0}")]
    Recovering(Recovering),
    /// A request that is larger than a message may be.
    #[error("{key}: {why}")]
    TooLarge {
        /// Where it was to be asked.
        key: String,
        /// Which limit it is over.
        why: CodecError,
    },
    /// A reply that is damaged, foreign or of another kind.
    #[error("{key}: {why}")]
    Unreadable {
        /// Where it was asked.
        key: String,
        /// What is wrong with it.
        why: CodecError,
    },
    /// zenoh could not send, or the other side replied with an error.
    #[error("{key}: {why}")]
    Zenoh {
        /// Where it was asked.
        key: String,
        /// What zenoh said.
        why: String,
    },
}
