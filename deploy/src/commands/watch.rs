//! `driml watch` and `driml status`: how a run goes, on whatever machines its processes are and however they were started.

use std::path::PathBuf;

use anyhow::ensure;
use clap::{ArgGroup, Args};
use driml_launch::{
    endpoint::{NAMESPACE, check_endpoints},
    run_folder::RunFolder,
    view::Poller,
    watch::{self, Live, Outputs, Over, endpoints_of},
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

#[derive(Debug, Args)]
pub(crate) struct WatchArgs {
    #[command(flatten)]
    look: LookFlags,
    /// Write settings, metrics and summary into this folder; a folder of the same run is continued
    #[arg(long, value_name = "DIR")]
    pub(crate) run_dir: Option<PathBuf>,
    /// Write TensorBoard events into that folder
    #[arg(long, requires = "run_dir")]
    pub(crate) tensorboard: bool,
    /// Print the page of `driml status` and exit: with code 0 if no process is missing, else 1
    #[arg(long, conflicts_with = "run_dir")]
    pub(crate) once: bool,
    /// With --once, print one JSON object
    #[arg(long, requires = "once")]
    pub(crate) json: bool,
    /// Replace this file with the metrics in Prometheus' text format, once a second; for node_exporter's textfile collector, which
    /// reads files named *.prom
    #[arg(long, value_name = "FILE")]
    pub(crate) prometheus: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    look: LookFlags,
    /// Repeat every two seconds until the run is over or Ctrl-C
    #[arg(long)]
    pub(crate) watch: bool,
    /// Print one JSON object per answer
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: &WatchArgs) -> anyhow::Result<()> {
    let opened = args.look.open();
    if !matches!(opened, Ok(Ok(_)))
        && let Some(path) = &args.prometheus
    {
        watch::write_down(path)?;
    }
    let poller = match opened? {
        Ok(poller) => poller,
        Err(over) => {
            over.print(args.json)?;
            let is_well = over.is_well || !args.once;
            ensure!(
                is_well,
                "the run needs attention: it is not finished and no process of it runs"
            );
            return Ok(());
        }
    };
    let outputs = Outputs {
        run_dir: args.run_dir.as_ref().map(RunFolder::new),
        tensorboard: args.tensorboard,
        prometheus: args.prometheus.clone(),
    };
    match args.once {
        true => watch::once(poller, &outputs, args.json),
        false => watch::run(poller, &outputs),
    }
}

pub(crate) fn status(args: &StatusArgs) -> anyhow::Result<()> {
    match args.look.open()? {
        Ok(mut poller) => {
            let folder = args.look.folder();
            watch::look(&mut poller, folder.as_ref(), args.watch, args.json)
        }
        Err(over) => over.print(args.json),
    }
}

impl LookFlags {
    /// A connection to the run, or how it stands if it cannot be asked.
    fn open(&self) -> anyhow::Result<Result<Poller, Box<Over>>> {
        check_endpoints(&self.connect, self.tls.is_set())?;
        let credentials = self.tls.credentials(Role::Observer)?;
        let endpoints = match self.live()? {
            None => self.connect.clone(),
            Some(Live::At(endpoints)) => endpoints,
            Some(Live::Over(over)) => return Ok(Err(over)),
        };
        let opened = Poller::open(&endpoints, &self.namespace, credentials.as_deref());
        // It may have ended meanwhile.
        if opened.is_err()
            && let Some(Live::Over(over)) = self.live()?
        {
            return Ok(Err(over));
        }
        opened.map(Ok)
    }

    /// How the run stands by its folder, if one was given.
    fn live(&self) -> anyhow::Result<Option<Live>> {
        self.folder().map(|it| endpoints_of(&it)).transpose()
    }

    fn folder(&self) -> Option<RunFolder> {
        self.run.as_ref().map(RunFolder::new)
    }
}
