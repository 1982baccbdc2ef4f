//! One learner process: joins the run, learns from batches, publishes weights and saves checkpoints, until told to stop.
//! The learning itself is in `learner`, which uses no network connections.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_model::DeviceName;
use driml_protocol::{
    Activity, BatchHeader, Participant, ReplayStatus, Shutdown, atomic_write, reporter,
    session::Connection, shared_memory,
};

use super::{
    batch_source::{BatchSource, Counters, NextBatch, Requests, ServedBatch},
    publish::Publisher,
    shards::Shards,
};
use crate::{
    checkpoint::{self, CheckpointError, RETRY_MAX, retry_until_writable},
    config::LearnerConfig,
    learner::Learner,
};

/// Time-out of the last request for the number of transitions that a replay server has stored.
const LAST_COUNT_TIMEOUT: Duration = Duration::from_secs(1);
/// How long a learner stays at the end, until its last weights have arrived and its last status was requested.
const LAST_FETCH_MAX: Duration = Duration::from_secs(3);
/// How long a batch may take before the wait is logged.
const WAIT_LOG_AFTER: Duration = Duration::from_secs(10);
/// The pause before a retry of the last save.
const SAVE_PAUSE: Duration = Duration::from_secs(2);
/// How often a waiting learner checks whether it should stop.
const TICK: Duration = Duration::from_millis(200);

/// The arguments of a learner; everything else comes from the replay server.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// The connection to the replay server, with an endpoint for each shard.
    pub connection: Connection,
    /// Where checkpoints go: `RUN_DIR/checkpoints`.
    pub run_dir: PathBuf,
    /// The device on which updates are computed.
    pub device: DeviceName,
    /// Restart the run from its first update, if an earlier learner made updates of which this one has no checkpoint.
    pub restart: bool,
    /// Keep running when the run is over, to reply to requests, until `shutdown`.
    pub keep_alive: bool,
}

