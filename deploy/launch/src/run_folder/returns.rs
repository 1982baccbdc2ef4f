//! `returns.csv`: the return of every training episode, kept over a run's resumptions, and the mean of the last 100.
//! It is told what each shard's replay server said when the launcher looked; what an episode is, is theirs to say.
//!
//! Columns: `frames`, the run's count when the episode was heard of, up to a second after it ended; `episode`, its number among
//! those of which all was seen; `return`, undiscounted. Of a shard in which more than 100 episodes ended between two looks
//! only the last 100 are here, and the numbers of the others are missing; the mean of the last 100 is right all the same.

use std::{collections::VecDeque, fs, io::ErrorKind};

use anyhow::Context;
use driml_machine::error::usage;
use driml_protocol::{RETURNS_OF, ReplayStatus, Returns};

use super::{columns::Columns, folder::RunFolder, growing_csv::GrowingCsv};

const HEADER: [&str; 3] = ["frames", "episode", "return"];

/// A mean, and of how many returns it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeanReturn {
    /// The mean return of the newest episodes.
    pub mean: f64,
    /// Episodes: 100, or as many as there were.
    pub of: usize,
}

/// The training's episodes so far, also over a resumption.
#[derive(Clone, Copy, Debug, Default)]
pub struct Episodes {
    /// How many ended.
    pub count: u64,
    /// Mean return of the last 100 of them, or of as many as there were; none before the first.
    pub mean_return: Option<MeanReturn>,
}

/// The returns of a run.
#[derive(Debug)]
pub(super) struct TrainingReturns {
    table: GrowingCsv,
    /// The newest, the oldest first.
    newest: VecDeque<f64>,
    /// The number of the newest.
    episode: u64,
    /// Frames in the last row.
    frames: u64,
    /// How many each shard knew of when it was heard last.
    heard: Vec<u64>,
    /// The shards know of the episodes that were heard before this one was made.
    is_known: bool,
}

impl TrainingReturns {
    /// Of a run that begins.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(super) fn create(folder: &RunFolder) -> anyhow::Result<Self> {
        Self::begin(folder, &[], false)
    }

    /// Of a run that goes on: with what was heard until it had `frames_max` frames; `is_known` if its replay knows of them. A run that began with an older version has
    /// no such file, and begins one.
    ///
    /// # Errors
    /// A file that is none of this kind, a file system that refuses.
    pub(super) fn go_on(
        folder: &RunFolder,
        frames_max: u64,
        is_known: bool,
    ) -> anyhow::Result<Self> {
        let path = folder.returns();
        let reading = || format!("reading {}", path.display());
        let text = match fs::read(&path) {
            Err(e) if e.kind() == ErrorKind::NotFound => Vec::new(),
            read => read.with_context(reading)?,
        };
        let mut rows = Vec::new();
        for row in Columns::parse(&text).with_context(reading)?.rows {
            let (frames, ..) = read(&row)
                .ok_or_else(|| usage!("{}: {row:?} is no row of returns", path.display()))?;
            if frames <= frames_max {
                rows.push(row);
            }
        }
        Self::begin(folder, &rows, is_known)
    }

    fn begin(
        folder: &RunFolder,
        rows: &[csv::StringRecord],
        is_known: bool,
    ) -> anyhow::Result<Self> {
        let table = GrowingCsv::create(&folder.returns(), &HEADER.map(String::from), rows)?;
        let known: Vec<_> = rows.iter().filter_map(read).collect();
        let newest = known.iter().rev().take(RETURNS_OF).rev();
        let (frames, episode, _) = known.last().copied().unwrap_or_default();
        Ok(Self {
            table,
            newest: newest.map(|&(.., value)| value).collect(),
            episode,
            frames,
            heard: Vec::new(),
            is_known,
        })
    }

    /// Takes what each shard knows now. Returns warnings about the file.
    pub(super) fn hear(&mut self, shards: &[ReplayStatus]) -> Option<String> {
        let frames = shards.iter().map(|it| it.transitions_inserted).sum();
        // While a resumed run's replay fills again it counts frames that it had before.
        self.frames = self.frames.max(frames);
        self.heard.resize(shards.len().max(self.heard.len()), 0);
        if std::mem::take(&mut self.is_known) {
            self.take_as_heard(shards);
        }
        let mut said = None;
        for (shard, status) in shards.iter().enumerate() {
            let Returns { known, newest } = &status.returns;
            // A server that knows of fewer than before is another one.
            let fresh = known.checked_sub(self.heard[shard]).unwrap_or(*known);
            self.heard[shard] = *known;
            let here = fresh.min(newest.len() as u64);
            self.episode += fresh - here;
            for &value in &newest[newest.len() - here as usize..] {
                said = said.or(self.add(value));
            }
        }
        said
    }

    /// What the shards knew of when the last return was heard: all but the newest, which they share as they come.
    fn take_as_heard(&mut self, shards: &[ReplayStatus]) {
        let mut unheard: u64 = shards.iter().map(|it| it.returns.known).sum();
        unheard = unheard.saturating_sub(self.episode);
        for (heard, status) in self.heard.iter_mut().zip(shards) {
            let here = unheard.min(status.returns.known);
            *heard = status.returns.known - here;
            unheard -= here;
        }
    }

    fn add(&mut self, value: f64) -> Option<String> {
        self.episode += 1;
        if self.newest.len() == RETURNS_OF {
            self.newest.pop_front();
        }
        self.newest.push_back(value);
        let row = [
            self.frames.to_string(),
            self.episode.to_string(),
            value.to_string(),
        ];
        self.table.add(row)
    }

    /// The mean of the last 100, or of as many as there are; none before the first.
    pub(super) fn mean(&self) -> Option<MeanReturn> {
        let of = self.newest.len();
        let sum: f64 = self.newest.iter().sum();
        (of > 0).then(|| MeanReturn {
            mean: sum / of as f64,
            of,
        })
    }

    /// What is missing in the file, as [`GrowingCsv::missing`] says it.
    pub(super) fn missing(&self) -> Option<String> {
        self.table.missing()
    }
}

