//! `episodes.csv`: a row for every training episode, kept over a run's resumptions, and the mean return of the last 100.
//! Each shard's replay server is asked for the episodes that ended; what an episode is, is theirs to say.
//!
//! Columns: `seconds` of the run when the episode was received, up to a second after it ended (empty where it had ended before the
//! run was watched); `frames`, the run's count with the chunk that held its end; `episode`, its number; `actor` and `env`, who
//! played it, and in which environment; `return`, undiscounted, and `length` in steps, both empty if a part of it was lost.
//! Of more than the replay server keeps between two looks the oldest are missing, and so are their numbers.

use std::collections::VecDeque;

use driml_machine::error::usage;
use driml_protocol::{EndedEpisode, EpisodesReply, Played, RETURNS_OF, ReplayStatus};

use super::{
    folder::RunFolder,
    table::{AppendLog, Table, csv_row},
};
use crate::{metrics::rounded, run_view::Episodes};

/// Answers that are asked of one shard at a time; what they do not hold comes the next time.
const ASKS_MAX: usize = 16;

const HEADER: &str = "seconds,frames,episode,actor,env,return,length";
/// Places in it.
const EPISODE: usize = 2;
const ACTOR: usize = 3;

#[derive(Debug)]
pub(super) struct TrainingEpisodes {
    table: AppendLog,
    /// The newest returns, the oldest first.
    newest: VecDeque<f64>,
    /// The number of the newest.
    pub(super) episode: u64,
    frames: u64,
    frames_at_status: Option<u64>,
    /// How many had ended in each shard at its last status.
    received: Vec<u64>,
    lost: u64,
    folder: RunFolder,
    /// The rows with which it began, and of how many the shards do not know, until their first status shows how many stay; none if they
    /// know of none.
    known: Option<(Table, u64)>,
}

impl TrainingEpisodes {
    pub(super) fn create(folder: &RunFolder) -> anyhow::Result<Self> {
        Self::begin(folder, Table::default(), None)
    }

    /// Of a run that is resumed: with what ended until it had `frames_max` frames. The others are set aside. If its replay knows of them,
    /// the number of the first ones of which it does not.
    pub(super) fn go_on(
        folder: &RunFolder,
        frames_max: u64,
        unknown: Option<u64>,
    ) -> anyhow::Result<Self> {
        let path = folder.episodes();
        let mut rows = Table::read(&path)?;
        rows.keep(&path, |_, row| {
            let (frames, ..) = read(row)
                .ok_or_else(|| usage!("{}: {row:?} is not a row of episodes", path.display()))?;
            // A replay that was kept says itself how far it is, once it answers.
            Ok(unknown.is_some() || frames <= frames_max)
        })?;
        Self::begin(folder, rows, unknown)
    }

    fn begin(folder: &RunFolder, mut rows: Table, unknown: Option<u64>) -> anyhow::Result<Self> {
        rows.header = HEADER.split(',').map(String::from).collect();
        let table = AppendLog::create(&folder.episodes(), &rows.text())?;
        let known: Vec<_> = rows.rows.iter().filter_map(read).collect();
        let returns = known.iter().filter_map(|&(.., value)| value);
        let mut newest: VecDeque<_> = returns.rev().take(RETURNS_OF).collect();
        newest.make_contiguous().reverse();
        let (frames, episode, _) = known.last().copied().unwrap_or_default();
        Ok(Self {
            table,
            newest,
            episode,
            frames,
            frames_at_status: None,
            received: Vec::new(),
            lost: 0,
            known: unknown.map(|unknown| (rows, unknown)),
            folder: folder.clone(),
        })
    }

