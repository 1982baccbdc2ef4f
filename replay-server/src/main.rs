//! `driml-replay-server`: the replay server process, the same as `driml replay-server`.

use std::process::ExitCode;

use clap::Parser;
use driml_protocol::Shutdown;
use driml_replay_server::RunArgs;

/// The replay server of a DRIML training.
#[derive(Parser)]
#[command(version)]
struct Args {
    /// Endpoint to listen on, such as tcp/0.0.0.0:7447; may be given several times
    #[arg(long, required = true)]
    listen: Vec<String>,
    /// The run's resolved settings: a config.toml that driml wrote
    #[arg(long)]
    config: std::path::PathBuf,
    /// Which of the replay's shards this is
    #[arg(long, default_value_t = 0)]
    shard: u32,
    /// Go on after so many updates: those of the learner's newest checkpoint
    #[arg(long, default_value_t = 0)]
    after_updates: u64,
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
        listen,
        config,
        shard,
        after_updates,
        namespace,
    } = args;
    let config_toml = std::fs::read_to_string(&config)
        .map_err(|e| anyhow::anyhow!("reading the settings {}: {e}", config.display()))?;
    let args = RunArgs {
        listen,
        connect: Vec::new(),
        namespace,
        shard,
        after_updates,
        config_toml,
    };
    driml_replay_server::run(args, &shutdown)
}