/// Frames, number and return in a row.
fn read(row: &csv::StringRecord) -> Option<(u64, u64, f64)> {
    let cell = |at| row.get(at);
    Some((
        cell(0)?.parse().ok()?,
        cell(1)?.parse().ok()?,
        cell(2)?.parse().ok()?,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A shard that knows of so many episodes whose returns are their numbers from `first`.
    fn shard(frames: u64, known: u64, first: u64) -> ReplayStatus {
        let newest = (known - known.min(RETURNS_OF as u64)..known).map(|n| (first + n) as f64);
        ReplayStatus {
            transitions_inserted: frames,
            returns: Returns {
                known,
                newest: newest.collect(),
            },
            ..ReplayStatus::default()
        }
    }

    fn rows(folder: &RunFolder) -> Vec<String> {
        let text = fs::read_to_string(folder.returns()).unwrap();
        text.lines().skip(1).map(str::to_owned).collect()
    }

    #[test]
    fn every_return_is_taken_once_from_every_shard() {
        let root = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(root.path());
        let mut returns = TrainingReturns::create(&folder).unwrap();
        assert_eq!(returns.mean(), None);
        returns.hear(&[shard(10, 1, 0), shard(5, 0, 50)]);
        returns.hear(&[shard(20, 3, 0), shard(5, 1, 50)]);
        returns.hear(&[shard(20, 3, 0), shard(5, 1, 50)]);
        assert_eq!(rows(&folder), ["15,1,0", "25,2,1", "25,3,2", "25,4,50"]);
        let mean = MeanReturn {
            mean: 53.0 / 4.0,
            of: 4,
        };
        assert_eq!(returns.mean(), Some(mean));
    }

    #[test]
    fn the_mean_is_of_the_last_100_though_more_ended_at_once() {
        let root = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(root.path());
        let mut returns = TrainingReturns::create(&folder).unwrap();
        returns.hear(&[shard(10, 5, 0)]);
        returns.hear(&[shard(90, 255, 0)]);
        let mean = MeanReturn {
            mean: (155.0 + 254.0) / 2.0,
            of: 100,
        };
        assert_eq!(returns.mean(), Some(mean));
        let rows = rows(&folder);
        assert_eq!(rows.len(), 105);
        // 150 of them are in no row, but they have numbers.
        assert_eq!([&rows[5], &rows[104]], ["90,156,155", "90,255,254"]);
    }

    #[test]
    fn a_run_that_goes_on_has_the_returns_before() {
        let root = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(root.path());
        let mut returns = TrainingReturns::create(&folder).unwrap();
        returns.hear(&[shard(1_000, 60, 0)]);
        returns.hear(&[shard(2_000, 70, 0)]);
        // What came after the checkpoint does not count, nor what was cut off.
        returns.hear(&[shard(3_000, 90, 0)]);
        let path = folder.returns();
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text + "3000,91").unwrap();

        let mut returns = TrainingReturns::go_on(&folder, 2_500, false).unwrap();
        assert_eq!(returns.mean().unwrap(), MeanReturn { mean: 34.5, of: 70 });
        // Another server, which counts from the start; the replay fills again.
        returns.hear(&[shard(1_500, 40, 1_000)]);
        let expected: f64 = (10..70).chain(1_000..1_040).map(f64::from).sum();
        assert_eq!(
            returns.mean().unwrap(),
            MeanReturn {
                mean: expected / 100.0,
                of: 100
            }
        );
        assert_eq!(rows(&folder).last().unwrap(), "2000,110,1039");

        // A server that knows of those before, and of four more.
        let mut returns = TrainingReturns::go_on(&folder, 2_500, true).unwrap();
        returns.hear(&[shard(2_600, 114, 0)]);
        returns.hear(&[shard(2_600, 115, 0)]);
        let text = rows(&folder);
        assert_eq!(text[text.len() - 5], "2600,111,110");
        assert_eq!(text.last().unwrap(), "2600,115,114");

        fs::remove_file(&path).unwrap();
        assert_eq!(
            TrainingReturns::go_on(&folder, 9, false).unwrap().mean(),
            None
        );
        fs::write(&path, "a,b,c\n1,x,3\n").unwrap();
        let said = TrainingReturns::go_on(&folder, 9, false).unwrap_err();
        assert!(said.to_string().contains("is no row of returns"), "{said}");
    }
}
