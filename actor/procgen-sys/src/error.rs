//! What can go wrong with the engine, and what to do about it.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

/// The end of every error about the engine: names a world that works without the engine.
pub(crate) const WITHOUT_ENGINE: &str = "(`--env mspacman` needs no engine)";

/// Why the engine could not be found, installed, loaded or used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum ProcgenError {
    /// The engine is not installed, or is incomplete. The message says how to get it, with and without a network.
    #[error(
        "procgen's engine in {}: {reason}; run with network access and without DRIML_OFFLINE, or fetch the wheel where there is a network \
         with `{}` and put it into {} {WITHOUT_ENGINE}",
        .root.display(), .fetch_command, .root.parent().unwrap_or(.root).display()
    )]
    Missing {
        root: PathBuf,
        reason: String,
        fetch_command: String,
    },
    /// The cache folder cannot be used: no variable names it, or others can change it.
    #[error("procgen's engine has no safe place: {0} {WITHOUT_ENGINE}")]
    Cache(String),
    #[error("fetching procgen's engine: {0} {WITHOUT_ENGINE}")]
    Fetch(String),
    /// The wheel, or the library in it, is not the pinned one.
    #[error("unpacking {0}; delete it and fetch it again {WITHOUT_ENGINE}")]
    Wheel(String),
    #[error(
        "installing procgen's engine: {doing} {}: {why}; DRIML_CACHE names another folder {WITHOUT_ENGINE}",
        .path.display()
    )]
    Io {
        doing: &'static str,
        path: PathBuf,
        why: io::Error,
    },
    /// The engine is built for Linux on x86-64 with AVX only.
    #[error("procgen's engine cannot run here: {0} {WITHOUT_ENGINE}")]
    Machine(String),
    /// The library is missing, or the loader rejects it.
    #[error("loading procgen's engine from {0} {WITHOUT_ENGINE}")]
    Library(String),
    /// The engine would end the process with these settings. The message says what to do instead.
    #[error("procgen settings: {0}")]
    Options(String),
    /// An action is out of range, or the number of actions is wrong.
    #[error("stepping procgen: {0}")]
    Action(String),
    /// A state belongs to another game, or an environment's number is out of range.
    #[error("moving a procgen state: {0}")]
    State(String),
    /// The engine does not describe its buffers as version 0.10.7 does.
    #[error("procgen's engine is not the one this was written for: {0} {WITHOUT_ENGINE}")]
    Unexpected(String),
}

impl ProcgenError {
    pub(crate) fn library(path: &Path, reason: impl Display) -> ProcgenError {
        ProcgenError::Library(format!("{}: {reason}", path.display()))
    }

    /// Adds to an error of the file system the operation and the path.
    pub(crate) fn io(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> ProcgenError {
        let path = path.to_owned();
        move |why| ProcgenError::Io { doing, path, why }
    }
}
