//! Plays the agents of finished runs, each once: greedy episodes with the newest weights, and episodes of a random policy.
//! The returns during training are in the summaries of the runs.

use driml_launch::{
    checkpoint_choice::{CheckpointChoice, WeightsChoice, read_config},
    evaluate::{Levels, Player, PolicyKind, random_returns, world_with_levels},
    run_folder::RunFolder,
};
use driml_learner::checkpoint::{self, AVERAGE};

use super::plan::FinishedRun;
use crate::{cache::Session, progress::Progress};

/// The seed of the played episodes, so that every run plays the same levels. Older checkpoints of a run play others, with the next seeds.
const SEED: u64 = 1;

#[derive(Clone, Copy, Debug)]
pub(crate) struct PlaySettings {
    pub(crate) levels: Levels,
    /// The number of newest checkpoints that share the episodes. If a run has averaged weights, only these play.
    pub(crate) checkpoints: usize,
    pub(crate) episodes: u32,
    /// The units of work, which matter only for the estimate of the time left.
    pub(crate) units: u64,
}

impl PlaySettings {
    /// Plays a run's agent greedily and gives its returns; `None` if the world lacks the levels. Kept under `key` for these weights.
    pub(crate) fn play_greedy(
        self,
        session: &mut Session,
        key: &str,
        run: &FinishedRun,
    ) -> anyhow::Result<Option<Vec<f64>>> {
        let source = format!("{} {}", run.summary.weights_sha256, self.episodes);
        session.load_or_make(&source, key, self.units, |progress| {
            self.play_checkpoints(&run.folder, progress)
        })
    }

    /// Plays a random policy in a run's world, on the training levels, and gives its returns.
    pub(crate) fn play_random(
        self,
        session: &mut Session,
        key: &str,
        run: &FinishedRun,
    ) -> anyhow::Result<Vec<f64>> {
        session.load_or_make(&self.episodes.to_string(), key, self.units, |progress| {
            let (config, is_over) = (read_config(&run.folder)?, || progress.is_interrupted());
            let returns = random_returns(&config, self.episodes as usize, SEED, is_over)?;
            progress.advance(0)?;
            Ok(returns)
        })
    }

    fn play_checkpoints(
        self,
        folder: &RunFolder,
        progress: &mut Progress,
    ) -> anyhow::Result<Option<Vec<f64>>> {
        let chosen = choose(folder, self.checkpoints)?;
        let each = self.episodes.div_ceil(chosen.len().max(1) as u32);
        let returns = chosen.into_iter().map(|(choice, seed)| {
            let player = Player::load(folder, choice, WeightsChoice::default())?;
            if world_with_levels(&player.config.world, self.levels).is_err() {
                return Ok(None);
            }
            let (agent, is_over) = (PolicyKind::Agent, || progress.is_interrupted());
            let returns = player.returns(agent, self.levels, each as usize, seed, is_over)?;
            progress.advance(0)?;
            Ok(Some(returns))
        });
        let all = returns.collect::<anyhow::Result<Option<Vec<_>>>>()?;
        Ok(all.map(|all| all.concat()))
    }
}

fn choose(folder: &RunFolder, count: usize) -> anyhow::Result<Vec<(CheckpointChoice, u64)>> {
    let all = checkpoint::list(&folder.checkpoints())?;
    let newest = all.last();
    if newest.is_none_or(|(_, path)| path.join(AVERAGE).is_file()) {
        // Averages of three checkpoints differ little, so the newest suffices. Without a checkpoint the player reports the error.
        return Ok(vec![(CheckpointChoice::Newest, SEED)]);
    }
    let newest = all.iter().rev().take(count).zip(SEED..);
    let newest = newest.map(|(it, seed)| (CheckpointChoice::After(it.0), seed));
    Ok(newest.collect())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn the_average_plays_before_the_newest_checkpoints() {
        let folder = tempfile::tempdir().unwrap();
        let folder = RunFolder::new(folder.path());
        let chosen = choose(&folder, 3).unwrap();
        assert_eq!(chosen, [(CheckpointChoice::Newest, SEED)]);
        for updates in [1, 2, 3, 4] {
            let name = format!("checkpoint-{updates:012}");
            fs::create_dir_all(folder.checkpoints().join(name)).unwrap();
        }
        let newest = [(4, 1), (3, 2), (2, 3)].map(|(it, seed)| (CheckpointChoice::After(it), seed));
        assert_eq!(choose(&folder, 3).unwrap(), newest);
        let path = folder.checkpoints().join("checkpoint-000000000004");
        fs::write(path.join(AVERAGE), "").unwrap();
        let chosen = choose(&folder, 3).unwrap();
        assert_eq!(chosen, [(CheckpointChoice::Newest, SEED)]);
    }
}
