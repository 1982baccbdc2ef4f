//! `driml replay-server`: the replay server of a run, which sends the settings to the other processes.

use std::path::PathBuf;

use clap::Args;
use driml_launch::{
    endpoint::{check_connect_endpoints, check_listen_endpoints, check_unused},
    open_files,
    output::check_folder,
    view::Poller,
};
use driml_machine::{error::usage, resources::Machine, units::count};
use driml_protocol::{GracefulShutdown, tls::Role};
use driml_replay_server::{Compression, PersistError, kept_size};
use driml_settings::flags::{self, RunFlags, Source};

use super::join::{JoinFlags, KeepAliveFlag, NetworkFlag, TlsFlags, clean_up_after, prepare_join};

#[derive(Debug, Args)]
pub(crate) struct ReplayServerArgs {
    /// Endpoint to listen on, such as tcp/127.0.0.1:7447; may be given several times. For other machines use
    /// quic/HOST:PORT, such as quic/[::]:7447, with --tls-dir
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub(crate) listen: Vec<String>,
    /// Router to connect to as well; not with --tls-dir, because a router does not apply the rules for roles, nor with several shards
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "tls_dir")]
    pub(crate) connect: Vec<String>,
    /// Number of this shard, from 0
    #[arg(long, value_name = "I", default_value_t = 0)]
    pub(crate) shard: u32,
    /// Keep the replay on disk in this folder [default: in memory only]; after a crash, start the server again with the same flags
    #[arg(long, value_name = "DIR")]
    pub(crate) replay_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) run: RunFlags,
    #[command(flatten)]
    pub(crate) lifetime: KeepAliveFlag,
    #[command(flatten)]
    pub(crate) tls: TlsFlags,
    #[command(flatten)]
    pub(crate) network: NetworkFlag,
    #[command(flatten)]
    pub(crate) join: JoinFlags,
}

pub(crate) fn run(mut args: ReplayServerArgs) -> anyhow::Result<()> {
    check_listen_endpoints(&args.listen, args.tls.is_set(), args.network.allow_insecure)?;
    check_unused(&args.listen)?;
    check_connect_endpoints(&args.connect, args.tls.is_set())?;
    let (role, namespace) = (Role::ReplayServer, &args.join.namespace);
    let mut connection = args.tls.connection(role, namespace, args.connect.clone())?;
    if Poller::open(&connection).is_ok() {
        let why = "another replay server of this --namespace answers there, and each message would go to both: stop it, or choose another";
        return Err(usage!("--connect {}: {why}", args.connect.join(" ")).into());
    }
    connection.endpoints.listen.clone_from(&args.listen);
    args.run.flags.server_alone = true;
    let machine = Machine::detect();
    let (mut config, from) = flags::resolve(&args.run, &machine)?;
    if let (None, Some(dir)) = (&args.run.config, &args.replay_dir)
        && let Some(kept) = kept_size(dir, args.shard, config.replay.shards)
    {
        // An earlier start may have found more free memory, and a smaller replay would delete transitions.
        let (dir, capacity) = (dir.display(), kept.capacity_transitions);
        tracing::info!("the replay in {dir} holds up to {capacity} transitions");
        let mut sets = vec![format!("replay.capacity_transitions={capacity}")];
        if config.replay.compression != Compression::None {
            // Without a limit, all frames fitted.
            let all = capacity.saturating_mul(config.run.frame_bytes() as u64);
            let bytes = kept.compressed_bytes_max.unwrap_or(all);
            sets.push(format!("replay.compressed_bytes_max={bytes}"));
        }
        // First, so that the user's own --set replaces them.
        args.run.flags.sets.splice(0..0, sets);
        // These settings say what the world declares, so that its command is not started again.
        let found = Source::File(from, config.to_toml());
        let accuracy_note = config.accuracy_note;
        config = found.resolve(&args.run.flags, &machine)?;
        config.accuracy_note = accuracy_note;
    }
    let (shard, shards) = (args.shard, config.replay.shards);
    if shard >= shards {
        let shards = count(shards, "replay shard");
        let why = "which --replay-shards sets; the first is 0";
        return Err(usage!("--shard {shard} does not exist: the run has {shards}, {why}").into());
    }
    if shards > 1 && !args.connect.is_empty() {
        let why = "replay shards behind one router would each store every transition: leave --connect out";
        return Err(usage!("{why}").into());
    }
    let checked = match &args.replay_dir {
        Some(dir) => {
            check_folder("--replay-dir", dir)?;
            config.replay.check_disk_budget(&config.run)
        }
        None => config.replay.check_in_memory("--replay-dir DIR"),
    };
    checked.map_err(|e| usage!("{e}"))?;
    let shutdown = prepare_join(&args.join, GracefulShutdown::on_signals)?;
    let notes = config.notes.iter().chain(&config.accuracy_note);
    notes.for_each(|it| tracing::warn!("{it}"));
    open_files::warn_if_limit_low(&config);
    let run = driml_replay_server::RunArgs {
        connection,
        shard: args.shard,
        weights_bytes_max: config.weights_bytes()?,
        dir: args.replay_dir,
        keep_alive: args.lifetime.keep_alive,
        drain: shutdown.drain,
        config_toml: config.to_toml(),
    };
    let ran = driml_replay_server::run(run, &shutdown.immediate);
    clean_up_after(ran.map_err(|e| match e.downcast_ref() {
        // The process would find the same again.
        Some(PersistError::Unusable(..)) => usage!("{e:#}").into(),
        _ => e,
    }))
}
