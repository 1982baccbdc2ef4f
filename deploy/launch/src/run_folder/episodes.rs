//! `episodes.csv`: a row for every training episode, kept over a run's resumptions, and the mean return of the last 100.
//! It is told what each shard's replay server answered; what an episode is, is theirs to say.
//!
//! Columns: `seconds` of the run when the episode was heard of, up to a second after it ended (empty where it had ended before the
//! run was watched); `frames`, the run's count with the chunk that held its end; `episode`, its number; `actor` and `copy`, who
//! played it, and in which copy of its world; `return`, undiscounted, and `length` in steps, both empty if a part of it was lost.
//! Of more than the replay server keeps between two looks the oldest are missing, and so are their numbers.

use std::collections::VecDeque;

use driml_machine::error::usage;
use driml_protocol::{EndedEpisode, EpisodesReply, Played, RETURNS_OF, ReplayStatus};

use super::{
    columns::{Columns, set_aside},
    folder::RunFolder,
    growing_csv::GrowingCsv,
};

const HEADER: [&str; 7] = [
    "seconds", "frames", "episode", "actor", "copy", "return", "length",
];

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

/// The episodes of a run.
#[derive(Debug)]
pub(super) struct TrainingEpisodes {
    table: GrowingCsv,
    /// The newest returns, the oldest first.
    newest: VecDeque<f64>,
    /// The number of the newest episode.
    episode: u64,
    /// Frames in the last row.
    frames: u64,
    /// Frames of the run when it was heard last.
    frames_heard: Option<u64>,
    /// How many had ended in each shard when it was heard last.
    heard: Vec<u64>,
    /// How many are in no row.
    lost: u64,
    folder: RunFolder,
    /// The rows with which it began, until it is known how many of them stay.
    rows: Vec<csv::StringRecord>,
    /// The shards know of the episodes that were heard before this one was made.
    is_known: bool,
}