/// Runs the learner until the run has no more batches, or `shutdown`, and returns whether it was the former. Either way, and after an
/// error, it saves what it has learned.
///
/// # Errors
/// A device that is not there, no replay server to join, settings that cannot work, an update that failed, a disk that rejects writes.
pub fn run(args: RunArgs, shutdown: &Shutdown) -> anyhow::Result<bool> {
    let Some(shards) = Shards::connect(&args.connection, shutdown)? else {
        return Ok(false);
    };
    let config = LearnerConfig::from_toml(&shards.config_toml)
        .context("the settings that the replay server sent")?;
    let compute = args.device.open(config.learner.precision);
    let compute = compute.context("settings of the replay server, which takes --set")?;
    let folder = args.run_dir.join(checkpoint::FOLDER);
    let _lock = checkpoint::lock(&folder)?;
    let rows = config.learner.batch_size;
    let learner_id = rand::random();
    let mut requests = Requests {
        learner_id,
        rows,
        in_flight: config.learner.batches_in_flight,
        shared_memory: config.transport.shared_memory,
        unreachable_max: Duration::from_millis(config.learner.unreachable_max_ms),
    };
    let batch = BatchHeader::largest(&config.spec, rows).with_sampling(&config.sampling);
    let session_bytes = shared_memory::process_bytes(batch.pool_bytes());
    if requests.shared_memory
        && let Err(why) = shared_memory::check_lockable(session_bytes * shards.sessions.len())
    {
        tracing::warn!("batches come through sockets, which is slower: {why}");
        requests.shared_memory = false;
    }
    let sampling = config.sampling;
    let mut learner = Learner::new(config, &compute)?.resume(&folder)?;
    let updates = learner.updates();
    if updates > 0 {
        let folder = folder.display();
        tracing::info!("resumed after {updates} updates from {folder}");
    }
    anyhow::ensure!(
        !args.restart || updates == 0,
        "--restart begins again from the first update, and {} holds a checkpoint after {updates}: choose an empty --run-dir",
        folder.display(),
    );
    let spec_hash = learner.spec_hash();
    let clients = shards.clients(&args.connection.keys, spec_hash);
    let counts = learner.run_counts_mut();
    if updates == 0 {
        // Without a kept replay, the run starts again; the servers report what a kept one has.
        counts.shards.clear();
    }
    counts.spread_over(clients.len());
    if counts.run == 0 {
        counts.run = rand::random();
    }
    let counts = (updates, &*counts);
    let joined = shards.join_run(&clients, learner_id, counts, args.restart, shutdown)?;
    let Some(membership) = joined else {
        return Ok(false);
    };
    learner.raise_weights_version(membership.weights_version);
    write_settings(&args.run_dir, &shards.config_toml)?;
    let publisher = Publisher::start(&clients, spec_hash, learner_id, &sampling, shutdown)?;
    publisher.publish(learner.export_weights()?);
    if updates > 0 {
        publisher.update_status(|status| status.updates = updates);
        if let Some(affinity) = learner.affinity_update(learner_id) {
            publisher.affinity.push(affinity);
        }
    }
    let activity = Activity::new("waits for its first batch");
    reporter::start(
        clients.clone(),
        Participant::Learner(learner_id),
        activity.clone(),
        // Until the sessions close: after a signal, the last save may retry for minutes.
        Shutdown::default(),
    )?;
    let counters = Counters::new(updates, learner.run_counts());
    let mut batches = BatchSource::start(&clients, requests, &counters, shutdown)?;
    let device = args.device;
    tracing::info!("learning on {device} from batches of {rows} rows, run {spec_hash:016x}");

    let mut checkpointer = Checkpointer {
        folder,
        counters,
        saved_counts: None,
    };
    let learned = learn(
        &mut learner,
        &mut batches,
        &publisher,
        &mut checkpointer,
        &activity,
        shutdown,
    );
    if learned.is_err() {
        tracing::info!("stops early, after {} updates", learner.updates());
    }
    activity.begin("saves its last checkpoint");
    // Transitions stored since the last batch count too.
    for (shard, client) in clients.iter().enumerate() {
        match client.fetch::<ReplayStatus>(LAST_COUNT_TIMEOUT) {
            Ok(status) => learner
                .run_counts_mut()
                .record_inserted(shard, status.transitions_inserted),
            Err(e) => tracing::debug!("the last count of shard {shard}: {e}"),
        }
    }
    let saved = checkpointer.save_last(&learner);
    if let (Err(_), Err(e)) = (&learned, &saved) {
        tracing::warn!("the last checkpoint was not saved: {e:#}");
    }
    if learned.is_ok() && !learner.publication_is_due() {
        publisher.publish(learner.export_weights()?);
    }
    let is_run_over = learned?;
    saved?;
    publisher.update_status(|status| status.finished = true);
    let how = if is_run_over { "finished" } else { "stopped" };
    tracing::info!("{how} after {} updates", learner.updates());
    if is_run_over {
        let (updates, who) = (learner.updates(), Participant::Learner(learner_id));
        reporter::report_finished(&clients, who, updates, shutdown);
    }
    if args.keep_alive {
        activity.begin("has finished and is kept alive");
        shutdown.wait();
    }
    publisher.wait_until_fetched(LAST_FETCH_MAX, shutdown);
    if sampling.is_prioritised() {
        let arrived = publisher.priorities.acknowledged.load(Ordering::Relaxed);
        tracing::info!("priorities of {arrived} updates have arrived");
    }
    drop(membership);
    let closed = shards.close();
    batches.join_threads();
    closed.map(|()| is_run_over)
}

