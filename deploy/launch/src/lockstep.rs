//! Actors, replay server and learner in one process, one after the other in a fixed order: the same code as the processes run,
//! without sockets. The same seed gives the same weights, bit for bit, on the same machine; it is for tests and debugging, not for speed.

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use driml_actor::{ActorSettings, Collector, Incarnation};
use driml_learner::{Learner, LearnerConfig};
use driml_machine::error::Interrupted;
use driml_protocol::{
    ActorJoin, Batch, BufferPool, Goodbye, InsertReply, LearnerStatus, Shutdown, Weights,
};
use driml_replay_server::{Replay, Unready};
use driml_settings::config::RunConfig;

use crate::{
    console::{self, Screen, print},
    live_view::{Display, TEMPLATE},
    run_folder::{Outcome, ResumePoint, RunFolder, RunRecorder},
};

/// How often progress is shown and recorded.
const POLL: Duration = Duration::from_secs(1);
/// Every actor's incarnation: an actor of this mode has one life, and its number influences nothing.
const INCARNATION: u64 = 1;
/// The learner's number, which influences nothing either.
const LEARNER: u64 = 1;

/// Trains in this process, and leaves `run_dir`.
///
/// # Errors
/// A component that failed, a file system that refuses; [`Interrupted`] if the run was asked to stop.
pub fn run(
    config: &RunConfig,
    run_dir: &RunFolder,
    exit_with_parent: Option<u32>,
) -> anyhow::Result<()> {
    let shutdown = Shutdown::on_signals(exit_with_parent).context("listening for signals")?;
    let mut recorder = RunRecorder::create(
        run_dir,
        &config.to_toml(),
        config.learner.update.objective.losses(),
        &[],
    )?;
    if config.local.tensorboard {
        recorder.write_events(run_dir)?;
    }
    let screen = Screen::new(config.frames(), TEMPLATE);
    let mut lockstep = Lockstep::new(config)?;
    let mut display = Display::new(
        screen.clone(),
        config.frames(),
        config.updates(),
        ResumePoint::default(),
    );
    let mut shown = Instant::now();
    let folder = run_dir.checkpoints();

    let mut outcome = Outcome::Finished;
    let mut saved = u64::MAX;
    while lockstep.round()? {
        if lockstep.learner.checkpoint_is_due() && lockstep.learner.updates() != saved {
            saved = lockstep.learner.updates();
            lockstep.learner.save(&folder)?;
        }
        if shown.elapsed() >= POLL {
            shown = Instant::now();
            let replay = lockstep.replay.status();
            let said = recorder.record(std::slice::from_ref(&replay), &lockstep.status, &[]);
            said.iter().for_each(|line| screen.line(line));
            display.show(&replay, &lockstep.status, recorder.episodes(&replay));
        }
        if shutdown.is_set() {
            outcome = Outcome::Interrupted;
            break;
        }
    }
    lockstep.end()?;
    if lockstep.learner.updates() != saved {
        lockstep.learner.save(&folder)?;
    }
    screen.clear();
    let replay = lockstep.replay.status();
    recorder.record(std::slice::from_ref(&replay), &lockstep.status, &[]);
    let missing = recorder.missing();
    missing.iter().for_each(|line| console::line(line));
    let summary = recorder.summarise(outcome, &config.run, &replay, &lockstep.status);
    print(&summary.describe(run_dir))?;
    summary.write(run_dir)?;
    if outcome == Outcome::Interrupted {
        Err(Interrupted.into())
    } else {
        Ok(())
    }
}

/// The components of a run, which take turns.
struct Lockstep {
    actors: Vec<Collector>,
    next_actor: usize,
    replay: Replay,
    learner: Learner,
    status: LearnerStatus,
    batch_size: u32,
    steps_per_chunk: u32,
    unwanted: Vec<u64>,
    published: u64,
}

