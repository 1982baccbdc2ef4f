//! `driml-learner`: the learner process, the same as `driml learner`.

use std::process::ExitCode;

use clap::Parser;
use driml_learner::RunArgs;
use driml_protocol::Shutdown;

/// The learner of a running DRIML training.
#[derive(Parser)]
#[command(version)]
struct Args {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; may be given several times
    #[arg(long, required = true)]
    connect: Vec<String>,
    /// Where checkpoints go
    #[arg(long)]
    run_dir: std::path::PathBuf,
    /// What computes: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: driml_model::DeviceName,
    /// Prefix of the run's keys
    #[arg(long, default_value = "driml")]
    namespace: String,
}

fn main() -> ExitCode {
    let args = Args::parse();
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .init();
    match run(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("error: {e:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::on_signals(false)?;
    let Args {
        connect,
        run_dir,
        device,
        namespace,
    } = args;
    driml_learner::run(
        RunArgs {
            connect,
            namespace,
            run_dir,
            device,
        },
        &shutdown,
    )
}
