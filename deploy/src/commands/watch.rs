//! `driml watch`: how a run goes, wherever its parts are and whoever started them.

use std::path::PathBuf;

use clap::Args;
use driml_launch::{
    console,
    endpoint::{NAMESPACE, check_endpoints},
    run_folder::RunFolder,
    status::{Connection, Live, endpoints_of},
    watch::{self, Outputs},
};
use driml_protocol::tls::Role;

use super::join::TlsFlags;

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("whose").required(true))]
pub(crate) struct WatchArgs {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; once for each of the run's replay shards
    #[arg(long, value_name = "ENDPOINT", group = "whose")]
    pub(crate) connect: Vec<String>,
    /// Folder of a run that `driml local` started on this machine
    #[arg(long, value_name = "DIR", group = "whose")]
    pub(crate) run: Option<PathBuf>,
    /// Write settings, metrics and summary there, as `driml local` does; a folder that holds the same run is gone on with
    #[arg(long, value_name = "DIR")]
    pub(crate) run_dir: Option<PathBuf>,
    /// Write events for TensorBoard too, in that folder
    #[arg(long, requires = "run_dir")]
    pub(crate) tensorboard: bool,
    /// One look and out, as `driml status` prints it; the exit code is 0 if nothing is missing, else 1
    #[arg(long, conflicts_with = "run_dir")]
    pub(crate) once: bool,
    /// With --once: print one JSON object
    #[arg(long, requires = "once")]
    pub(crate) json: bool,
    /// Write the numbers into this file in Prometheus' text format at each answer, whole or not at all: for node_exporter's textfile
    /// collector, which reads files named *.prom
    #[arg(long, value_name = "FILE")]
    pub(crate) prometheus: Option<PathBuf>,
    /// Prefix of the run's keys
    #[arg(long, value_name = "NS", default_value = NAMESPACE)]
    pub(crate) namespace: String,
    #[command(flatten)]
    pub(crate) tls: TlsFlags,
}

/// Watches until the run is over.
///
/// # Errors
/// A call that cannot work, nobody there, or a folder that cannot be written to.
pub(crate) fn run(args: &WatchArgs) -> anyhow::Result<()> {
    check_endpoints(&args.connect, args.tls.is_set())?;
    let credentials = args.tls.credentials(Role::Observer)?;
    let endpoints = match &args.run {
        None => args.connect.clone(),
        Some(folder) => match endpoints_of(&RunFolder::new(folder))? {
            Live::At(endpoints) => endpoints,
            Live::Over(how) => return console::print(&how),
        },
    };
    let connection = Connection::open(&endpoints, &args.namespace, credentials.as_deref())?;
    let outputs = Outputs {
        run_dir: args.run_dir.as_ref().map(RunFolder::new),
        tensorboard: args.tensorboard,
        prometheus: args.prometheus.clone(),
    };
    match args.once {
        true => watch::once(connection, &outputs, args.json),
        false => watch::run(connection, &outputs),
    }
}
