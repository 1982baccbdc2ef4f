//! What can go wrong with the engine, and what to do about it.

use std::io;
use std::path::{Path, PathBuf};

use crate::options::OptionsError;
use crate::release::download_command;

/// What every error about the engine ends with: the way to go on without it.
pub const WITHOUT_ENGINE: &str = "(`--env mspacman` is the world that needs no engine)";

/// Why the engine could not be made or driven.
#[derive(Debug, thiserror::Error)]
pub enum ProcgenError {
    /// The engine is not on this machine and could not be put there.
    #[error(transparent)]
    Install(#[from] InstallError),
    /// The engine is on this machine but cannot be loaded.
    #[error(transparent)]
    Load(#[from] LoadError),
    /// The settings would end the process inside the engine.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// An action, or their number, is not one the engine takes.
    #[error("stepping procgen: {0}")]
    Action(String),
    /// A state belongs to another game, or a copy's number is out of range.
    #[error("moving a procgen state: {0}")]
    State(String),
    /// The engine does not describe its buffers as version 0.10.7 does.
    #[error("procgen's engine is not the one this was written for: {0} {WITHOUT_ENGINE}")]
    Unexpected(String),
}

/// Why the engine's library cannot be loaded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LoadError {
    /// The engine is built for Linux on x86-64 with AVX only.
    #[error("procgen's engine cannot run here: {0} {WITHOUT_ENGINE}")]
    Machine(String),
    /// A system library that the engine needs is missing.
    #[error(
        "loading procgen's engine: the system library {library} is missing; install it with \
         `apt-get install {debian}` (Debian, Ubuntu) or `dnf install {fedora}` (Fedora) {WITHOUT_ENGINE}"
    )]
    MissingLibrary {
        /// The file that the loader looked for.
        library: String,
        /// Packages that hold it on Debian and Ubuntu.
        debian: &'static str,
        /// Package that holds it on Fedora.
        fedora: &'static str,
    },
    /// The system's C or C++ library is older than the engine's.
    #[error(
        "loading procgen's engine: this system's C or C++ library is too old, it needs glibc 2.17 and \
         libstdc++ of gcc 4.6 or later; use a newer distribution; the loader said: {0} {WITHOUT_ENGINE}"
    )]
    TooOld(String),
    /// Anything else that the loader says.
    #[error("loading procgen's engine from {path}: {reason} {WITHOUT_ENGINE}")]
    Other {
        /// The library's file.
        path: PathBuf,
        /// What the loader said.
        reason: String,
    },
}

/// Why the engine is not there and could not be put there.
#[derive(Debug, thiserror::Error)]
pub enum InstallError {
    /// The engine cannot run on this machine at all.
    #[error(transparent)]
    Machine(#[from] LoadError),
    /// No variable says where the cache folder is.
    #[error(
        "procgen's engine has no cache folder: set DRIML_CACHE, XDG_CACHE_HOME or HOME {WITHOUT_ENGINE}"
    )]
    NoCacheFolder,
    /// The engine was never installed.
    #[error("procgen's engine is not installed in {root}: {to_install} {WITHOUT_ENGINE}", to_install = to_install(.root))]
    Missing {
        /// Where it would lie.
        root: PathBuf,
    },
    /// The engine was installed, but something of it is gone or changed.
    #[error("procgen's engine in {root} is damaged ({reason}): {to_install} {WITHOUT_ENGINE}", to_install = to_install(.root))]
    Damaged {
        /// Where it lies.
        root: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Somebody else could put other code in its place.
    #[error(
        "procgen's engine is code that would run as you, and others can change {path}: {why}. Make it yours alone \
         (`chown -R \"$(id -u)\" {path}` as root, `chmod -R go-w {path}`), or set DRIML_CACHE to a folder that is {WITHOUT_ENGINE}",
        path = .path.display()
    )]
    Shared {
        /// The file or folder.
        path: PathBuf,
        /// Who can change it.
        why: String,
    },
    /// It would have to be fetched, which `DRIML_OFFLINE=1` forbids.
    #[error("DRIML_OFFLINE=1 forbids fetching procgen's engine, and {reason}: {to_install} {WITHOUT_ENGINE}", to_install = to_install(.root))]
    Offline {
        /// Where it would lie.
        root: PathBuf,
        /// What is wrong with what lies there.
        reason: String,
    },
    /// There is no pip to fetch it with.
    #[error(
        "fetching procgen's engine: none of `pip`, `pip3` and `python3 -m pip` works here; install pip \
         (`apt-get install python3-pip`, `dnf install python3-pip`) {WITHOUT_ENGINE}"
    )]
    NoPip,
    /// pip ran and failed.
    #[error(
        "fetching procgen's engine: `{pip} download` failed ({status}); is the network reachable? It said:\n  \
         {output}\n{WITHOUT_ENGINE}"
    )]
    PipFailed {
        /// The pip that ran.
        pip: String,
        /// How it ended.
        status: String,
        /// The last lines it printed.
        output: String,
    },
    /// The wheel is not the pinned one.
    #[error(
        "{path} is not the wheel this was written for: its SHA-256 is {actual}, expected {expected}; \
         delete it and check which package index pip uses {WITHOUT_ENGINE}"
    )]
    WrongHash {
        /// Where the wheel's file lies.
        path: PathBuf,
        /// The pinned hash.
        expected: String,
        /// The file's hash.
        actual: String,
    },
    /// The wheel cannot be unpacked.
    #[error("unpacking {path}: {reason}; delete it and fetch it again {WITHOUT_ENGINE}")]
    BadWheel {
        /// Where the wheel's file lies.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Another build of the library that is not there.
    #[error("the library {}, another build of Procgen's, cannot be found: {reason}", library.display())]
    NoLibrary {
        /// The path that was given.
        library: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// Another build of the library, without the pictures that it reads.
    #[error(
        "the library {} is no engine without its pictures: put Procgen's folder `assets` beside it or beside its folder", library.display()
    )]
    NoAssets {
        /// The library's file.
        library: PathBuf,
    },
    /// The file system refused something.
    #[error("installing procgen's engine: {doing} {path}: {source} {WITHOUT_ENGINE}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// With which file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl InstallError {
    pub(crate) fn io(doing: &'static str, path: &Path, source: io::Error) -> InstallError {
        InstallError::Io {
            doing,
            path: path.to_owned(),
            source,
        }
    }
}

/// How to get the engine into `root`, with and without a network.
fn to_install(root: &Path) -> String {
    let cache = root.parent().unwrap_or(root);
    let command = download_command(cache);
    format!(
        "run with network access and without DRIML_OFFLINE, or fetch the wheel where there is a network with `{command}` and put it into {}",
        cache.display()
    )
}
