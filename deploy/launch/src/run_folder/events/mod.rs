//! TensorBoard's event file beside `metrics.csv`: each row as points of curves over frames, histograms of k and of actions, and
//! images of the action affinity A. This program never reads the file.
//!
//! A resumed run begins another file, which invalidates what the file before has beyond the rows that are kept; TensorBoard reads both.

mod encode;

use std::{
    fs,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use driml_figure::{Ink, Picture, Rect};
use driml_learner::checkpoint;
use driml_protocol::ReplayStatus;

use self::encode::{EventTime, Value};
use super::{
    folder::{EVENTS_PREFIX, RunFolder},
    table::AppendLog,
};

/// How often histograms are written and a new A is looked for; curves are written with each row.
const SLOW_PERIOD: Duration = Duration::from_secs(10);
/// Pixels of one entry of A, of the caption below, and of the margin around.
const CELL: usize = 24;
const CAPTION: usize = 22;
const MARGIN: usize = 8;

#[derive(Debug)]
pub(super) struct Events {
    pub(super) file: AppendLog,
    folder: RunFolder,
    slow_at: Option<Instant>,
    k_counts: Vec<u64>,
    action_counts: Vec<u64>,
    drawn_updates: Option<u64>,
}

impl Events {
    /// Creates a file, which invalidates what earlier files of the run have beyond `frames_kept`. TensorBoard reads files in the order of
    /// their names, so the second in this one's name is later than in the others, even if the clock was set back.
    pub(super) fn create(folder: &RunFolder, frames_kept: u64) -> anyhow::Result<Self> {
        let seconds = unix_seconds();
        let others = fs::read_dir(folder.path())?.flatten().filter_map(|it| {
            let name = it.file_name().into_string().ok()?;
            let second = name.strip_prefix(EVENTS_PREFIX)?.get(..10)?;
            second.parse::<u64>().ok()
        });
        let newest = others.max();
        let second = newest.map_or(0, |it| it + 1).max(seconds as u64);
        let name = format!("{EVENTS_PREFIX}{second:010}.driml");
        let path = folder.path().join(name);
        let mut first = encode::version(EventTime { seconds, step: 0 });
        if newest.is_some() {
            let step = frames_kept + 1;
            first.extend(encode::restart_record(EventTime { seconds, step }));
        }
        Ok(Self {
            file: AppendLog::create(&path, &first)?,
            folder: folder.clone(),
            slow_at: None,
            k_counts: Vec::new(),
            action_counts: Vec::new(),
            drawn_updates: None,
        })
    }

    /// Adds points of curves by name, and, every ten seconds and at the run's end, histograms and A. Returns a warning as
    /// [`AppendLog::add`] does.
    pub(super) fn add(
        &mut self,
        points: &[(String, f64)],
        replay: &ReplayStatus,
        is_last: bool,
    ) -> Option<String> {
        let at = EventTime {
            seconds: unix_seconds(),
            step: replay.transitions_inserted,
        };
        let curve = |(name, value): &(String, f64)| (name.clone(), Value::Scalar(*value as f32));
        let curves: Vec<_> = points.iter().map(curve).collect();
        let mut records = vec![encode::summary(at, &curves)];
        let is_slow_due = self.slow_at.is_none_or(|it| it.elapsed() >= SLOW_PERIOD);
        if is_last || is_slow_due {
            self.slow_at = Some(Instant::now());
            records.extend(self.histograms(at, replay));
            records.extend(self.affinity(at));
        }
        self.file.add(records)
    }

    /// Histograms of what was counted since the last ones.
    fn histograms(&mut self, at: EventTime, replay: &ReplayStatus) -> Option<Vec<u8>> {
        let mut histograms = Vec::new();
        let (of_k, of_actions) = (&mut self.k_counts, &mut self.action_counts);
        for (name, now, before) in [
            ("k/served", &replay.k_histogram, of_k),
            ("actions/stored", &replay.action_histogram, of_actions),
        ] {
            let counts = counts_since(now, before);
            before.clone_from(now);
            if counts.iter().any(|&n| n > 0) {
                histograms.push((name.to_owned(), Value::Counts(counts)));
            }
        }
        (!histograms.is_empty()).then(|| encode::summary(at, &histograms))
    }

    /// Draws A of a new checkpoint. A checkpoint that cannot be read just now is tried again later.
    fn affinity(&mut self, at: EventTime) -> Option<Vec<u8>> {
        let (updates, path) = self.folder.newest_checkpoint()?;
        if self.drawn_updates.is_some_and(|drawn| drawn >= updates) {
            return None;
        }
        let affinity = checkpoint::read_affinity(&path).ok()?;
        self.drawn_updates = Some(updates);
        let affinity = affinity?;
        let picture = draw_affinity(affinity.num_actions(), &affinity.matrix()).ok()?;
        let (width, height) = picture.size();
        let png = picture.png().ok()?;
        let image = Value::Image { width, height, png };
        Some(encode::summary(at, &[("affinity/A".to_owned(), image)]))
    }
}

fn unix_seconds() -> f64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.unwrap_or_default().as_secs_f64()
}

