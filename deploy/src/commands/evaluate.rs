//! `driml evaluate`: whole episodes with a run's newest checkpoint, and a random policy's beside them.

use std::path::PathBuf;

use clap::Args;
use driml_launch::{
    console::print,
    evaluate::{Levels, Player, Who, levels, mean_and_deviation},
    run_folder::RunFolder,
};

#[derive(Debug, Args)]
pub(crate) struct EvaluateArgs {
    /// Folder of the run
    #[arg(long, value_name = "DIR")]
    pub(crate) run: PathBuf,
    /// Whole episodes to play
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub(crate) episodes: u32,
    /// Which levels to play
    #[arg(long, value_enum, default_value_t = Levels::Train)]
    pub(crate) levels: Levels,
    /// Seed of the worlds and of exploration
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub(crate) seed: u64,
}

/// Plays, and prints mean and standard deviation.
///
/// # Errors
/// A folder that is no run's, a damaged checkpoint, levels that the world does not have.
pub(crate) fn run(args: &EvaluateArgs) -> anyhow::Result<()> {
    let player = Player::load(&RunFolder::new(&args.run))?;
    let world = levels(&player.config.world, args.levels)?;
    let spec = &player.config.run;
    let which = match args.levels {
        Levels::Train => "as trained on",
        Levels::TrainSingle => "on the levels trained on, one an episode",
        Levels::Unseen => "on unseen levels",
    };
    print(&format!(
        "{} {which}, {} episodes each, weights after {} updates, seed {}\n",
        spec.world, args.episodes, player.updates, args.seed
    ))?;
    for (name, who) in [(spec.agent.as_str(), Who::Agent), ("random", Who::Random)] {
        let returns = player.play(who, &world, args.episodes as usize, args.seed)?;
        let (mean, deviation) = mean_and_deviation(&returns);
        print(&format!(
            "{name:12} mean return {mean:8.3}, standard deviation {deviation:.3}\n"
        ))?;
    }
    Ok(())
}
