//! One learner process: join, learn from batch after batch, publish, save, until told to stop.
//! The learning itself is `learning`, which knows no network.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_model::DeviceName;
use driml_protocol::{Keys, Shutdown};

use crate::{
    batch_source::{BatchSource, Next, Requests},
    checkpoint,
    config::LearnerPart,
    learning::Learning,
    publish::Outlets,
    shards::Shards,
};

/// How long a learner that was told to stop stays to be asked for its last status.
const LAST_WORD_MAX: Duration = Duration::from_secs(3);
/// How often a waiting learner looks whether it should stop.
const TICK: Duration = Duration::from_millis(200);

/// What a learner is told at its start; everything else comes from the replay server.
#[derive(Clone, Debug)]
pub struct RunArgs {
    /// Endpoints of the replay server; one for each shard.
    pub connect: Vec<String>,
    /// Prefix of the run's keys.
    pub namespace: String,
    /// Where checkpoints go: `RUN_DIR/checkpoints`.
    pub run_dir: PathBuf,
    /// What computes.
    pub device: DeviceName,
}

/// Runs the learner until `shutdown`. When the run has no more batches it saves, and stays to answer questions.
///
/// # Errors
/// A device that is not there, nobody to join, settings that cannot work, an update that failed, a disk that refuses.
pub fn run(args: RunArgs, shutdown: &Shutdown) -> anyhow::Result<()> {
    let keys = Keys::new(&args.namespace).map_err(anyhow::Error::msg)?;
    let compute = args.device.open()?;
    let Some(shards) = Shards::join(&args.connect, &keys, shutdown)? else {
        return Ok(());
    };
    let part = LearnerPart::from_toml(&shards.config_toml)
        .context("the settings that the replay server sent")?;
    let requests = Requests {
        rows: part.learner.batch_rows,
        in_flight: part.learner.batches_in_flight,
        shared_memory: part.transport.shared_memory,
    };
    let folder = args.run_dir.join("checkpoints");
    let _lock = checkpoint::lock(&folder)?;
    let mut learning = Learning::resume(part, &compute, &folder)?;
    anyhow::ensure!(
        learning.updates() >= shards.after_updates,
        "the replay server goes on after {} updates, the newest checkpoint in {} has {}: start the replay server with \
         --after-updates {}, or choose the folder of the run",
        shards.after_updates,
        folder.display(),
        learning.updates(),
        learning.updates()
    );
    if shards.is_new && learning.updates() > 0 {
        let updates = learning.updates();
        tracing::warn!(
            "the replay server counts from the start, so the {updates} updates of the checkpoint come on top of the run's; to go \
             on where it was, start the replay server with --after-updates {updates}"
        );
    }
    keep_settings(&args.run_dir, &shards.config_toml)?;
    let spec_hash = learning.spec_hash();
    let outlets = Outlets::open(&shards.sessions, &keys, spec_hash, shutdown)?;
    outlets.publish(learning.next_weights()?)?;
    if learning.updates() > 0 {
        outlets.with_status(|status| status.updates = learning.updates());
        if let Some(affinity) = learning.affinity_update() {
            outlets.send_affinity(affinity);
        }
    }
    let mut batches = BatchSource::start(&shards.sessions, &keys, spec_hash, requests, shutdown)?;
    tracing::info!(
        "learning on {} from batches of {} rows, run {spec_hash:016x}",
        args.device,
        requests.rows
    );

    let mut waiting_since = Instant::now();
    while !shutdown.is_set() {
        let batch = match batches.next(TICK)? {
            Next::Batch(batch) => batch,
            Next::NotYet => continue,
            Next::Finished => break,
        };
        let started = Instant::now();
        let report = learning.update(&batch)?;
        if let Some(affinity) = learning.affinity_update() {
            outlets.send_affinity(affinity);
        }
        if learning.publication_is_due() {
            outlets.publish(learning.next_weights()?)?;
        }
        let ended = Instant::now();
        outlets.with_status(|status| {
            learning.note(&report, status);
            status.waiting_s += (started - waiting_since).as_secs_f64();
            status.computing_s += (ended - started).as_secs_f64();
        });
        waiting_since = ended;
        if learning.checkpoint_is_due() {
            learning.save(&folder)?;
        }
    }
    if !learning.publication_is_due() {
        outlets.publish(learning.next_weights()?)?;
    }
    if !learning.checkpoint_is_due() || learning.updates() == 0 {
        learning.save(&folder)?;
    }
    outlets.with_status(|status| status.finished = true);
    tracing::info!("finished after {} updates", learning.updates());
    shutdown.wait();
    outlets.wait_until_heard(LAST_WORD_MAX);
    let closed = shards.close();
    batches.end();
    closed
}

/// Leaves the run's settings beside the checkpoints, for `driml evaluate`; a file that is there is the launcher's.
fn keep_settings(run_dir: &Path, config_toml: &str) -> anyhow::Result<()> {
    let path = run_dir.join("config.toml");
    if path.exists() {
        return Ok(());
    }
    std::fs::create_dir_all(run_dir)
        .and_then(|()| std::fs::write(&path, config_toml))
        .with_context(|| format!("writing {}", path.display()))
}
