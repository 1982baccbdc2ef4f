//! The run folder: `config.toml`, `metrics.csv`, `summary.json`, `logs/`; the learner adds `checkpoints/`.
//! It reads no status from anywhere: whoever runs the parts hands them over.

use std::{
    fs::{self, File, TryLockError},
    io::{ErrorKind, Write},
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::Context;
use driml_protocol::{LearnerStatus, ReplayStatus};
use serde::{Deserialize, Serialize};

use crate::{
    display::Rates,
    error::{Usage, usage},
    resume::Behind,
};

mod metrics;

use metrics::{Moment, Rows, header};

const METRICS: &str = "metrics.csv";
const SUMMARY: &str = "summary.json";

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Outcome {
    /// All frames are in, their updates done and the last checkpoint written.
    Finished,
    /// A person ended it; what was done is saved.
    Interrupted,
    /// A part failed.
    Failed,
}

/// `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Summary {
    /// How the run ended.
    pub(crate) outcome: Outcome,
    /// The world.
    pub(crate) world: String,
    /// The agent.
    pub(crate) agent: String,
    /// The seed.
    pub(crate) seed: u64,
    /// Updates that the run had behind it when it was resumed, the last time; 0 if it never was. Frames, updates,
    /// rows, episodes, seconds and mean k are of the whole run, all else is of what came since.
    #[serde(default)]
    pub(crate) resumed_after_updates: u64,
    /// Frames that trained: transitions stored.
    pub(crate) frames: u64,
    /// Updates done.
    pub(crate) updates: u64,
    /// Transitions stored.
    pub(crate) transitions_inserted: u64,
    /// Transitions that actors produced and that never arrived.
    pub(crate) transitions_lost: u64,
    /// Transitions stored twice.
    pub(crate) transitions_duplicated: u64,
    /// Rows served to the learner.
    pub(crate) rows_sampled: u64,
    /// Rows per transition, both counted from the end of the warm-up.
    pub(crate) replay_ratio: Option<f64>,
    /// Episodes that ended, in a resumed run those too in which the replay filled again.
    pub(crate) episodes: u64,
    /// Mean undiscounted return of the last 100 episodes.
    pub(crate) mean_return: Option<f64>,
    /// From the start of the first part to the end of the run.
    pub(crate) wall_seconds: f64,
    /// Frames over wall seconds.
    pub(crate) frames_per_second: f64,
    /// Updates over wall seconds.
    pub(crate) updates_per_second: f64,
    /// Mean k of the rows served with a positive; of several positives the furthest counts.
    pub(crate) mean_k: Option<f64>,
    /// How often each k was served; index 0 counts rows without a positive.
    pub(crate) k_histogram: Vec<u64>,
    /// How often each action was taken; older runs do not say.
    #[serde(default)]
    pub(crate) action_histogram: Vec<u64>,
    /// Version of the last weights.
    pub(crate) weights_version: u64,
    /// SHA-256 of the last weights, hexadecimal.
    pub(crate) weights_sha256: String,
    /// Chunks recognised as a retry of a stored one.
    pub(crate) chunks_retried: u64,
    /// Batches that did not reach the learner and were asked for again; older runs do not say.
    #[serde(default)]
    pub(crate) batches_retried: u64,
    /// Memory that the frames in the replay took at the end, MiB.
    pub(crate) replay_frame_mib: u64,
    /// Messages refused as malformed or foreign.
    pub(crate) messages_refused: u64,
    /// Highest resident memory of each process, MiB.
    pub(crate) rss_mib_max: serde_json::Map<String, serde_json::Value>,
}

/// Writes a run folder.
#[derive(Debug)]
pub(crate) struct Recorder {
    /// Nobody else writes to the folder meanwhile.
    _lock: File,
    behind: Behind,
    /// Seconds, frames and episodes in the last row before the run was resumed.
    seconds_before: f64,
    frames_before: u64,
    episodes_before: u64,
    /// Mean and standard deviation of k up to there.
    k_before: Option<(f64, f64)>,
    folder: PathBuf,
    metrics: csv::Writer<File>,
    processes: Vec<String>,
    rss_max: Vec<Option<f64>>,
    started: Instant,
    rates: Rates,
}

