//! The table of `metrics.csv`: its columns, a row, and the rows that a resumed run keeps.
//! It writes no file: the recorder does.

use std::{
    fs::File,
    io::{BufRead, BufReader, Read, Seek, SeekFrom},
    path::Path,
};

use driml_machine::error::usage;
use driml_protocol::{LearnerStatus, ReplayStatus};

use super::{
    columns::{Columns, set_aside},
    episodes::Episodes,
    folder::RunFolder,
    resume_point::ResumePoint,
};

/// Bytes at the end of the file in which its last row lies.
const LAST_ROW_BYTES: u64 = 4096;

/// The columns of the metrics: the auxiliary `losses` stand between C51's and the total.
pub(super) fn header(losses: &[&str], processes: &[String]) -> Vec<String> {
    let counts = [
        "seconds",
        "frames",
        "updates",
        "frames_per_second",
        "updates_per_second",
        "replay_ratio",
        "episodes",
        "mean_return",
        "mean_return_of",
        "c51_kl",
    ];
    let rest = [
        "total_loss",
        "grad_norm",
        "q_mean",
        "mean_k",
        "sd_k",
        "mean_age",
        "weights_version",
        "affinity_version",
        "actors",
        "waiting",
        "epsilon",
    ];
    let rss = processes
        .iter()
        .map(|name| format!("rss_mib_{}", name.replace('-', "_")));
    let counts = counts.map(String::from).into_iter();
    counts
        .chain(losses.iter().map(ToString::to_string))
        .chain(rest.map(String::from))
        .chain(rss)
        .collect()
}

/// What a row of metrics says.
pub(super) struct Moment<'a> {
    /// Since the run's start, without the time between its interruption and its resumption.
    pub(super) seconds: f64,
    /// Frames and updates a second.
    pub(super) rates: (f64, f64),
    pub(super) episodes: Episodes,
    /// Mean and standard deviation of k.
    pub(super) k: Option<(f64, f64)>,
    pub(super) replay: &'a ReplayStatus,
    pub(super) learner: &'a LearnerStatus,
    /// How likely all actors act at random; none where they differ in that.
    pub(super) epsilon: Option<f64>,
    /// The names of the agent's auxiliary losses.
    pub(super) losses: &'a [&'static str],
    /// Resident memory of each process, MiB; none for one that ended.
    pub(super) rss_mib: Vec<Option<f64>>,
}

impl Moment<'_> {
    /// The cells, in the order of [`header`].
    pub(super) fn row(&self) -> Vec<String> {
        let (replay, learner) = (self.replay, self.learner);
        let mean_return = self.episodes.mean_return;
        let some = |value: Option<f64>| value.map_or(String::new(), number);
        // What has not been computed is left empty: a 0 would look like a loss.
        let computed = |value: f64| some((learner.updates > 0).then_some(value));
        let mut row = vec![
            format!("{:.3}", self.seconds),
            replay.transitions_inserted.to_string(),
            learner.updates.to_string(),
            format!("{:.2}", self.rates.0),
            format!("{:.3}", self.rates.1),
            some(replay.replay_ratio()),
            self.episodes.count.to_string(),
            some(mean_return.map(|it| it.mean)),
            mean_return.map_or(0, |it| it.of).to_string(),
            computed(learner.c51_kl.into()),
        ];
        let losses = self.losses.iter().map(|name| learner.loss(name));
        row.extend(losses.map(|loss| some(loss.map(f64::from))));
        row.extend([
            computed(learner.total.into()),
            computed(learner.grad_norm),
            computed(learner.q_mean.into()),
            some(self.k.map(|(mean, _)| mean)),
            some(self.k.map(|(_, sd)| sd)),
            format!("{:.1}", replay.mean_age),
            learner.weights_version.to_string(),
            replay.affinity_version.to_string(),
            replay.actors.to_string(),
            replay.waiting.to_string(),
            some(self.epsilon),
        ]);
        let rss = self.rss_mib.iter();
        row.extend(rss.map(|mib| mib.map_or(String::new(), |mib| format!("{mib:.1}"))));
        row
    }
}

/// A number with six decimals; in powers of ten where these would leave fewer than four digits of it, or are far more than it has.
fn number(value: f64) -> String {
    if value == 0.0 || (1e-3..1e15).contains(&value.abs()) {
        format!("{value:.6}")
    } else {
        format!("{value:.6e}")
    }
}