impl TrainingEpisodes {
    /// Of a run that begins.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(super) fn create(folder: &RunFolder) -> anyhow::Result<Self> {
        Self::begin(folder, &[], false)
    }

    /// Of a run that goes on: with what was heard until it had `frames_max` frames; `is_known` if its replay knows of them. The others are moved to another file, and a line names it.
    ///
    /// # Errors
    /// A file that is none of this kind, a file system that refuses.
    pub(super) fn go_on(
        folder: &RunFolder,
        frames_max: u64,
        is_known: bool,
    ) -> anyhow::Result<Self> {
        let path = folder.episodes();
        let (mut rows, mut aside) = (Vec::new(), Vec::new());
        for row in Columns::read(&path)?.rows {
            let (frames, ..) = read(&row)
                .ok_or_else(|| usage!("{}: {row:?} is no row of episodes", path.display()))?;
            // A replay that was kept says itself how far it is, once it is heard.
            match is_known || frames <= frames_max {
                true => rows.push(row),
                false => aside.push(row),
            }
        }
        set_aside(&path, &HEADER.map(String::from), &aside)?;
        Self::begin(folder, &rows, is_known)
    }

    fn begin(
        folder: &RunFolder,
        rows: &[csv::StringRecord],
        is_known: bool,
    ) -> anyhow::Result<Self> {
        let table = GrowingCsv::create(&folder.episodes(), &HEADER.map(String::from), rows)?;
        let known: Vec<_> = rows.iter().filter_map(read).collect();
        let returns = known.iter().filter_map(|&(.., value)| value);
        let mut newest: VecDeque<_> = returns.rev().take(RETURNS_OF).collect();
        newest.make_contiguous().reverse();
        let (frames, episode, _) = known.last().copied().unwrap_or_default();
        Ok(Self {
            table,
            newest,
            episode,
            frames,
            frames_heard: None,
            heard: Vec::new(),
            lost: 0,
            is_known,
            rows: match is_known {
                true => rows.to_vec(),
                false => Vec::new(),
            },
            folder: folder.clone(),
        })
    }

    /// Takes what each shard says, and the episodes that `ended` there since, after so many `seconds` of the run, if they are known.
    /// Returns warnings about the file.
    pub(super) fn hear(
        &mut self,
        shards: &[ReplayStatus],
        ended: &[(usize, EpisodesReply)],
        seconds: Option<f64>,
    ) -> Vec<String> {
        let frames = shards.iter().map(|it| it.transitions_inserted).sum();
        // They were not there when it was looked last; what a shard knows of the others is older.
        let heard = self.frames_heard.replace(frames);
        let later = heard.map_or(0, |before| before.saturating_add(1).min(frames));
        // While a resumed run's replay fills again it counts frames that it had before.
        self.frames = self.frames.max(later);
        self.heard.resize(shards.len().max(self.heard.len()), 0);
        let mut said = Vec::new();
        if std::mem::take(&mut self.is_known) {
            said.extend(self.cut(frames).err().map(|e| format!("{e:#}")));
            self.take_as_heard(shards);
        }
        let mut rows = Vec::new();
        for (shard, reply) in ended {
            let heard = &mut self.heard[*shard];
            // A server that knows of fewer than before is another one.
            if reply.ended < *heard {
                *heard = 0;
            }
            let missing = reply.before.saturating_sub(*heard);
            let again = heard.saturating_sub(reply.before) as usize;
            *heard = reply.up_to().max(*heard);
            if missing > 0 {
                said.extend((self.lost == 0).then(|| {
                    format!("{missing} episodes have no row in episodes.csv: the replay server keeps no more between two looks")
                }));
                self.lost += missing;
                self.episode += missing;
            }
            for episode in reply.episodes.iter().skip(again) {
                rows.push(self.take(episode, seconds));
            }
        }
        // Those that could not be written before are tried again, too.
        said.extend(self.table.add_all(rows));
        said
    }

    /// Sets aside the episodes that ended after the run had so many frames: what came after is done again.
    fn cut(&mut self, frames_max: u64) -> anyhow::Result<()> {
        let rows = std::mem::take(&mut self.rows);
        let is_kept = |row: &csv::StringRecord| read(row).is_some_and(|it| it.0 <= frames_max);
        let (kept, aside): (Vec<_>, Vec<_>) = rows.into_iter().partition(is_kept);
        if !aside.is_empty() {
            set_aside(&self.folder.episodes(), &HEADER.map(String::from), &aside)?;
            let heard = std::mem::take(&mut self.heard);
            *self = Self {
                heard,
                frames_heard: self.frames_heard,
                ..Self::begin(&self.folder, &kept, false)?
            };
        }
        Ok(())
    }

    /// What the shards knew of when the last episode was heard: all but the newest, which they share as they come.
    fn take_as_heard(&mut self, shards: &[ReplayStatus]) {
        let mut unheard: u64 = shards.iter().map(|it| it.episodes).sum();
        unheard = unheard.saturating_sub(self.episode);
        for (heard, status) in self.heard.iter_mut().zip(shards) {
            let here = unheard.min(status.episodes);
            *heard = status.episodes - here;
            unheard -= here;
        }
    }

    /// Counts an episode and gives its row.
    fn take(&mut self, ended: &EndedEpisode, seconds: Option<f64>) -> [String; HEADER.len()] {
        self.episode += 1;
        self.frames = self.frames.max(ended.frames);
        let played = ended.played.map(|it| Played {
            episode_return: rounded(it.episode_return),
            ..it
        });
        if let Some(played) = played {
            if self.newest.len() == RETURNS_OF {
                self.newest.pop_front();
            }
            self.newest.push_back(played.episode_return);
        }
        let of_whole = |cell: fn(Played) -> String| played.map_or(String::new(), cell);
        [
            seconds.map_or(String::new(), |it| format!("{it:.3}")),
            self.frames.to_string(),
            self.episode.to_string(),
            ended.actor.to_string(),
            ended.copy.to_string(),
            of_whole(|it| it.episode_return.to_string()),
            of_whole(|it| it.steps.to_string()),
        ]
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

    /// Number of the newest episode.
    pub(super) const fn count(&self) -> u64 {
        self.episode
    }

    /// What is missing in the file.
    pub(super) fn missing(&self) -> Vec<String> {
        let lost = (self.lost > 0).then(|| {
            format!(
                "{} episodes have no row in episodes.csv: more ended between two looks than the replay server keeps",
                self.lost
            )
        });
        self.table.missing().into_iter().chain(lost).collect()
    }
}

/// A sum of rewards that were f32 without the digits that their conversion added: -0.6, not -0.5999999940395355. Small numbers keep
/// seven digits.
pub fn rounded(value: f64) -> f64 {
    let text = match value.abs() < 1e-3 {
        true => format!("{value:.6e}"),
        false => format!("{value:.6}"),
    };
    text.parse().unwrap_or(value)
}

/// Frames, number and return in a row.
fn read(row: &csv::StringRecord) -> Option<(u64, u64, Option<f64>)> {
    let [_, frames, episode, _, _, value, _] = [0, 1, 2, 3, 4, 5, 6].map(|at| row.get(at));
    let value = match value? {
        "" => None,
        value => Some(value.parse().ok()?),
    };
    Some((frames?.parse().ok()?, episode?.parse().ok()?, value))
}

#[cfg(test)]
#[path = "episodes_tests.rs"]
mod tests;
