//! `episodes.csv`: one row per training episode, also across resumes, and the mean return of the last 100 episodes.
//! Each shard's replay server reports the episodes that ended; this module does not decide what an episode is.
//!
//! Columns: `seconds`, the run's time when the episode was received, up to a second after its end (empty if that was before the
//! run was watched); `frames`, the run's count with the chunk that held its end; `episode`, its number; `actor` and `env`, the actor
//! that played it and its environment; `return`, undiscounted, and `length` in steps, both empty if a part of the episode was lost.
//! If more episodes end between two requests than a replay server keeps, the oldest have no row, and their numbers are skipped.

use std::collections::VecDeque;

use driml_machine::units::count;
use driml_protocol::{EndedEpisode, EpisodesReply, RETURNS_MAX, ReplayStatus};
use serde::Deserialize;

use super::{
    folder::RunFolder,
    table::{AppendLog, Table, csv_row},
};
use crate::{
    metrics::{cell, rounded},
    run_view::Episodes,
};

/// Maximum number of requests to one shard per update; the next update requests the remaining episodes.
const REQUESTS_MAX: usize = 16;

const HEADER: &str = "seconds,frames,episode,actor,env,return,length";

/// The columns that are read back from a row.
#[derive(Deserialize)]
struct Row {
    frames: u64,
    episode: u64,
    actor: u64,
    #[serde(rename = "return")]
    episode_return: Option<f64>,
}

#[derive(Debug)]
pub(super) struct TrainingEpisodes {
    table: AppendLog,
    /// The newest returns, oldest first.
    newest_returns: VecDeque<f64>,
    pub(super) newest: u64,
    frames: u64,
    frames_at_status: Option<u64>,
    /// How many episodes of each shard were received or counted as lost.
    received: Vec<u64>,
    lost: u64,
    folder: RunFolder,
    /// The rows at the start, and how many of the first episodes the shards do not know. The shards' first status shows how many of
    /// the rows stay, and clears this field. None if the shards know none of the rows.
    rows_at_start: Option<(Table, u64)>,
}

impl TrainingEpisodes {
    /// Opens the table. A resumed run keeps the episodes that ended by `frames_max` frames and sets the others aside; a run that begins
    /// has none. If the replay was kept, `unknown` is the number of first episodes that it does not know.
    pub(super) fn open(
        folder: &RunFolder,
        frames_max: Option<u64>,
        unknown: Option<u64>,
    ) -> anyhow::Result<Self> {
        let Some(frames_max) = frames_max else {
            return Self::create(folder, Table::default(), unknown);
        };
        let path = folder.episodes();
        let mut rows = Table::read(&path)?;
        // A replay that was kept reports the run's frames once it answers; the rows are cut then.
        rows.keep_rows(&path, |row: Row| {
            unknown.is_some() || row.frames <= frames_max
        })?;
        Self::create(folder, rows, unknown)
    }

    fn create(folder: &RunFolder, mut rows: Table, unknown: Option<u64>) -> anyhow::Result<Self> {
        let path = folder.episodes();
        let known: Vec<Row> = rows.parse_rows(&path)?;
        rows.header = HEADER.split(',').map(String::from).collect();
        let table = AppendLog::create(&path, &rows.to_csv())?;
        let mut returns: Vec<_> = known.iter().filter_map(|it| it.episode_return).collect();
        let newest = returns.split_off(returns.len().saturating_sub(RETURNS_MAX));
        let last = known.last();
        Ok(Self {
            table,
            newest_returns: newest.into(),
            newest: last.map_or(0, |it| it.episode),
            frames: last.map_or(0, |it| it.frames),
            frames_at_status: None,
            received: Vec::new(),
            lost: 0,
            rows_at_start: unknown.map(|unknown| (rows, unknown)),
            folder: folder.clone(),
        })
    }

