//! Judges a run's checkpoints by what they earn, and keeps the best of them.
//! It prints nothing. What the best is worth, `driml evaluate` says on other episodes: the best of many is best by luck, too.

use std::path::Path;

use driml_learner::checkpoint;

use crate::{
    chosen::{Weights, Which, checkpoint_at, config_of},
    evaluate::{Levels, Player, Who, levels},
    run_folder::{Candidate, Evaluated, RunFolder},
    stats::mean_and_deviation,
};

/// The seed of the episodes on which checkpoints are compared; reports use other seeds.
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

/// Plays a checkpoint of a run, its averaged weights if there are some, on the levels trained on, adds what it earned to the run's table, and keeps it where it earned more than
/// the best before it.
///
/// Both are compared over the same episodes. A best that was played for fewer is played again; a checkpoint that is played for fewer
/// does not take its place.
pub fn keep(folder: &RunFolder, which: Which, episodes: u32) -> anyhow::Result<Judged> {
    let path = checkpoint_at(folder, which)?;
    let candidate = Candidate::hold(folder, &path)?;
    let play = |path: &Path| -> anyhow::Result<Evaluated> {
        let player = Player::read(config_of(folder)?, path, Weights::default())?;
        let world = levels(&player.config.world, Levels::Train)?;
        let returns = player.play(Who::Agent, &world, episodes as usize, SELECTION_SEED)?;
        let earned = mean_and_deviation(&returns);
        Ok(Evaluated::at(folder, player.updates, episodes, earned))
    };
    let earned = play(&path)?;
    let mut best_before = Evaluated::best(folder)?;
    let is_short = |it: &Evaluated| it.updates != earned.updates && it.episodes < episodes;
    if best_before.is_some_and(|it| is_short(&it))
        && let Some((_, best)) = checkpoint::list(&folder.best())?.pop()
    {
        let again = play(&best)?;
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
