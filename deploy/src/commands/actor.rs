//! `driml actor`: one actor of a run.

use clap::Args;
use driml_envs::EnvError;
use driml_launch::endpoint::check_connect_endpoints;
use driml_machine::{error::usage, whole_number};
use driml_protocol::{Shutdown, config::ConfigError, tls::Role};
use driml_settings::presets;

use super::join::{JoinFlags, TlsFlags, clean_up_after, prepare_join};

#[derive(Debug, Args)]
pub(crate) struct ActorArgs {
    /// Endpoint of the replay server, such as tcp/10.0.0.1:7447; may be given several times
    #[arg(long, value_name = "ENDPOINT", required = true)]
    pub(crate) connect: Vec<String>,
    /// Id of this actor, unique in the run; env:NAME takes it from the environment, such as env:SLURM_PROCID or
    /// env:JOB_COMPLETION_INDEX
    #[arg(long, value_name = "N", default_value = "0", value_parser = actor_id)]
    pub(crate) id: u32,
    /// Environments [default: from the run's settings]
    #[arg(long, value_name = "N", value_parser = whole_number::within_u32(1..=4096))]
    pub(crate) envs: Option<u32>,
    /// Command or library of the run's world on this machine, if it is exec:COMMAND or libenv:PATH:GAME; an actor never runs what
    /// a replay server sends
    #[arg(long, value_name = "WORLD")]
    pub(crate) env: Option<String>,
    #[command(flatten)]
    pub(crate) tls: TlsFlags,
    #[command(flatten)]
    pub(crate) join: JoinFlags,
}

/// Parses an actor's number, or `env:NAME`, where the environment variable NAME holds the number.
fn actor_id(text: &str) -> Result<u32, String> {
    let Some(name) = text.strip_prefix("env:") else {
        let hint =
            "give a whole number from 0, or env:NAME for an environment variable that holds one";
        return text.parse().map_err(|_| hint.into());
    };
    let value = std::env::var(name);
    let number = value.as_ref().ok().and_then(|it| it.trim().parse().ok());
    number.ok_or_else(|| {
        let is = value.map_or("not set".into(), |it| format!("{it:?}"));
        format!("the environment variable {name} is {is}: set it to a whole number from 0")
    })
}

pub(crate) fn run(args: ActorArgs) -> anyhow::Result<()> {
    check_connect_endpoints(&args.connect, args.tls.is_set())?;
    let (role, namespace) = (Role::Actor(args.id), &args.join.namespace);
    let connection = args.tls.connection(role, namespace, args.connect)?;
    let world = args.env.as_deref().map(presets::world).transpose();
    let world = world.map_err(|e| usage!("--env: {e}"))?;
    let shutdown = prepare_join(&args.join, Shutdown::on_signals)?;
    let run = driml_actor::RunArgs {
        connection,
        actor: args.id,
        envs: args.envs,
        world,
    };
    clean_up_after(driml_actor::run(run, &shutdown).map_err(|e| {
        // Another start would find the same settings.
        let is_setting = matches!(e.downcast_ref(), Some(EnvError::Config(_)));
        match is_setting || e.is::<ConfigError>() {
            true => usage!("{e:#}").into(),
            false => e,
        }
    }))
}
