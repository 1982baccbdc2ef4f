//! Actors, replay and learner, stepped in a fixed order.
//! A checkpoint holds the learner, and beside it the state of actors and replay. The replay's transitions lie in the run folder.
//! `mod` decides when to save and what to show.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use driml_actor::{ActError, ActorSettings, Collector, CollectorState, Incarnation};
use driml_envs::EnvError;
use driml_learner::{BatchPart, Learner, LearnerConfig, checkpoint};
use driml_machine::{error::usage, units::count};
use driml_protocol::{
    ActorJoin, Batch, BufferPool, InsertReply, LearnerStatus, Leave, WeightsHeader, codec,
};
use driml_replay_server::{Mark, NotReady, PersistArgs, Replay};
use driml_settings::config::RunConfig;
use serde::{Deserialize, Serialize};

use crate::{console, run_folder::RunFolder};

/// The incarnation of every actor: an actor of this mode starts only once, and the number influences nothing.
const INCARNATION: u64 = 1;
/// The learner's number, which influences nothing either.
const LEARNER_ID: u64 = 1;

/// Version of the format of [`SavedState`]; another version is rejected.
const SAVED_STATE_FORMAT: u32 = 5;

/// The saved state of a run in lockstep, without the learner.
#[derive(Serialize, Deserialize)]
struct SavedState {
    actors: Vec<CollectorState>,
    replay: Mark,
    turn: Turn,
}

/// Which actor is next, and the weights with which the actors act.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Turn {
    next_actor: usize,
    /// Transitions that each actor produced after the replay had all that the run needs.
    unwanted: Vec<u64>,
    pub(super) status: LearnerStatus,
    /// The weights with which the actors act, as a safetensors file, and the updates after which they were published.
    acting: (WeightsHeader, Vec<u8>),
    published: u64,
}

impl SavedState {
    fn to_bytes(&self) -> anyhow::Result<Vec<u8>> {
        let mut bytes = SAVED_STATE_FORMAT.to_le_bytes().to_vec();
        bytes.extend(codec::encode_value(self).context("writing actors and replay")?);
        Ok(bytes)
    }

    /// Reads the state in the newest checkpoint of a run's folder.
    fn read(run_dir: &RunFolder) -> anyhow::Result<Self> {
        let all = checkpoint::list(&run_dir.checkpoints())?;
        let (_, path) = all.last().context("there is no checkpoint")?;
        // `resume::prepare` has checked that there is one.
        let bytes = checkpoint::read_companion(path)?
            .context("a checkpoint of a run in lockstep has a companion")?;
        let content = bytes.strip_prefix(&SAVED_STATE_FORMAT.to_le_bytes()).with_context(|| {
            let path = path.display();
            usage!("{path} is a lockstep checkpoint of another version of driml: resume with that version")
        })?;
        codec::decode_value(content)
            .with_context(|| format!("reading actors and replay in {}", path.display()))
    }
}

/// Opens the replay in a run's folder; with a mark, in the state at that mark.
fn open(config: &RunConfig, run_dir: &RunFolder, mark: Option<Mark>) -> anyhow::Result<Replay> {
    let args = PersistArgs {
        dir: run_dir.replay(),
        shard: 0,
        segment_bytes: None,
        mark,
    };
    let batch_size = config.learner.batch_size;
    let (replay, recovery) = Replay::open(&args, &config.run, &config.replay, batch_size)?;
    // A replay server could continue with a part of the replay, but a lockstep run must repeat exactly.
    match recovery.warnings.first() {
        Some(why) if mark.is_some() => bail!(usage!(
            "the run cannot resume to the same weights: {why}. Start it again, in another folder"
        )),
        _ => Ok(replay),
    }
}

pub(super) struct Lockstep {
    actors: Vec<Collector>,
    pub(super) replay: Replay,
    pub(super) learner: Learner,
    batch_size: u32,
    steps_per_chunk: u32,
    pub(super) turn: Turn,
}