/// The counts since `before`, or all counts if a counter has restarted.
fn counts_since(now: &[u64], before: &[u64]) -> Vec<u64> {
    let before = before.iter().copied().chain(std::iter::repeat(0));
    let both = now.iter().zip(before);
    let difference: Option<Vec<_>> = both.map(|(now, before)| now.checked_sub(before)).collect();
    difference.unwrap_or_else(|| now.to_vec())
}

/// Draws A as cells: each row is an action, each column the next action.
fn draw_affinity(side: usize, matrix: &[f32]) -> anyhow::Result<Picture> {
    let length = side * CELL;
    let width = (length + 2 * MARGIN).max(320);
    let mut picture = Picture::new(width, length + 2 * MARGIN + CAPTION)?;
    let most = matrix.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    let shares: Vec<_> = matrix.iter().map(|a| f64::from(a / most)).collect();
    let [left, length, room] = [MARGIN, length, width - 2 * MARGIN].map(|it| it as f64);
    picture.cells(Rect::new(left, left, length, length), side, &shares);
    let caption = format!("A: row, action; column, next; light: {most:.3}");
    let below = (left, left + length + CAPTION as f64 - 5.0);
    picture.text(below, room, Ink::Soft, &caption);
    Ok(picture)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{make, run_folder};

    #[test]
    fn counts_are_those_since_the_last_histogram() {
        assert_eq!(counts_since(&[1, 5, 2], &[1, 2]), [0, 3, 2]);
        assert_eq!(counts_since(&[1, 0], &[2, 0]), [1, 0], "of another server");
    }

    #[test]
    fn a_file_is_whole_records() {
        let (root, folder) = run_folder();
        let mut events = Events::create(&folder, 0).unwrap();
        let replay = make(|it: &mut ReplayStatus| {
            (it.transitions_inserted, it.k_histogram) = (70, vec![0, 4, 1]);
        });
        let points = [("return/mean_return".to_owned(), 1.5)];
        assert_eq!(events.add(&points, &replay, false), None);
        let again = Events::create(&folder, 70).unwrap();
        assert_eq!(again.file.loss_message(), None);
        let mut counts = Vec::new();
        let files = fs::read_dir(root.path()).unwrap();
        let mut paths: Vec<_> = files.map(|it| it.unwrap().path()).collect();
        paths.sort();
        for path in paths {
            let text = fs::read(path).unwrap();
            let mut rest = &text[..];
            let mut records = 0;
            // A record's length, its checksum, the data, its checksum.
            while let Some(length) = rest.first_chunk() {
                rest = &rest[8 + 4 + u64::from_le_bytes(*length) as usize + 4..];
                records += 1;
            }
            assert!(rest.is_empty());
            counts.push(records);
        }
        let what = "version, curves, histogram; version, what is taken back";
        assert_eq!(counts, [3, 2], "{what}");
        // The clock was set back since the newest file was begun.
        let named = |second: u64| root.path().join(format!("{EVENTS_PREFIX}{second}.driml"));
        fs::write(named(5_000_000_000), "").unwrap();
        Events::create(&folder, 70).unwrap();
        assert!(named(5_000_000_001).exists());
    }
}
