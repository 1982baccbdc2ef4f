//! What the commands share that look at a run and take no part in it: whose run it is, and how it is reached.

use std::path::PathBuf;

use clap::{ArgGroup, Args};
use driml_launch::{
    console,
    endpoint::{NAMESPACE, check_endpoints},
    run_folder::RunFolder,
    status::{Connection, Live, endpoints_of},
};
use driml_protocol::tls::Role;

use super::join::TlsFlags;

/// Which run is looked at.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("whose").required(true))]
pub(crate) struct LookFlags {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; once for each of the run's replay shards
    #[arg(long, value_name = "ENDPOINT", group = "whose")]
    connect: Vec<String>,
    /// Folder of a run that `driml train` started on this machine
    #[arg(long, value_name = "DIR", group = "whose")]
    run: Option<PathBuf>,
    /// Prefix of the run's keys
    #[arg(long, value_name = "NS", default_value = NAMESPACE)]
    namespace: String,
    #[command(flatten)]
    tls: TlsFlags,
}

impl LookFlags {
    /// A connection to the run; none if it is over, which is then said.
    ///
    /// # Errors
    /// A call that cannot work, or nobody there.
    pub(super) fn open(&self) -> anyhow::Result<Option<Connection>> {
        check_endpoints(&self.connect, self.tls.is_set())?;
        let credentials = self.tls.credentials(Role::Observer)?;
        let folder = self.folder();
        let endpoints = match &folder {
            None => self.connect.clone(),
            Some(folder) => match endpoints_of(folder)? {
                Live::At(endpoints) => endpoints,
                Live::Over(how) => {
                    console::print(&how)?;
                    return Ok(None);
                }
            },
        };
        let opened = Connection::open(&endpoints, &self.namespace, credentials.as_deref());
        // It may have ended meanwhile.
        if let (Err(_), Some(folder)) = (&opened, &folder)
            && let Live::Over(how) = endpoints_of(folder)?
        {
            console::print(&how)?;
            return Ok(None);
        }
        opened.map(Some)
    }

    /// The folder of the run, if it was given.
    pub(super) fn folder(&self) -> Option<RunFolder> {
        self.run.as_ref().map(RunFolder::new)
    }
}
