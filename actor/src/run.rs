//! One actor process: join, act, deliver, until told to stop or no longer needed.
//! The acting itself is `collect`, which knows no network.

use std::time::Duration;

use anyhow::Context;
use driml_protocol::{
    Keys, Shutdown,
    session::{self, Endpoints},
};
use zenoh::Wait;

use crate::{
    collect::{Collector, Life},
    config::ActorSettings,
    delivery::{Delivery, DeliveryLimits},
    weight_watch,
};

/// How long an actor waits for a learner with weights.
const WEIGHTS_WAIT_MAX: Duration = Duration::from_secs(120);

/// What an actor is told at its start; everything else comes from the replay server.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// Endpoints of the replay server.
    pub connect: Vec<String>,
    /// Prefix of the run's keys.
    pub namespace: String,
    /// Which actor this is; unique in the run.
    pub actor: u32,
    /// Copies of the world, if not as many as the settings say.
    pub envs: Option<u32>,
}

/// Runs one actor until `shutdown`, or until the run has its transitions.
///
/// # Errors
/// Nobody to join, settings or weights that do not fit, a world that fails, chunks that cannot be delivered.
pub fn run(args: RunArgs, shutdown: &Shutdown) -> anyhow::Result<()> {
    let keys = Keys::new(&args.namespace).map_err(anyhow::Error::msg)?;
    let session = session::open(&Endpoints {
        listen: Vec::new(),
        connect: args.connect,
    })?;
    let Some(hello) = session::join(&session, &keys, shutdown)? else {
        return Ok(());
    };
    let mut settings = ActorSettings::from_toml(&hello.config_toml)
        .context("the settings that the replay server sent")?;
    if let Some(envs) = args.envs {
        settings.actor.envs = envs;
        settings.actor.validate()?;
    }
    let spec_hash = settings.spec.hash();
    let first =
        weight_watch::first_weights(&session, &keys, spec_hash, WEIGHTS_WAIT_MAX, shutdown)?;
    let Some((header, weights)) = first else {
        return Ok(());
    };
    let limits = DeliveryLimits::of(&settings.actor);
    let envs = settings.actor.envs;
    let pool = settings.chunk_memory();
    let mut collector = Collector::new(
        settings,
        pool.clone(),
        Life {
            actor: args.actor,
            epoch: new_epoch(),
            after_updates: hello.after_updates,
            inserted_total_at_join: hello.inserted_total,
        },
        header.version,
        &weights,
    )?;
    let newest = weight_watch::watch(
        session.clone(),
        keys.clone(),
        spec_hash,
        header.version,
        shutdown.clone(),
    )?;
    let alive = session
        .liveliness()
        .declare_token(keys.actor_alive(args.actor))
        .wait()
        .map_err(|e| anyhow::anyhow!("declaring actor {} alive: {e}", args.actor))?;
    let delivery = Delivery::start(
        session.clone(),
        keys,
        spec_hash,
        hello.inserted_total,
        limits,
        pool,
        shutdown.clone(),
    )?;
    tracing::info!(
        "actor {} steps {envs} copies, run {spec_hash:016x}",
        args.actor
    );
    while !shutdown.is_set() && !delivery.is_finished() {
        if let Some((header, weights)) = newest.take()
            && let Err(e) = collector.set_weights(header.version, &weights)
        {
            tracing::warn!(
                "weights {} were refused, the old ones stay: {e:#}",
                header.version
            );
        }
        let chunk = collector.collect(delivery.inserted_total())?;
        if !delivery.send(chunk) {
            break;
        }
    }
    let produced = collector.produced();
    let unwanted = delivery.finish()?;
    tracing::info!(
        "actor {} leaves: {} transitions delivered",
        args.actor,
        produced - unwanted
    );
    drop(alive);
    session
        .close()
        .wait()
        .map_err(|e| anyhow::anyhow!("closing the session: {e}"))
}

/// A number that no other life of this actor has: nanoseconds since 1970.
fn new_epoch() -> u64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(1, |since| since.as_nanos() as u64)
}
