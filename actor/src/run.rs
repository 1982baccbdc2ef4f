//! Runs one actor process: joins the run, acts, and delivers chunks until it is told to stop or the run has enough transitions.
//! The acting itself is in `collect`, which uses no network.

use std::{cell::Cell, time::Duration};

use anyhow::{Context, bail};
use driml_envs::WorldName;
use driml_protocol::{
    Activity, ActorJoin, ChunkPoll, InsertReply, Leave, Participant, RunClient, Shutdown, join,
    reporter,
    session::{Connection, SMALL_MESSAGE_BYTES_MAX},
};
use zenoh::Wait;

use crate::{
    collect::{Collector, Incarnation},
    config::ActorSettings,
    delivery::{Delivery, DeliveryLimits},
    weights::{self, NewestWeights},
};

/// How long an actor waits for the learner's first weights.
const FIRST_WEIGHTS_WAIT_MAX: Duration = Duration::from_secs(120);
/// Time-out of a request that is sent once: whether the run is over, or that the actor leaves before its first chunk.
const ASK_MAX: Duration = Duration::from_secs(2);

/// The arguments of one actor process. All other settings come from the replay server.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// The connection to the replay server.
    pub connection: Connection,
    /// The actor's number, unique in the run.
    pub actor: u32,
    /// The number of environments, if it differs from the run's settings.
    pub envs: Option<u32>,
    /// The world's name on this machine, if the world is code outside this program (a command or a library). The actor
    /// starts or loads no other such code, whatever the replay server sends.
    pub world: Option<WorldName>,
}

