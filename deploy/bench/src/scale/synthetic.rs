//! Actors and a learner without world and network: they deliver, pull weights, fetch and upload as real ones do.
//! They neither act nor learn.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    thread::ScopedJoinHandle,
    time::{Duration, Instant},
};

use driml_actor::{ActorSettings, Delivery, DeliveryLimits, WeightsSource};
use driml_learner::{
    LearnerConfig,
    remote::batch_source::{BatchSource, Counters, Next, Requests},
};
use driml_protocol::{Keys, RunClient, Shutdown};
use driml_settings::config::RunConfig;
use zenoh::{Session, Wait};

use crate::{recording::Recording, taking_part};

/// How long a batch may take to come, and a server to be out of reach.
const ANSWER_MAX: Duration = Duration::from_secs(30);
/// Batches from one version of the weights to the next.
const PUBLISH_PERIOD: u64 = 8;

/// When an actor sends.
#[derive(Clone, Copy)]
pub(super) enum Pace {
    /// A chunk of `steps` steps in each period; the first one is sent later.
    Every {
        steps: u32,
        period: Duration,
        first: Duration,
    },
    /// As fast as it may, in chunks as long as the settings have them, with weights that it pulls.
    Unpaced,
}

/// One synthetic actor.
pub(super) struct Actor<'a> {
    pub(super) recording: &'a Recording,
    pub(super) config: &'a RunConfig,
    pub(super) actor: u32,
    /// Actors of the run.
    pub(super) actors: u32,
    pub(super) streams: u32,
    pub(super) pace: Pace,
}

impl Actor<'_> {
    /// Delivers until told to stop.
    ///
    /// # Errors
    /// A server that is out of reach or refuses.
    pub(super) fn run(self, session: Session, keys: Keys, stop: &Shutdown) -> anyhow::Result<()> {
        let mut settings = ActorSettings::from_toml(&self.config.to_toml())?;
        settings.actor.envs = self.streams;
        let spec_hash = settings.spec.hash();
        let client = RunClient::new(session, keys, spec_hash);
        let pool = settings.chunk_memory();
        let alive = taking_part::join_as_actor(&client, self.actor)?;
        let delivery = Delivery::start(
            client.clone(),
            0,
            DeliveryLimits::of(&settings.actor),
            pool.clone(),
            stop.clone(),
        )?;
        let mut chunks = self.recording.chunks(self.actor, (self.streams, 1), pool);
        let source = WeightsSource {
            client: client.clone(),
        };
        let newest = source.watch(0, stop.clone())?;
        let started = Instant::now();
        let mut due = match self.pace {
            Pace::Every { first, .. } => started + first,
            Pace::Unpaced => started,
        };
        while !stop.wait_timeout(due.saturating_duration_since(Instant::now())) {
            let steps = match self.pace {
                Pace::Every { steps, period, .. } => {
                    // One that has fallen behind does not catch up: its world would have waited too.
                    due = (due + period).max(Instant::now());
                    steps
                }
                Pace::Unpaced => {
                    if let Some(weights) = newest.take_within(delivery.fresh_weights_max()) {
                        chunks.act_with(weights.header.version);
                    }
                    settings
                        .actor
                        .chunk_steps(delivery.actors().max(self.actors))
                }
            };
            if !delivery.send(chunks.next_of(steps)) {
                break;
            }
        }
        delivery.finish()?;
        drop(alive);
        client
            .session()
            .close()
            .wait()
            .map_err(|e| anyhow::anyhow!("closing an actor's session: {e}"))
    }
}

/// A synthetic learner.
pub(super) struct Learner<'a> {
    pub(super) config: &'a RunConfig,
    pub(super) batches_a_second: f64,
    /// Size of the weights that it uploads every [`PUBLISH_PERIOD`] batches; none are if it is 0.
    pub(super) weights_bytes: usize,
}

impl Learner<'_> {
    /// Takes batches at its pace until told to stop; `count` counts them.
    ///
    /// # Errors
    /// A server that is out of reach or refuses.
    pub(super) fn run(
        self,
        sessions: Vec<Session>,
        keys: Keys,
        stop: &Shutdown,
        count: &AtomicU64,
    ) -> anyhow::Result<()> {
        let LearnerConfig {
            spec,
            learner,
            transport,
            ..
        } = LearnerConfig::from_toml(&self.config.to_toml())?;
        let spec_hash = spec.hash();
        let mut alive = Vec::new();
        let client = |session: &Session| RunClient::new(session.clone(), keys.clone(), spec_hash);
        let clients: Vec<_> = sessions.iter().map(client).collect();
        for client in &clients {
            alive.push(taking_part::join_as_learner(client)?);
        }
        let requests = Requests {
            learner: taking_part::LEARNER,
            rows: learner.batch_size,
            in_flight: learner.batches_in_flight,
            shared_memory: transport.shared_memory,
            unreachable_max: ANSWER_MAX,
        };
        let weights = vec![0; self.weights_bytes];
        let mut source =
            BatchSource::start(&clients, requests, &Counters::at_start(clients.len()), stop)?;
        let mut due = Instant::now();
        let mut updates = 0;
        while !stop.wait_timeout(due.saturating_duration_since(Instant::now())) {
            if let Next::Batch(_) = source.next(ANSWER_MAX)? {
                updates += 1;
                count.fetch_add(1, Ordering::Relaxed);
                if !weights.is_empty() && updates % PUBLISH_PERIOD == 1 {
                    for client in &clients {
                        taking_part::upload_weights(client, updates, &weights)?;
                    }
                }
            }
            due = (due + Duration::from_secs_f64(1.0 / self.batches_a_second)).max(Instant::now());
        }
        drop(alive);
        for session in &sessions {
            session
                .close()
                .wait()
                .map_err(|e| anyhow::anyhow!("closing the learner's session: {e}"))?;
        }
        source.end();
        Ok(())
    }
}

/// Waits for all clients; the first error, if there is one.
///
/// # Errors
/// A client failed.
pub(super) fn join(clients: Vec<ScopedJoinHandle<'_, anyhow::Result<()>>>) -> anyhow::Result<()> {
    for client in clients {
        client
            .join()
            .map_err(|_| anyhow::anyhow!("a client panicked"))??;
    }
    Ok(())
}