/// The rows of an interrupted run up to `resume_point`, of no more than `frames_max` frames, under this header; none where there is no
/// such file. The others, which contradict what the run will do, are moved to another file, and a line names it.
///
/// # Errors
/// A file of something else, or a file system that refuses.
pub(super) fn rows_up_to(
    path: &Path,
    header: Vec<String>,
    resume_point: ResumePoint,
    frames_max: u64,
) -> anyhow::Result<Columns> {
    let found = Columns::read(path)?;
    let place = |name: &String| found.place(name);
    let places: Vec<_> = header.iter().map(place).collect();
    let (mut kept, mut aside) = (Vec::new(), Vec::new());
    for row in found.rows {
        let count = |name: &str| {
            let at = found.header.iter().position(|it| it == name)?;
            row.get(at)?.parse::<u64>().ok()
        };
        let (Some(updates), Some(frames)) = (count("updates"), count("frames")) else {
            return Err(usage!("{}: {row:?} is no row of metrics", path.display()).into());
        };
        // Actors run ahead: without the second condition a run that now ends sooner would end before its rows.
        if updates <= resume_point.updates && frames <= frames_max {
            let cell = |place: &Option<usize>| place.and_then(|at| row.get(at)).unwrap_or("");
            kept.push(places.iter().map(cell).collect());
        } else {
            aside.push(row);
        }
    }
    set_aside(path, &found.header, &aside)?;
    Ok(Columns { header, rows: kept })
}

/// Seconds that the run in `folder` has taken by its metrics, those rows included that a resumption makes again.
pub(super) fn seconds_of(folder: &RunFolder) -> f64 {
    let found = Columns::read(&folder.metrics()).unwrap_or_default();
    let seconds = found.rows.iter();
    let seconds = seconds.filter_map(|row| found.value::<f64>(row, "seconds"));
    seconds.fold(0.0, f64::max)
}

/// How far a run is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// Frames of the last row of metrics.
    pub frames: u64,
    /// Episodes of the last row of metrics.
    pub episodes: u64,
}

/// How far the run in `folder` is; none before its first row of metrics. Only the file's ends are read.
pub fn progress(folder: &RunFolder) -> Option<Progress> {
    let mut file = File::open(folder.metrics()).ok()?;
    let mut header = String::new();
    BufReader::new(&file).read_line(&mut header).ok()?;
    let length = file.metadata().ok()?.len();
    let start = length.saturating_sub(LAST_ROW_BYTES);
    file.seek(SeekFrom::Start(start)).ok()?;
    let mut end = Vec::new();
    file.read_to_end(&mut end).ok()?;
    let end = String::from_utf8_lossy(&end);
    // What follows the last line's end is still being written.
    let row = end.get(..end.rfind('\n')?)?.lines().last()?;
    let last = Columns::parse(format!("{header}{row}\n").as_bytes()).ok()?;
    Some(Progress {
        frames: last.last("frames")?,
        episodes: last.last("episodes")?,
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn small_and_large_numbers_keep_their_digits() {
        for (value, text) in [
            (0.0, "0.000000"),
            (4.007, "4.007000"),
            (-0.0125, "-0.012500"),
            (123_456.789, "123456.789000"),
            (1e-3, "0.001000"),
            (4.2e-7, "4.200000e-7"),
            (-9.87654321e-4, "-9.876543e-4"),
            (1.5e30, "1.500000e30"),
        ] {
            assert_eq!(number(value), text);
            let read: f64 = text.parse().unwrap();
            assert!((read - value).abs() <= 5e-4 * value.abs());
        }
    }

    #[test]
    fn the_last_whole_row_counts() {
        let root = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(root.path());
        let write = |text: &str| fs::write(folder.metrics(), text).unwrap();
        assert_eq!(progress(&folder), None);
        write("seconds,frames,updates,a,b,c,episodes\n");
        assert_eq!(progress(&folder), None);
        write("seconds,frames,updates,a,b,c,episodes\n1,200,3,,,,7\n2,30");
        let found = Progress {
            frames: 200,
            episodes: 7,
        };
        assert_eq!(progress(&folder), Some(found));
    }
}
