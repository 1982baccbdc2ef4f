//! What finished runs earn when they are played, each played once: greedy episodes of their newest weights, and a random policy's.
//! Returns of the training are in their summaries.

use driml_launch::{
    chosen::{Weights, Which, config_of},
    evaluate::{Levels, Player, Who, random_returns},
    run_folder::RunFolder,
};
use driml_learner::checkpoint::{self, AVERAGE};

use super::plan::FinishedRun;
use crate::{cache::Session, progress::Progress};

/// Seed of the played episodes: the same levels for every run.
const SEED: u64 = 1;

#[derive(Clone, Copy, Debug)]
pub(crate) struct Played {
    pub(crate) levels: Levels,
    /// Checkpoints that share the episodes, the newest ones; the averaged weights alone play where a run has some.
    pub(crate) checkpoints: usize,
    pub(crate) episodes: u32,
    /// Of work, which only the estimate of the time left depends on.
    pub(crate) units: u64,
}

impl Played {
    /// Returns of a run's agent, played greedily; none if its world does not have the levels. Kept under `key` for these weights.
    pub(crate) fn greedy(
        self,
        session: &mut Session,
        key: &str,
        run: &FinishedRun,
    ) -> anyhow::Result<Option<Vec<f64>>> {
        let of = format!("{} {}", run.summary.weights_sha256, self.episodes);
        session.piece_of(&of, key, self.units, |progress| {
            self.returns(&run.folder, progress)
        })
    }

    /// Returns of a random policy in a run's world, on the levels trained on.
    pub(crate) fn random(
        self,
        session: &mut Session,
        key: &str,
        run: &FinishedRun,
    ) -> anyhow::Result<Vec<f64>> {
        session.piece_of(&self.episodes.to_string(), key, self.units, |_| {
            random_returns(&config_of(&run.folder)?, self.episodes as usize, SEED)
        })
    }

    fn returns(
        self,
        folder: &RunFolder,
        progress: &mut Progress,
    ) -> anyhow::Result<Option<Vec<f64>>> {
        let players = players(folder, self.checkpoints)?;
        let each = self.episodes.div_ceil(players.len().max(1) as u32);
        let returns = players.into_iter().map(|which| {
            progress.advance(0)?;
            let player = Player::load_at(folder, which, Weights::default())?;
            player.returns(Who::Agent, self.levels, each, SEED)
        });
        let all = returns.collect::<anyhow::Result<Option<Vec<_>>>>()?;
        Ok(all.map(|all| all.concat()))
    }
}

fn players(folder: &RunFolder, checkpoints: usize) -> anyhow::Result<Vec<Which>> {
    let all = checkpoint::list(&folder.checkpoints())?;
    let newest = all.last();
    if newest.is_none_or(|(_, path)| path.join(AVERAGE).is_file()) {
        // Averages of three checkpoints differ little. Without a checkpoint the player says what is missing.
        return Ok(vec![Which::Newest]);
    }
    let newest = all.iter().rev().take(checkpoints);
    Ok(newest.map(|(updates, _)| Which::After(*updates)).collect())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn the_average_plays_before_the_newest_checkpoints() {
        let folder = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(folder.path());
        assert_eq!(players(&folder, 3).unwrap(), [Which::Newest]);
        for updates in [1, 2, 3, 4] {
            let name = format!("checkpoint-{updates:012}");
            let path = folder.checkpoints().join(name);
            fs::create_dir_all(path).unwrap();
        }
        let newest = [4, 3, 2].map(Which::After);
        assert_eq!(players(&folder, 3).unwrap(), newest);
        let path = folder.checkpoints().join("checkpoint-000000000004");
        fs::write(path.join(AVERAGE), "").unwrap();
        assert_eq!(players(&folder, 3).unwrap(), [Which::Newest]);
    }
}