impl Lockstep {
    /// The components of a new run; the replay is kept in the run's folder if the state of the world can be saved.
    pub(super) fn begin(config: &RunConfig, run_dir: &RunFolder) -> anyhow::Result<Self> {
        let mut this = Self::in_memory(config)?;
        match this.actor_states() {
            Ok(_) => {
                this.replay = open(config, run_dir, None)?;
                this.join_actors()?;
            }
            Err(ActError::World(e @ EnvError::NotSaved(_))) => {
                console::eprintln(&format!("{e}: the run cannot be resumed, only repeated"));
            }
            Err(e) => return Err(e.into()),
        }
        Ok(this)
    }

    /// The components of the run in `run_dir`, in the state of its newest checkpoint.
    pub(super) fn resume(config: &RunConfig, run_dir: &RunFolder) -> anyhow::Result<Self> {
        let saved = SavedState::read(run_dir)?;
        let compute = config.local.learner_device.open(config.learner.precision)?;
        let settings = LearnerConfig::from_toml(&config.to_toml())?;
        let learner = Learner::new(settings, &compute)?.resume(&run_dir.checkpoints())?;
        let replay = open(config, run_dir, Some(saved.replay))?;
        let (actors, turn) = (saved.actors, saved.turn);
        let wanted = config.local.actors;
        let resuming = "resuming the actors from the checkpoint";
        ensure!(
            actors.len() == wanted as usize,
            "{resuming}: it holds {}, and this run has {wanted}",
            count(actors.len(), "actor")
        );
        let mut this = Self::assemble(config, learner, replay, turn).context(resuming)?;
        for (actor, state) in this.actors.iter_mut().zip(actors) {
            actor.restore(state).context(resuming)?;
        }
        Ok(this)
    }

    /// The components of a new run, with the replay in memory only.
    pub(super) fn in_memory(config: &RunConfig) -> anyhow::Result<Self> {
        let replay = Replay::new(&config.run, &config.replay, config.learner.batch_size)?;
        let compute = config.local.learner_device.open(config.learner.precision)?;
        let mut learner = Learner::new(LearnerConfig::from_toml(&config.to_toml())?, &compute)?;
        let weights = learner.export_weights()?;
        let turn = Turn {
            next_actor: 0,
            unwanted: vec![0; config.local.actors as usize],
            status: LearnerStatus {
                weights_version: weights.header.version,
                weights_sha256: weights.header.sha256_hex(),
                ..LearnerStatus::default()
            },
            acting: (weights.header, weights.safetensors),
            published: 0,
        };
        let mut this = Self::assemble(config, learner, replay, turn)?;
        this.join_actors()?;
        Ok(this)
    }

    /// Assembles these components with new actors, which act with the weights of `turn`.
    fn assemble(
        config: &RunConfig,
        learner: Learner,
        replay: Replay,
        turn: Turn,
    ) -> anyhow::Result<Self> {
        let settings = ActorSettings::from_toml(&config.to_toml())?;
        let (header, safetensors) = &turn.acting;
        let actor = |actor| {
            let incarnation = Incarnation::first(actor, INCARNATION);
            let pool = BufferPool::new(1);
            Collector::new(&settings, pool, incarnation, header.version, safetensors)
        };
        let actors = (0..config.local.actors).map(actor);
        Ok(Self {
            actors: actors.collect::<Result<Vec<_>, _>>()?,
            batch_size: config.learner.batch_size,
            steps_per_chunk: config.actor.steps_per_chunk,
            replay,
            learner,
            turn,
        })
    }

    fn join_actors(&mut self) -> anyhow::Result<()> {
        for actor in 0..self.actors.len() as u32 {
            let join = ActorJoin::new(actor, INCARNATION);
            self.replay.join_actor(join).map_err(anyhow::Error::msg)?;
        }
        Ok(())
    }

    fn actor_states(&mut self) -> Result<Vec<CollectorState>, ActError> {
        self.actors.iter_mut().map(Collector::state).collect()
    }