/// Learns from batch after batch until there are no more, which returns true, or until `shutdown`.
fn learn(
    learner: &mut Learner,
    batches: &mut BatchSource,
    publisher: &Publisher,
    checkpointer: &mut Checkpointer,
    activity: &Activity,
    shutdown: &Shutdown,
) -> anyhow::Result<bool> {
    // A wait is logged after some seconds, then ever more seldom.
    let (mut waiting_since, mut log_after) = (Instant::now(), WAIT_LOG_AFTER);
    while !shutdown.is_set() {
        let ServedBatch { batch, parts } = match batches.next(TICK)? {
            NextBatch::Ready(served) => *served,
            NextBatch::NotYet(waiting) => {
                activity.begin("waits for a batch");
                let since = waiting_since.elapsed();
                if since > log_after {
                    let since = since.as_secs();
                    tracing::info!("waiting for a batch for {since} s: {waiting}");
                    log_after *= 2;
                }
                continue;
            }
            NextBatch::Finished => return Ok(true),
        };
        activity.begin("learns");
        log_after = WAIT_LOG_AFTER;
        let started = Instant::now();
        let report = learner.update(&batch)?;
        learner.run_counts_mut().add_batch(&parts);
        let counters = &checkpointer.counters;
        counters.updates.store(learner.updates(), Ordering::Release);
        // Numbered by updates, which only increase within one learner process.
        let (learner_id, number) = (publisher.learner_id, learner.updates());
        if let Some(priorities) = batch.priority_update(learner_id, number, &report.losses.row_kls)
        {
            publisher.priorities.push(priorities);
        }
        if let Some(affinity) = learner.affinity_update(learner_id) {
            publisher.affinity.push(affinity);
        }
        if learner.publication_is_due() {
            publisher.publish(learner.export_weights()?);
        }
        let ended = Instant::now();
        publisher.update_status(|status| {
            report.write_status(learner.updates(), status);
            status.waiting_s += (started - waiting_since).as_secs_f64();
            status.computing_s += (ended - started).as_secs_f64();
        });
        waiting_since = ended;
        if learner.checkpoint_is_due()
            && let Err(e) = checkpointer.save(learner)
        {
            tracing::warn!(
                "no checkpoint after {} updates, trying again at the next period: {e:#}",
                learner.updates()
            );
        }
    }
    Ok(false)
}

/// Saves the checkpoints of one learner. A failing disk does not end the training: the next period tries again, and only a failure of
/// the last save is an error.
struct Checkpointer {
    folder: PathBuf,
    counters: Arc<Counters>,
    /// Updates and frames in the newest checkpoint that this process saved.
    saved_counts: Option<(u64, u64)>,
}

impl Checkpointer {
    fn save(&mut self, learner: &Learner) -> Result<(), CheckpointError> {
        learner.save(&self.folder, None)?;
        self.saved_counts = Some(Self::counts(learner));
        let saved_updates = &self.counters.saved_updates;
        saved_updates.store(learner.updates(), Ordering::Release);
        Ok(())
    }

    fn counts(learner: &Learner) -> (u64, u64) {
        (learner.updates(), learner.run_counts().frames())
    }

    /// Saves a last checkpoint, if updates were made or frames stored since the newest one. On a full disk it retries for
    /// [`RETRY_MAX`]; a second signal ends the process.
    fn save_last(mut self, learner: &Learner) -> Result<(), CheckpointError> {
        match self.saved_counts == Some(Self::counts(learner)) {
            true => Ok(()),
            false => retry_until_writable(SAVE_PAUSE, RETRY_MAX, || self.save(learner)),
        }
    }
}

/// Writes the run's settings beside the checkpoints, for `driml evaluate`, and replaces those of an earlier start. A file that begins
/// with a comment is the launcher's and stays unchanged.
fn write_settings(run_dir: &Path, config_toml: &str) -> anyhow::Result<()> {
    let path = run_dir.join("config.toml");
    let existing = std::fs::read_to_string(&path).unwrap_or_default();
    if existing.starts_with('#') || existing == config_toml {
        return Ok(());
    }
    std::fs::create_dir_all(run_dir)
        .and_then(|()| atomic_write::write(&path, config_toml.as_bytes()))
        .with_context(|| format!("writing {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_settings_that_are_kept_are_the_newest_unless_they_are_the_launcher_s() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        for (there, kept) in [("a", "b"), ("# a", "# a")] {
            std::fs::write(&path, there).unwrap();
            write_settings(folder.path(), "b").unwrap();
            assert_eq!(std::fs::read_to_string(&path).unwrap(), kept);
        }
    }
}
