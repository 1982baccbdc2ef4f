//! Judges a run's checkpoints by what they earn, and keeps the best of them.
//! It prints nothing. What the best is worth, `driml evaluate` says on other episodes: the best of many is best by luck, too.

use driml_learner::checkpoint;
use driml_machine::error::usage;

use crate::{
    evaluate::{Levels, Player, Which, Who, checkpoint_at, config_of, levels, mean_and_deviation},
    run_folder::{Candidate, Evaluated, RunFolder},
};

/// The seed of the episodes on which checkpoints are compared: none that anybody reports on.
pub const SELECTION_SEED: u64 = 1 << 32;

/// What a checkpoint earned, and whether it is the run's best.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// What it earned.
    pub earned: Evaluated,
    /// It was kept.
    pub is_best: bool,
    /// The best, as it was judged before this one came: over at least as many episodes.
    pub best_before: Option<Evaluated>,
}

/// Plays a checkpoint of a run on the levels trained on, adds what it earned to the run's table, and keeps it where it earned more than
/// the best before it.
///
/// Both are compared over the same episodes. A best that was played for fewer is played again; a checkpoint that is played for fewer
/// does not take its place.
///
/// # Errors
/// As [`Player::load_at`] and [`Player::play`], and a file system that refuses.
pub fn keep(folder: &RunFolder, which: Which, episodes: u32) -> anyhow::Result<Judged> {
    if which == Which::Average {
        return Err(usage!(
            "--keep compares checkpoints by their newest weights: leave out --checkpoint average, or --keep"
        )
        .into());
    }
    let path = checkpoint_at(folder, which)?;
    let candidate = Candidate::hold(folder, &path)?;
    let play = |player: Player| -> anyhow::Result<Evaluated> {
        let world = levels(&player.config.world, Levels::Train)?;
        let returns = player.play(Who::Agent, &world, episodes as usize, SELECTION_SEED)?;
        let earned = mean_and_deviation(&returns);
        Ok(Evaluated::at(folder, player.updates, episodes, earned))
    };
    let player = Player::read(config_of(folder)?, &path)?;
    let updates = player.updates;
    let earned = play(player)?;
    let mut best_before = Evaluated::best(folder)?;
    let is_short = |it: &Evaluated| it.updates != updates && it.episodes < episodes;
    if best_before.is_some_and(|it| is_short(&it))
        && let Some((_, best)) = checkpoint::list(&folder.best())?.pop()
    {
        let again = play(Player::read(config_of(folder)?, &best)?)?;
        again.add(folder)?;
        best_before = Some(again);
    }
    let is_best = candidate.judge(folder, &earned, best_before.as_ref())?;
    Ok(Judged {
        earned,
        is_best,
        best_before,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn averaged_weights_are_not_kept_as_the_newest() {
        let folder = RunFolder::new("no-such-run");
        let error = keep(&folder, Which::Average, 1).unwrap_err().to_string();
        assert!(error.contains("--checkpoint average"), "{error}");
    }
}