    /// Writes a checkpoint into `folder`, from which a resumed run continues exactly as this one.
    pub(super) fn save(&mut self, folder: &Path) -> anyhow::Result<()> {
        let inserted = self.replay.counts().inserted;
        self.learner.run_counts_mut().record_inserted(0, inserted);
        let Some(mark) = self.replay.mark()? else {
            // An empty companion says that the run is in lockstep, and cannot be resumed.
            return Ok(self.learner.save(folder, Some(&[]))?);
        };
        let doing = "saving the worlds for a checkpoint, which worked at the start of the run";
        let saved = self.actor_states().context(doing).and_then(|actors| {
            let state = SavedState {
                actors,
                replay: mark,
                turn: self.turn.clone(),
            };
            Ok(self.learner.save(folder, Some(&state.to_bytes()?))?)
        });
        if saved.is_err() {
            self.replay.discard_mark(mark);
        }
        saved
    }

    /// Stores one chunk of the next actor, then does every update that it allows. Returns false once all updates are done.
    pub(super) fn run_round(&mut self) -> anyhow::Result<bool> {
        let id = self.turn.next_actor;
        self.turn.next_actor = (id + 1) % self.actors.len();
        let chunk = self.actors[id].collect(self.replay.inserted_total(), self.steps_per_chunk)?;
        loop {
            match self.replay.insert(&chunk) {
                InsertReply::Stored { .. } => break,
                InsertReply::Wait { .. } => match self.replay.sample(self.batch_size) {
                    Ok(batch) => self.learn(&batch)?,
                    Err(_) if self.replay.is_disk_failing() => {
                        bail!(
                            "the run folder cannot be written (the log has the reason): make room, then use --resume"
                        )
                    }
                    Err(not_ready) => bail!("actor and learner wait for each other: {not_ready:?}"),
                },
                InsertReply::Finished { .. } => {
                    self.turn.unwanted[id] += chunk.header.transitions() as u64;
                    break;
                }
                InsertReply::OutOfOrder { expected } => {
                    bail!(
                        "actor {id} is at chunk {}, not {expected}",
                        chunk.header.sequence
                    )
                }
                InsertReply::Refused { why } => bail!("the replay rejected a chunk: {why}"),
            }
        }
        loop {
            match self.replay.sample(self.batch_size) {
                Ok(batch) => self.learn(&batch)?,
                Err(NotReady::Wait(_)) => return Ok(true),
                Err(NotReady::Finished) => return Ok(false),
                Err(NotReady::Refused { why }) => bail!("the replay cannot sample: {why}"),
            }
        }
    }

    fn learn(&mut self, batch: &Batch) -> anyhow::Result<()> {
        let report = self.learner.update(batch)?;
        self.learner.run_counts_mut().add_batch(&[BatchPart {
            shard: 0,
            rows: batch.header.rows,
            inserted: batch.header.counts.inserted,
        }]);
        let number = self.learner.updates();
        if let Some(priorities) = batch.priority_update(LEARNER_ID, number, &report.losses.row_kls)
        {
            let set = self.replay.set_priorities(&priorities);
            set.map_err(anyhow::Error::msg)
                .context("the replay rejected priorities")?;
        }
        report.write_status(number, &mut self.turn.status);
        if let Some(affinity) = self.learner.affinity_update(LEARNER_ID) {
            let set = self.replay.set_affinity(&affinity);
            set.map_err(anyhow::Error::msg)?;
        }
        if self.learner.publication_is_due() {
            self.publish()?;
        }
        Ok(())
    }

    fn publish(&mut self) -> anyhow::Result<()> {
        let weights = self.learner.export_weights()?;
        for actor in &mut self.actors {
            actor.set_weights(weights.header.version, &weights.safetensors)?;
        }
        let turn = &mut self.turn;
        turn.published = self.learner.updates();
        turn.status.weights_version = weights.header.version;
        turn.status.weights_sha256 = weights.header.sha256_hex();
        turn.acting = (weights.header, weights.safetensors);
        Ok(())
    }

    /// Publishes the last weights, and lets the actors leave.
    pub(super) fn finish(&mut self) -> anyhow::Result<()> {
        if self.turn.published != self.learner.updates() {
            self.publish()?;
        }
        for (id, (actor, surplus)) in self.actors.iter().zip(&self.turn.unwanted).enumerate() {
            let produced = actor.transitions_recorded() - surplus;
            let leave = Leave::new(id as u32, INCARNATION, produced);
            self.replay.leave(&leave);
        }
        self.turn.status.finished = true;
        Ok(())
    }
}