/// Refuses a folder in which something lies.
///
/// # Errors
/// Says what to do.
pub(crate) fn check_free(folder: &Path) -> Result<(), Usage> {
    let taken = match fs::read_dir(folder) {
        Ok(mut entries) => entries.next().is_some(),
        Err(_) => folder.exists(),
    };
    if taken {
        return Err(usage!(
            "the run folder {} exists and is not empty: choose another --run-dir, or remove it",
            folder.display()
        ));
    }
    Ok(())
}

impl Recorder {
    /// Makes the folder and writes the settings; the clock starts. `processes` are those whose memory is recorded.
    ///
    /// # Errors
    /// A folder in which something lies, or a file system that refuses.
    pub(crate) fn create(
        folder: &Path,
        config_toml: &str,
        processes: &[String],
    ) -> anyhow::Result<Self> {
        check_free(folder)?;
        fs::create_dir_all(folder)
            .with_context(|| format!("making the run folder {}", folder.display()))?;
        let lock = lock(folder)?;
        let head = header(processes);
        let rows = Rows::none(head);
        Self::begin(
            folder,
            config_toml,
            processes,
            lock,
            rows,
            Behind::default(),
        )
    }

    /// Goes on to `frames_max` frames in the folder of an interrupted run, which has so much `behind` it: the rows of metrics up
    /// to there stay.
    ///
    /// # Errors
    /// A run that is still going on, metrics of other columns, or a file system that refuses.
    pub(crate) fn go_on(
        folder: &Path,
        config_toml: &str,
        processes: &[String],
        behind: Behind,
        frames_max: u64,
    ) -> anyhow::Result<Self> {
        let lock = lock(folder)?;
        let head = header(processes);
        let rows = match behind.updates {
            0 => Rows::none(head),
            _ => Rows::read(&folder.join(METRICS), head, behind, frames_max)?,
        };
        match fs::remove_file(folder.join(SUMMARY)) {
            Err(e) if e.kind() != ErrorKind::NotFound => {
                return Err(e).with_context(|| format!("removing the last {SUMMARY}"));
            }
            _ => {}
        }
        Self::begin(folder, config_toml, processes, lock, rows, behind)
    }

    fn begin(
        folder: &Path,
        config_toml: &str,
        processes: &[String],
        lock: File,
        rows: Rows,
        behind: Behind,
    ) -> anyhow::Result<Self> {
        let head = "# The resolved settings of this run; `driml local --config` with this file repeats it.\n\n";
        write_whole(
            &folder.join("config.toml"),
            format!("{head}{config_toml}").as_bytes(),
        )?;
        let path = folder.join(METRICS);
        write_whole(&path, &rows.to_csv()?)?;
        let file = File::options().append(true).open(&path);
        let file = file.with_context(|| format!("opening {}", path.display()))?;
        let mut this = Self {
            _lock: lock,
            behind,
            seconds_before: rows.last("seconds").unwrap_or(0.0),
            frames_before: rows.last("frames").unwrap_or(0),
            episodes_before: rows.last("episodes").unwrap_or(0),
            k_before: rows.last("mean_k").zip(rows.last("sd_k")),
            folder: folder.to_owned(),
            metrics: csv::Writer::from_writer(file),
            processes: processes.to_vec(),
            rss_max: vec![None; processes.len()],
            started: Instant::now(),
            rates: Rates::default(),
        };
        this.rates.add(this.started, behind.frames, behind.updates);
        Ok(this)
    }

    /// The settings' file, for parts that read it.
    pub(crate) fn config_path(&self) -> PathBuf {
        self.folder.join("config.toml")
    }

