//! `driml learner`: the learner of a run.

use std::path::PathBuf;

use clap::Args;
use driml_launch::{endpoint::check_connect_endpoints, output::check_folder};
use driml_machine::device::{DeviceFlag, check_device};
use driml_protocol::{Shutdown, tls::Role};

use super::join::{JoinFlags, KeepAliveFlag, TlsFlags, clean_up_after, prepare_join};

#[derive(Debug, Args)]
pub(crate) struct LearnerArgs {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; once for each of the run's replay shards
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub(crate) connect: Vec<String>,
    /// Folder of the checkpoints, DIR/checkpoints; a learner resumes from the newest one there
    #[arg(long, value_name = "DIR")]
    pub(crate) run_dir: PathBuf,
    /// Start from the first update, if an earlier learner's checkpoints are lost
    #[arg(long)]
    pub(crate) restart: bool,
    #[command(flatten)]
    pub(crate) on: DeviceFlag,
    #[command(flatten)]
    pub(crate) lifetime: KeepAliveFlag,
    #[command(flatten)]
    pub(crate) tls: TlsFlags,
    #[command(flatten)]
    pub(crate) join: JoinFlags,
}

pub(crate) fn run(args: LearnerArgs) -> anyhow::Result<()> {
    check_connect_endpoints(&args.connect, args.tls.is_set())?;
    check_folder("--run-dir", &args.run_dir)?;
    let (role, namespace) = (Role::Learner, &args.join.namespace);
    let connection = args.tls.connection(role, namespace, args.connect)?;
    check_device(args.on.device)?;
    let shutdown = prepare_join(&args.join, Shutdown::on_signals)?;
    let run = driml_learner::RunArgs {
        connection,
        run_dir: args.run_dir,
        device: args.on.device,
        restart: args.restart,
        keep_alive: args.lifetime.keep_alive,
    };
    clean_up_after(driml_learner::run(run, &shutdown))
}
