//! `driml-actor`: one actor process, the same as `driml actor`.

use std::process::ExitCode;

use clap::Parser;
use driml_actor::RunArgs;
use driml_protocol::Shutdown;

/// One actor of a running DRIML training.
#[derive(Parser)]
#[command(version)]
struct Args {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; may be given several times
    #[arg(long, required = true)]
    connect: Vec<String>,
    /// Which actor this is; unique in the run
    #[arg(long, default_value_t = 0)]
    id: u32,
    /// Copies of the world, if not as many as the run's settings say
    #[arg(long)]
    envs: Option<u32>,
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
        id,
        envs,
        namespace,
    } = args;
    driml_actor::run(
        RunArgs {
            connect,
            namespace,
            actor: id,
            envs,
        },
        &shutdown,
    )
}