    /// Mean and standard deviation of k over all `updates` of the run, before it was resumed too.
    fn k(&self, replay: &ReplayStatus, updates: u64) -> Option<(f64, f64)> {
        let since = replay.mean_k().zip(replay.sd_k());
        let (Some(before), Some(since)) = (self.k_before, since) else {
            return since.or(self.k_before);
        };
        // All updates are of as many rows.
        let share = self.behind.updates as f64 / updates.max(1) as f64;
        let mixed = |before: f64, since: f64| share * before + (1.0 - share) * since;
        let square = |(mean, sd): (f64, f64)| mean * mean + sd * sd;
        let mean = mixed(before.0, since.0);
        let variance = mixed(square(before), square(since)) - mean * mean;
        Some((mean, variance.max(0.0).sqrt()))
    }

    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// Adds a row of metrics, in a resumed run once it is further than its last row. `rss_mib` is in the order of the processes
    /// given at the start; none for one that ended.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(crate) fn record(
        &mut self,
        replay: &ReplayStatus,
        learner: &LearnerStatus,
        rss_mib: &[Option<f64>],
    ) -> anyhow::Result<()> {
        self.rates
            .add(Instant::now(), replay.transitions_inserted, learner.updates);
        for (max, now) in self.rss_max.iter_mut().zip(rss_mib) {
            *max = now.map_or(*max, |now| Some(max.map_or(now, |max: f64| max.max(now))));
        }
        let (frames, updates) = (replay.transitions_inserted, learner.updates);
        let resumed = self.behind.updates > 0;
        if resumed && (updates <= self.behind.updates || frames < self.frames_before) {
            return Ok(());
        }
        let processes = 0..self.processes.len();
        let moment = Moment {
            seconds: self.seconds(),
            rates: self.rates.per_second(),
            episodes: self.episodes_before + replay.episodes,
            k: self.k(replay, updates),
            replay,
            learner,
            rss_mib: processes
                .map(|i| rss_mib.get(i).copied().flatten())
                .collect(),
        };
        self.metrics
            .write_record(moment.row())
            .context("writing metrics.csv")?;
        self.metrics.flush().context("writing metrics.csv")
    }

    /// Writes `summary.json`, whole or not at all, and returns it.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(crate) fn finish(
        &mut self,
        outcome: Outcome,
        run: &driml_protocol::RunSpec,
        replay: &ReplayStatus,
        learner: &LearnerStatus,
    ) -> anyhow::Result<Summary> {
        let wall_seconds = self.seconds();
        // A resumed run that did not get anywhere still has behind it what it had.
        let frames = replay.transitions_inserted.max(self.behind.frames);
        let updates = learner.updates.max(self.behind.updates);
        let rss = self.processes.iter().zip(&self.rss_max);
        let summary = Summary {
            outcome,
            world: run.world.clone(),
            agent: run.agent.clone(),
            seed: run.seed,
            resumed_after_updates: self.behind.updates,
            frames,
            updates,
            transitions_inserted: replay.transitions_inserted,
            transitions_lost: replay.transitions_lost,
            transitions_duplicated: replay.transitions_duplicated,
            rows_sampled: replay.rows_sampled,
            replay_ratio: replay.replay_ratio(),
            episodes: self.episodes_before + replay.episodes,
            mean_return: replay.mean_return,
            wall_seconds,
            frames_per_second: frames as f64 / wall_seconds,
            updates_per_second: updates as f64 / wall_seconds,
            mean_k: self.k(replay, updates).map(|(mean, _)| mean),
            k_histogram: replay.k_histogram.clone(),
            action_histogram: replay.action_histogram.clone(),
            weights_version: learner.weights_version,
            weights_sha256: learner.weights_sha256.clone(),
            chunks_retried: replay.chunks_retried,
            batches_retried: replay.batches_retried,
            replay_frame_mib: replay.frame_bytes_held.div_ceil(1 << 20),
            messages_refused: replay.messages_refused,
            rss_mib_max: rss
                .map(|(name, mib)| (name.clone(), mib.map(f64::round).into()))
                .collect(),
        };
        let mut text = serde_json::to_vec_pretty(&summary).context("writing summary.json")?;
        text.push(b'\n');
        write_whole(&self.folder.join(SUMMARY), &text)?;
        Ok(summary)
    }
}

/// Whether the run in `folder` came to its end.
pub(crate) fn is_finished(folder: &Path) -> bool {
    let text = fs::read(folder.join(SUMMARY)).ok();
    let summary = text.and_then(|text| serde_json::from_slice::<Summary>(&text).ok());
    summary.is_some_and(|it| it.outcome == Outcome::Finished)
}