/// Runs one actor until `shutdown`, or until the run has all its transitions; returns whether the run has them.
///
/// # Errors
/// No run to join, settings or weights that do not fit, a world that fails, chunks that cannot be delivered.
pub fn run(args: RunArgs, shutdown: &Shutdown) -> anyhow::Result<bool> {
    let connection = args.connection;
    let opened = connection.open_unless(shutdown, SMALL_MESSAGE_BYTES_MAX)?;
    let Some(session) = opened else {
        return Ok(false);
    };
    let keys = connection.keys;
    let Some(run_info) = join::fetch_run_info(&session, &keys, shutdown)? else {
        return Ok(false);
    };
    let mut settings = ActorSettings::from_toml(&run_info.config_toml)
        .context("the settings that the replay server sent")?;
    if let Some(envs) = args.envs {
        settings.set_envs(envs)?;
    }
    settings.set_world_code(args.world)?;
    if settings.transport.shared_memory && !run_info.shared_memory {
        tracing::info!(
            "chunks go through sockets: the replay server accepts none through shared memory"
        );
        settings.transport.shared_memory = false;
    }
    let spec_hash = settings.spec.hash();
    let join = ActorJoin::new(args.actor, rand::random());
    let participant = Participant::Actor(join);
    // Declared before joining, so that no other process can join as this actor from then on.
    let client = RunClient::new(session, keys, spec_hash);
    let alive = client.declare_alive(participant.peer());
    let alive = alive.map_err(|e| anyhow::anyhow!("declaring actor {} alive: {e}", args.actor))?;
    let Some(welcome) = join::join(&client, &join, shutdown)? else {
        return Ok(false);
    };
    if welcome.earlier_incarnations > 0 && !settings.world.is_resumable() {
        tracing::warn!(
            "actor {} replaces one that has exited, and counts its episodes from 0: the ghosts of this run change with that count, \
             so they differ from those of a run without the exit",
            args.actor
        );
    }
    let activity = Activity::new("waits for the learner's first weights");
    let clients = vec![client.clone()];
    reporter::start(clients, participant, activity.clone(), shutdown.clone())?;
    let leave_early = |is_finished| {
        let leave = Leave::new(join.actor, join.incarnation, 0);
        if let Err(e) = client.ask(&leave, ASK_MAX) {
            tracing::debug!("the replay server did not receive this actor's `Leave`: {e}");
        }
        Ok(is_finished)
    };
    let Some(first) = weights::wait_for_first(&client, FIRST_WEIGHTS_WAIT_MAX, shutdown)? else {
        return leave_early(false);
    };
    // The learner has joined by now, so the replay server knows after how many updates a resumed run continues.
    let Some(run_info) = join::fetch_run_info(client.session(), client.keys(), shutdown)? else {
        return leave_early(false);
    };
    let pool = settings.chunk_buffers();
    activity.begin("makes its environments");
    let incarnation = Incarnation {
        actor: join.actor,
        id: join.incarnation,
        after_updates: run_info.after_updates,
        earlier_incarnations: welcome.earlier_incarnations,
    };
    let version = first.header.version;
    let poll = ChunkPoll::new(join.actor, join.incarnation, 0);
    let rejected = Cell::new(None);
    let is_over = || match client.ask(&poll, ASK_MAX) {
        Ok(InsertReply::Finished { .. }) => true,
        Ok(InsertReply::Refused { why }) => {
            rejected.set(Some(why));
            true
        }
        _ => false,
    };
    // A world in its own process may take minutes to start. The replay server exits soon after the run.
    let built = {
        let (settings, pool) = (settings.clone(), pool.clone());
        let build =
            move || Collector::new(&settings, pool, incarnation, version, &first.safetensors);
        shutdown.run_unless_set("environments", build, is_over)?
    };
    if let Some(why) = rejected.take() {
        bail!("the replay server rejected this actor: {why}");
    }
    let Some(collector) = built else {
        return leave_early(!shutdown.is_set());
    };
    let mut collector = collector?;
    let newest = weights::start_puller(client.clone(), version, shutdown.clone())?;
    let (actor, config) = (args.actor, &settings.actor);
    let (inserted, limits) = (run_info.inserted_total, DeliveryLimits::from_config(config));
    let (run, stop) = (client.clone(), shutdown.clone());
    let delivery = Delivery::start(run, join, inserted, limits, pool, stop)?;
    let envs = config.envs;
    tracing::info!("actor {actor} steps {envs} environments, run {spec_hash:016x}");
    // At the start, not all planned actors are connected yet.
    let chunk_steps = |actors: u32| config.chunk_steps(actors.max(settings.actors_planned));
    let result = produce_chunks(
        &mut collector,
        chunk_steps,
        &newest,
        &delivery,
        &activity,
        shutdown,
    );
    if result.is_err() {
        // Chunks from before the failure are still delivered, without a wait for the rate limiter.
        shutdown.set();
    }
    let is_finished = delivery.progress().is_finished;
    let produced = collector.transitions_recorded();
    activity.begin("delivers its last chunks");
    let delivered = delivery.finish(result.is_err());
    if let (Err(_), Err(e)) = (&result, &delivered) {
        tracing::warn!("some transitions from before the error were not delivered: {e}");
    }
    result?;
    let stored = produced - delivered?;
    tracing::info!("actor {actor} leaves: {stored} transitions delivered");
    drop(alive);
    let closed = client.session().close().wait();
    closed.map_err(|e| anyhow::anyhow!("closing the session: {e}"))?;
    Ok(is_finished)
}

/// Collects and queues chunks until `shutdown`, or until the run needs no more. `chunk_steps` maps the number of actors
/// in the run to the number of steps in a chunk.
fn produce_chunks(
    collector: &mut Collector,
    chunk_steps: impl Fn(u32) -> u32,
    newest: &NewestWeights,
    delivery: &Delivery,
    activity: &Activity,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    while !shutdown.is_set() && !delivery.progress().is_finished {
        if let Some(newer) = newest.take_within(delivery.fresh_weights_wait_max()) {
            let version = newer.header.version;
            if let Err(e) = collector.set_weights(version, &newer.safetensors) {
                tracing::warn!(
                    "weights {version} were rejected, and the previous ones stay in use: {e:#}"
                );
            }
        }
        activity.begin("plays");
        let progress = delivery.progress();
        let (frames, steps) = (progress.inserted_total, chunk_steps(progress.actors));
        let chunk = collector.collect_unless(|| shutdown.is_set(), frames, steps)?;
        let Some(chunk) = chunk else { break };
        if let Some(wait) = delivery.describe_wait() {
            activity.begin(wait);
        }
        if !delivery.send(chunk) {
            break;
        }
    }
    Ok(())
}