    /// Takes what each shard counts and asks it for the episodes that ended since those that are known, after so many `seconds` of the
    /// run, if they are known. The file then holds as many as the shards count, and each once. Returns warnings about the file.
    pub(super) fn update(
        &mut self,
        shards: &[ReplayStatus],
        ask: impl Fn(usize, u64) -> Option<EpisodesReply>,
        seconds: Option<f64>,
    ) -> Vec<String> {
        let frames = shards.iter().map(|it| it.transitions_inserted).sum();
        // They were not there the last time; what a shard knows of the others is older.
        let received = self.frames_at_status.replace(frames);
        let later = received.map_or(0, |before| before.saturating_add(1).min(frames));
        // While a resumed run's replay fills again it counts frames that it had before.
        self.frames = self.frames.max(later);
        self.received
            .resize(shards.len().max(self.received.len()), 0);
        let mut warnings = Vec::new();
        if let Some((mut rows, unknown)) = self.known.take() {
            let cut = self.cut(&mut rows, frames);
            warnings.extend(cut.err().map(|e| format!("{e:#}")));
            self.take_as_received(shards, &rows, unknown);
        }
        let mut rows = Vec::new();
        for (shard, status) in shards.iter().enumerate() {
            // A server that knows of fewer than before is another one.
            let mut received = self.received[shard];
            if status.episodes < received {
                received = 0;
            }
            for _ in 0..ASKS_MAX {
                if received >= status.episodes {
                    break;
                }
                let is_newer =
                    |it: &EpisodesReply| it.ended >= status.episodes && it.before >= received;
                let Some(reply) = ask(shard, received).filter(is_newer) else {
                    break;
                };
                let missing = reply.before - received;
                if missing > 0 {
                    warnings.extend((self.lost == 0).then(|| {
                        format!("{missing} episodes have no row in episodes.csv: the replay server keeps no more between two looks")
                    }));
                    self.lost += missing;
                    self.episode += missing;
                }
                // One that ended after the status comes with the next.
                let wanted = status.episodes.saturating_sub(reply.before) as usize;
                let ended = reply.episodes.iter().take(wanted);
                let all = reply.before + ended.len() as u64;
                rows.extend(ended.map(|it| csv_row(self.take(it, seconds))));
                received = all.max(received + 1);
            }
            self.received[shard] = received;
        }
        // Those that could not be written before are tried again, too.
        warnings.extend(self.table.add(rows));
        warnings
    }

    /// Sets aside the episodes that ended after the run had so many frames: what came after is done again.
    fn cut(&mut self, rows: &mut Table, frames_max: u64) -> anyhow::Result<()> {
        let all = rows.rows.len();
        let is_kept = |row: &_| read(row).is_some_and(|it| it.0 <= frames_max);
        rows.keep(&self.folder.episodes(), |_, row| Ok(is_kept(row)))?;
        if rows.rows.len() < all {
            let received = std::mem::take(&mut self.received);
            *self = Self {
                received,
                frames_at_status: self.frames_at_status,
                ..Self::begin(&self.folder, rows.clone(), None)?
            };
        }
        Ok(())
    }

    /// What the shards knew of when the last episode was received, the first `unknown` apart: all but the newest, which are those of
    /// shards with fewer rows.
    fn take_as_received(&mut self, shards: &[ReplayStatus], rows: &Table, unknown: u64) {
        let mut of_shards = vec![0; shards.len()];
        for row in &rows.rows {
            let number = |at: usize| row.get(at).and_then(|it| it.parse::<u64>().ok());
            let (episode, actor) = (number(EPISODE), number(ACTOR).unwrap_or(0));
            let shard = actor as usize % shards.len();
            of_shards[shard] += u64::from(episode > Some(unknown));
        }
        let mut left: u64 = shards.iter().map(|it| it.episodes).sum();
        left = left.saturating_sub(self.episode.saturating_sub(unknown));
        for ((received, status), rows) in self.received.iter_mut().zip(shards).zip(of_shards) {
            let here = left.min(status.episodes.saturating_sub(rows));
            *received = status.episodes - here;
            left -= here;
        }
    }

    fn take(&mut self, ended: &EndedEpisode, seconds: Option<f64>) -> [String; 7] {
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
            ended.env.to_string(),
            of_whole(|it| it.episode_return.to_string()),
            of_whole(|it| it.steps.to_string()),
        ]
    }

    pub(super) fn so_far(&self, count: u64) -> Episodes {
        Episodes::of(count, self.newest.iter())
    }

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