/// Keeps other launchers out of a run folder as long as the file is held.
pub(crate) fn lock(folder: &Path) -> anyhow::Result<File> {
    let path = folder.join(".lock");
    let doing = || format!("locking {}", path.display());
    let file = File::create(&path).with_context(doing)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(usage!(
            "the run in {} is still going on: end it first, or wait",
            folder.display()
        )
        .into()),
        Err(TryLockError::Error(e)) => {
            // Not every file system of a cluster has locks, and runs were made without them before.
            tracing::warn!(
                "{} cannot be locked: {e}; start no other run there",
                path.display()
            );
            Ok(file)
        }
    }
}

/// Writes a file beside its place and renames it into it.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let doing = || format!("writing {}", path.display());
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut file = tempfile::NamedTempFile::new_in(folder).with_context(doing)?;
    file.write_all(bytes).with_context(doing)?;
    file.as_file().sync_all().with_context(doing)?;
    make_readable(file.as_file()).with_context(doing)?;
    file.persist(path)
        .map_err(|e| e.error)
        .with_context(doing)?;
    Ok(())
}

/// Temporary files are private by default; these are for whoever may look into the folder.
fn make_readable(file: &File) -> std::io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    file.set_permissions(fs::Permissions::from_mode(0o644))
}

#[cfg(test)]
pub(crate) mod tests {
    use driml_protocol::{Horizon, RunSpec, TimeoutRule, Waiting};
    use expect_test::expect;

    use super::*;

    pub(crate) fn spec() -> RunSpec {
        RunSpec {
            world: "chain".into(),
            agent: "driml-ada".into(),
            seed: 3,
            frame_height: 12,
            frame_width: 12,
            frame_channels: 1,
            frame_stack: 1,
            num_actions: 3,
            n_step: 7,
            gamma: 0.99,
            horizon: Horizon::Nhg { k_max: 5 },
            timeout: TimeoutRule::Terminal,
        }
    }

    fn statuses() -> (ReplayStatus, LearnerStatus) {
        let replay = ReplayStatus {
            transitions_inserted: 2_000,
            warmup_transitions: 1_000,
            rows_sampled: 8_000,
            episodes: 7,
            mean_return: Some(0.5),
            k_histogram: vec![2, 1, 1],
            waiting: Waiting::Finished,
            ..ReplayStatus::default()
        };
        let learner = LearnerStatus {
            updates: 31,
            dim: [None, None, None, Some(2.0)],
            weights_version: 4,
            weights_sha256: "abcd".into(),
            finished: true,
            ..LearnerStatus::default()
        };
        (replay, learner)
    }

    #[test]
    fn a_run_leaves_settings_metrics_and_a_summary() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let mut recorder =
            Recorder::create(&run, "[run]\n", &["replay-server".into(), "actor-0".into()]).unwrap();
        let (replay, learner) = statuses();
        recorder
            .record(&ReplayStatus::default(), &LearnerStatus::default(), &[])
            .unwrap();
        recorder
            .record(&replay, &learner, &[Some(12.34), None])
            .unwrap();
        let summary = recorder
            .finish(Outcome::Finished, &spec(), &replay, &learner)
            .unwrap();
        assert_eq!(
            (summary.frames, summary.replay_ratio, summary.mean_k),
            (2_000, Some(8.0), Some(1.5))
        );

        let csv = fs::read_to_string(run.join("metrics.csv")).unwrap();
        let columns: Vec<_> = csv.lines().map(|line| line.split(',').count()).collect();
        assert_eq!(columns, [25, 25, 25], "{csv}");
        expect!["seconds,frames,updates,frames_per_second,updates_per_second,replay_ratio,episodes,mean_return,c51_kl,dim_3t3,dim_3t4,dim_4t3,dim_4t4,total_loss,grad_norm,q_mean,mean_k,sd_k,mean_age,weights_version,affinity_version,actors,waiting,rss_mib_replay_server,rss_mib_actor_0"]
            .assert_eq(csv.lines().next().unwrap());

