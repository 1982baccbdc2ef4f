//! `driml status`: who takes part in a run, who waits for whom, and what it would take to go on.

use std::path::PathBuf;

use clap::Args;
use driml_launch::{
    console,
    endpoint::{NAMESPACE, check_endpoints},
    run_folder::RunFolder,
    status::{self, Connection, Live, endpoints_of},
};
use driml_protocol::tls::Role;

use super::join::TlsFlags;

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("whose").required(true))]
pub(crate) struct StatusArgs {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; once for each of the run's replay shards
    #[arg(long, value_name = "ENDPOINT", group = "whose")]
    pub(crate) connect: Vec<String>,
    /// Folder of a run that `driml local` started on this machine
    #[arg(long, value_name = "DIR", group = "whose")]
    pub(crate) run: Option<PathBuf>,
    /// Ask every two seconds until the run is over or Ctrl-C
    #[arg(long)]
    pub(crate) watch: bool,
    /// Write JSON to stdout, an object for each answer
    #[arg(long)]
    pub(crate) json: bool,
    /// Prefix of the run's keys
    #[arg(long, value_name = "NS", default_value = NAMESPACE)]
    pub(crate) namespace: String,
    #[command(flatten)]
    pub(crate) tls: TlsFlags,
}

/// Asks, and prints the answers.
///
/// # Errors
/// A call that cannot work, or nobody there.
pub(crate) fn run(args: &StatusArgs) -> anyhow::Result<()> {
    check_endpoints(&args.connect, args.tls.is_set())?;
    let credentials = args.tls.credentials(Role::Observer)?;
    let endpoints = match &args.run {
        None => args.connect.clone(),
        Some(folder) => match endpoints_of(&RunFolder::new(folder))? {
            Live::At(endpoints) => endpoints,
            Live::Over(how) => return console::print(&how),
        },
    };
    let mut connection = Connection::open(&endpoints, &args.namespace, credentials.as_deref())?;
    status::run(&mut connection, args.watch, args.json).map(drop)
}
