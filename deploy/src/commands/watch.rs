//! `driml watch` and `driml status`: show the state of a run, wherever its processes are and however they were started.

use std::path::PathBuf;

use anyhow::bail;
use clap::{ArgGroup, Args};
use driml_launch::{
    endpoint::{DEFAULT_NAMESPACE, check_connect_endpoints},
    run_folder::RunFolder,
    view::Poller,
    watch::{self, StatusFlags, WatchFlags, read_endpoints},
};
use driml_machine::error::usage;
use driml_protocol::tls::Role;

use super::join::TlsFlags;

/// Flags that select a run.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("whose"))]
pub(crate) struct RunSelection {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; once for each of the run's replay shards
    #[arg(long, value_name = "ENDPOINT", group = "whose")]
    connect: Vec<String>,
    /// Folder of a run that `driml train` started on this machine
    #[arg(value_name = "RUN", group = "whose")]
    folder: Option<PathBuf>,
    /// Prefix of the run's keys
    #[arg(long, value_name = "NS", default_value = DEFAULT_NAMESPACE)]
    namespace: String,
    #[command(flatten)]
    tls: TlsFlags,
}

/// A run, and the flags of what to do with it.
#[derive(Debug, Args)]
pub(crate) struct ObserverArgs<F: Args> {
    #[command(flatten)]
    selection: RunSelection,
    #[command(flatten)]
    flags: F,
}

pub(crate) fn run(args: &ObserverArgs<WatchFlags>) -> anyhow::Result<()> {
    let ObserverArgs { selection, flags } = args;
    watch::run(selection.open(), selection.folder().as_ref(), flags)
}

pub(crate) fn status(args: &ObserverArgs<StatusFlags>) -> anyhow::Result<()> {
    let ObserverArgs { selection, flags } = args;
    watch::status(|| selection.open(), selection.folder().as_ref(), flags)
}

impl RunSelection {
    /// Opens a connection to the run. The error may be a [`watch::UnreachableRun`].
    fn open(&self) -> anyhow::Result<Poller> {
        check_connect_endpoints(&self.connect, self.tls.is_set())?;
        let (role, connect) = (Role::Observer, self.endpoints()?);
        let connection = self.tls.connection(role, &self.namespace, connect)?;
        let opened = Poller::open(&connection);
        if opened.is_err() {
            // The run may have ended meanwhile.
            self.endpoints()?;
        }
        opened
    }

    fn endpoints(&self) -> anyhow::Result<Vec<String>> {
        match self.folder() {
            Some(folder) => read_endpoints(&folder),
            None if self.connect.is_empty() => bail!(usage!(
                "no run is named: give its folder, or its replay server with --connect"
            )),
            None => Ok(self.connect.clone()),
        }
    }

    fn folder(&self) -> Option<RunFolder> {
        self.folder.as_ref().map(RunFolder::new)
    }
}