        let json: serde_json::Value =
            serde_json::from_slice(&fs::read(run.join("summary.json")).unwrap()).unwrap();
        for key in [
            "frames",
            "updates",
            "transitions_inserted",
            "transitions_lost",
            "transitions_duplicated",
            "rows_sampled",
            "replay_ratio",
            "episodes",
            "mean_return",
            "wall_seconds",
            "frames_per_second",
            "updates_per_second",
            "mean_k",
            "weights_version",
            "weights_sha256",
        ] {
            assert!(!json[key].is_null(), "{key}");
        }
        assert_eq!(json["outcome"], "finished");
        assert_eq!(json["rss_mib_max"]["replay-server"], 12.0);
    }

    #[test]
    fn a_resumed_run_goes_on_in_its_metrics() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let processes = ["replay-server".into()];
        let mut recorder = Recorder::create(&run, "[run]\n", &processes).unwrap();
        let (mut replay, mut learner) = statuses();
        // Mean k is 1.5 before the run is resumed, and 2 since.
        for (frames, updates, episodes) in [(1_000, 0, 1), (2_000, 31, 7), (3_000, 62, 9)] {
            (replay.transitions_inserted, replay.episodes) = (frames, episodes);
            learner.updates = updates;
            recorder.record(&replay, &learner, &[]).unwrap();
        }
        let behind = Behind {
            updates: 31,
            frames: 2_000,
        };
        let said = Recorder::go_on(&run, "", &processes, behind, 9_999).unwrap_err();
        assert!(said.to_string().contains("is still going on"), "{said}");
        recorder
            .finish(Outcome::Interrupted, &spec(), &replay, &learner)
            .unwrap();
        drop(recorder);
        // A launcher that was killed while it wrote.
        let path = run.join("metrics.csv");
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, format!("{text}9.0,40")).unwrap();

        let other = ["replay-server".into(), "actor-0".into()];
        let said = Recorder::go_on(&run, "", &other, behind, 9_999).unwrap_err();
        assert!(said.to_string().contains("has other columns"), "{said}");
        let mut recorder = Recorder::go_on(&run, "[new]\n", &processes, behind, 9_999).unwrap();
        assert!(!run.join("summary.json").exists());
        // While the replay fills again nothing is new.
        (replay.transitions_inserted, replay.episodes) = (1_500, 1);
        learner.updates = 31;
        recorder.record(&replay, &learner, &[]).unwrap();
        (replay.transitions_inserted, replay.episodes) = (2_100, 2);
        replay.k_histogram = vec![0, 0, 5];
        learner.updates = 62;
        recorder.record(&replay, &learner, &[]).unwrap();
        let summary = recorder
            .finish(Outcome::Finished, &spec(), &replay, &learner)
            .unwrap();
        let counts = (summary.frames, summary.updates, summary.episodes);
        assert_eq!(counts, (2_100, 62, 7 + 2));
        assert_eq!(summary.mean_k, Some(1.75), "31 updates at 1.5, 31 at 2");
        assert_eq!(summary.resumed_after_updates, 31);
        let all = Behind {
            updates: 99,
            ..behind
        };
        let read = |frames_max| Rows::read(&path, header(&processes), all, frames_max).unwrap();
        assert_eq!(read(2_050).rows.len(), 2);
        let rows = read(9_999);
        let column = |name| -> Vec<f64> {
            let values = rows.rows.iter().map(|row| rows.value(row, name).unwrap());
            values.collect()
        };
        assert_eq!(column("frames"), [1_000.0, 2_000.0, 2_100.0]);
        assert_eq!(column("episodes"), [1.0, 7.0, 9.0]);
        assert_eq!(column("mean_k"), [1.5, 1.5, 1.75]);
        // Squares: 2.5 and 4 are 3.25 in the mean, 1.75^2 is 3.0625.
        assert_eq!(column("sd_k"), [0.5, 0.5, 0.433013]);
        assert!(column("seconds").is_sorted());
    }

    #[test]
    fn a_folder_in_use_is_refused_and_an_empty_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        assert!(check_free(folder.path()).is_ok());
        fs::write(folder.path().join("x"), "").unwrap();
        let said = check_free(folder.path()).unwrap_err().to_string();
        assert!(
            said.contains("exists and is not empty: choose another --run-dir"),
            "{said}"
        );
        assert!(check_free(&folder.path().join("x")).is_err());
    }
}