impl Lockstep {
    fn new(config: &RunConfig) -> anyhow::Result<Self> {
        let text = config.to_toml();
        let settings = ActorSettings::from_toml(&text)?;
        let learner_config = LearnerConfig::from_toml(&text)?;
        let batch_size = learner_config.learner.batch_size;
        let mut replay = Replay::new(&config.run, &config.replay, batch_size)?;
        for actor in 0..config.local.actors {
            let join = ActorJoin {
                actor,
                incarnation: INCARNATION,
            };
            replay.join_actor(join).map_err(anyhow::Error::msg)?;
        }
        let compute = config
            .local
            .learner_device
            .open(learner_config.learner.precision)?;
        let mut learner = Learner::new(learner_config, &compute)?;
        let first = learner.next_weights()?;
        let status = LearnerStatus {
            weights_version: first.header.version,
            weights_sha256: first.header.sha256_hex(),
            ..LearnerStatus::default()
        };
        let actor = |actor| {
            let life = Incarnation {
                actor,
                id: INCARNATION,
                after_updates: 0,
                earlier_incarnations: 0,
            };
            Collector::new(
                settings.clone(),
                BufferPool::new(1),
                life,
                first.header.version,
                &first.safetensors,
            )
        };
        let actors = (0..config.local.actors)
            .map(actor)
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Self {
            unwanted: vec![0; actors.len()],
            actors,
            next_actor: 0,
            replay,
            learner,
            status,
            batch_size,
            steps_per_chunk: settings.actor.steps_per_chunk,
            published: 0,
        })
    }

    /// One chunk of the next actor, then every update that it allows; `false` once all updates are done.
    fn round(&mut self) -> anyhow::Result<bool> {
        let id = self.next_actor;
        self.next_actor = (id + 1) % self.actors.len();
        let chunk = self.actors[id].collect(self.replay.inserted_total(), self.steps_per_chunk)?;
        loop {
            match self.replay.insert(&chunk) {
                InsertReply::Stored { .. } => break,
                InsertReply::Wait { .. } => match self.replay.sample(self.batch_size) {
                    Ok(batch) => self.learn(&batch)?,
                    Err(unready) => bail!("actor and learner wait for each other: {unready:?}"),
                },
                InsertReply::Finished { .. } => {
                    self.unwanted[id] += chunk.header.transitions() as u64;
                    break;
                }
                InsertReply::OutOfOrder { expected } => {
                    bail!(
                        "actor {id} is at chunk {}, not {expected}",
                        chunk.header.sequence
                    )
                }
                InsertReply::Refused { why } => bail!("the replay refused a chunk: {why}"),
            }
        }
        loop {
            match self.replay.sample(self.batch_size) {
                Ok(batch) => self.learn(&batch)?,
                Err(Unready::Wait(_)) => return Ok(true),
                Err(Unready::Finished) => return Ok(false),
                Err(Unready::Refused { why }) => bail!("the replay refuses to sample: {why}"),
            }
        }
    }

    fn learn(&mut self, batch: &Batch) -> anyhow::Result<()> {
        let report = self.learner.update(batch)?;
        self.learner.note(&report, &mut self.status);
        if let Some(affinity) = self.learner.affinity_update(LEARNER) {
            self.replay.set_affinity(&affinity)?;
        }
        if self.learner.publication_is_due() {
            self.publish()?;
        }
        Ok(())
    }

    fn publish(&mut self) -> anyhow::Result<()> {
        let Weights {
            header,
            safetensors,
        } = self.learner.next_weights()?;
        for actor in &mut self.actors {
            actor.set_weights(header.version, &safetensors)?;
        }
        self.published = self.learner.updates();
        self.status.weights_version = header.version;
        self.status.weights_sha256 = header.sha256_hex();
        Ok(())
    }

    /// The last weights and everyone's last word.
    fn end(&mut self) -> anyhow::Result<()> {
        if self.published != self.learner.updates() {
            self.publish()?;
        }
        for (id, (actor, unwanted)) in self.actors.iter().zip(&self.unwanted).enumerate() {
            let produced = actor.produced() - unwanted;
            self.replay.goodbye(&Goodbye {
                actor: id as u32,
                incarnation: INCARNATION,
                produced,
            });
        }
        self.status.finished = true;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use driml_machine::resources::Machine;
    use driml_settings::{
        presets::preset,
        resolve::{Flags, Source, resolve},
    };

    use super::*;

    fn config(world: &str, agent: &'static str, frames: u64, sets: &[&str]) -> RunConfig {
        let machine = Machine {
            cores: 2,
            memory_bytes: 16 << 30,
        };
        let source = Source::Layers(preset("smoke").unwrap(), world.parse().unwrap(), agent);
        let flags = Flags {
            frames: Some(frames),
            actors: Some(2),
            sets: sets.iter().map(|&set| set.into()).collect(),
            ..Flags::default()
        };
        resolve(&source, &flags, &machine).unwrap()
    }

    fn frame(config: &RunConfig) -> (u32, u32) {
        (config.run.frame_height, config.run.frame_width)
    }

    /// The SHA-256 of the weights after a whole run.
    fn weights(config: &RunConfig) -> String {
        let mut lockstep = Lockstep::new(config).unwrap();
        while lockstep.round().unwrap() {}
        lockstep.end().unwrap();
        lockstep.status.weights_sha256
    }

    /// Worlds that are made so large that a convolution leaves a border out: as it is drawn, and enlarged.
    #[test]
    fn a_border_that_no_convolution_reads_changes_no_bit() {
        let chain = [
            "world.height=15",
            "world.width=17",
            "input.height=15",
            "input.width=17",
        ];
        let pacman = ["input.height=88", "input.width=90"];
        for (world, sets, cut, whole) in [
            ("chain", &chain[..], (14, 16), (15, 17)),
            ("mspacman", &pacman, (20, 18), (21, 19)),
        ] {
            for precision in ["f32", "bf16"] {
                let precision = [
                    format!("learner.precision={precision}"),
                    format!("actor.precision={precision}"),
                ];
                let sets: Vec<&str> = sets
                    .iter()
                    .copied()
                    .chain(precision.iter().map(String::as_str))
                    .collect();
                let config = config(world, "driml-ada", 400, &sets);
                let before = config.with_whole_frames().unwrap();
                assert_eq!((frame(&config), frame(&before)), (cut, whole));
                assert_eq!(weights(&config), weights(&before), "{world}, {sets:?}");
            }
        }
    }

    /// A random crop reads what no convolution of the whole frame does.
    #[test]
    fn where_states_are_augmented_frames_stay_whole() {
        let sets = [
            "world.height=15",
            "world.width=17",
            "input.height=15",
            "input.width=17",
        ];
        let config = config("chain", "curl", 400, &sets);
        assert_eq!(frame(&config), (15, 17));
        assert_eq!((config.model.height, config.model.width), (15, 17));
        weights(&config);
    }
}