    /// Requests the episodes of each shard that ended since the last update, and adds their rows. `seconds` is the run's time, if known.
    /// Afterwards the file has as many episodes as the shards count, each once. Returns warnings about the file.
    pub(super) fn update(
        &mut self,
        shards: &[ReplayStatus],
        fetch: impl Fn(usize, u64) -> Option<EpisodesReply>,
        seconds: Option<f64>,
    ) -> Vec<String> {
        if shards.is_empty() {
            // No shard has answered yet, so nothing is known of what was done.
            return Vec::new();
        }
        let frames: u64 = shards.iter().map(|it| it.transitions_inserted).sum();
        let mut warnings = Vec::new();
        if let Some((mut rows, unknown)) = self.rows_at_start.take() {
            let set_aside = self.set_aside_after(&mut rows, frames);
            warnings.extend(set_aside.err().map(|e| format!("{e:#}")));
            self.set_received(shards, &rows, unknown);
        }
        // The new episodes ended after the last status; a shard may report fewer frames, as its count of the other shards is older.
        let received = self.frames_at_status.replace(frames);
        let later = received.map_or(0, |before| before.saturating_add(1).min(frames));
        // While a resumed run's replay fills again, it counts frames that the run had before.
        self.frames = self.frames.max(later);
        self.received
            .resize(shards.len().max(self.received.len()), 0);
        let mut rows = Vec::new();
        for (shard, status) in shards.iter().enumerate() {
            // A server that counts fewer episodes than before is a new one.
            let mut received = self.received[shard];
            if status.episodes < received {
                received = 0;
            }
            for _ in 0..REQUESTS_MAX {
                if received >= status.episodes {
                    break;
                }
                let is_newer =
                    |it: &EpisodesReply| it.ended >= status.episodes && it.before >= received;
                let Some(reply) = fetch(shard, received).filter(is_newer) else {
                    break;
                };
                let missing = reply.before - received;
                if missing > 0 {
                    warnings.extend((self.lost == 0).then(|| describe_lost(missing)));
                    self.lost += missing;
                    self.newest += missing;
                }
                // An episode that ended after the status is taken in the next update.
                let wanted = status.episodes.saturating_sub(reply.before) as usize;
                let ended = reply.episodes.iter().take(wanted);
                let all = reply.before + ended.len() as u64;
                rows.extend(ended.map(|it| csv_row(self.add_episode(it, seconds))));
                received = all.max(received + 1);
            }
            self.received[shard] = received;
        }
        // This also retries the rows that could not be written before.
        warnings.extend(self.table.add(rows));
        warnings
    }

    /// Sets aside the episodes that ended after `frames_max` frames: the run does that part again.
    fn set_aside_after(&mut self, rows: &mut Table, frames_max: u64) -> anyhow::Result<()> {
        if rows.keep_rows(&self.folder.episodes(), |row: Row| row.frames <= frames_max)? {
            *self = Self::create(&self.folder, rows.clone(), None)?;
        }
        Ok(())
    }

    /// Notes how many of each shard's episodes were received before this process started. Those that were not are the newest episodes
    /// of shards that count more episodes than they have rows. The first `unknown` episodes do not count.
    fn set_received(&mut self, shards: &[ReplayStatus], rows: &Table, unknown: u64) {
        let mut rows_of_shards = vec![0; shards.len()];
        let rows = rows.parse_rows::<Row>(&self.folder.episodes());
        for row in rows.unwrap_or_default() {
            rows_of_shards[row.actor as usize % shards.len()] += u64::from(row.episode > unknown);
        }
        let mut unreceived: u64 = shards.iter().map(|it| it.episodes).sum();
        unreceived = unreceived.saturating_sub(self.newest.saturating_sub(unknown));
        let received = shards.iter().zip(rows_of_shards).map(|(status, rows)| {
            let new_here = unreceived.min(status.episodes.saturating_sub(rows));
            unreceived -= new_here;
            status.episodes - new_here
        });
        self.received = received.collect();
    }

    fn add_episode(&mut self, ended: &EndedEpisode, seconds: Option<f64>) -> [String; 7] {
        self.newest += 1;
        self.frames = self.frames.max(ended.frames);
        let totals = ended.totals;
        let episode_return = totals.map(|it| rounded(it.episode_return));
        if let Some(newest) = episode_return {
            if self.newest_returns.len() == RETURNS_MAX {
                self.newest_returns.pop_front();
            }
            self.newest_returns.push_back(newest);
        }
        [
            cell(seconds.map(|it| format!("{it:.3}"))),
            self.frames.to_string(),
            self.newest.to_string(),
            ended.actor.to_string(),
            ended.env.to_string(),
            cell(episode_return),
            cell(totals.map(|it| it.steps)),
        ]
    }

    /// The episodes so far: `count`, or the newest number if that is higher, as a kept replay counts none before it answers.
    pub(super) fn so_far(&self, count: u64) -> Episodes {
        Episodes::new(count.max(self.newest), self.newest_returns.iter())
    }

    pub(super) fn loss_messages(&self) -> Vec<String> {
        let lost = (self.lost > 0).then(|| describe_lost(self.lost));
        self.table.loss_message().into_iter().chain(lost).collect()
    }
}

fn describe_lost(lost: u64) -> String {
    let lost = count(lost, "episode");
    format!(
        "episodes.csv lacks {lost}: a replay server was restarted, or more ended between two requests than it keeps"
    )
}

#[cfg(test)]
mod tests;
