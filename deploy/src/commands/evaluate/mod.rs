//! `driml evaluate`: whole episodes with a run's newest checkpoint, and a random policy's beside them; a film of them on request.

mod recording;
mod tile;

use std::path::PathBuf;

use clap::Args;
use driml_figure::Film;
use driml_launch::{
    console::print,
    evaluate::{Levels, Player, Who, levels, mean_and_deviation},
    run_folder::RunFolder,
};
use driml_machine::error::usage;

use self::recording::{RecordArgs, Recording};

#[derive(Debug, Args)]
pub(crate) struct EvaluateArgs {
    /// Folder of the run
    #[arg(value_name = "RUN", required_unless_present = "run")]
    pub(crate) folder: Option<PathBuf>,
    /// The same
    #[arg(long, value_name = "DIR", conflicts_with = "folder")]
    pub(crate) run: Option<PathBuf>,
    /// Whole episodes to play
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub(crate) episodes: u32,
    /// Which levels to play
    #[arg(long, value_enum, default_value_t = Levels::Train)]
    pub(crate) levels: Levels,
    /// Seed of the worlds and of exploration
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub(crate) seed: u64,
    #[command(flatten)]
    pub(crate) film: RecordArgs,
}

/// Plays, and prints mean and standard deviation.
///
/// # Errors
/// A folder that is no run's, a damaged checkpoint, levels that the world does not have, a film that cannot be written.
pub(crate) fn run(args: &EvaluateArgs) -> anyhow::Result<()> {
    if let Some(path) = &args.film.record {
        Film::check_name(path).map_err(|e| usage!("--record: {e}"))?;
    }
    let folder = args.folder.as_ref().or(args.run.as_ref());
    let folder = folder.expect("clap asks for one of the two");
    let player = Player::load(&RunFolder::new(folder))?;
    let world = levels(&player.config.world, args.levels)?;
    let mut film = Recording::begin(&args.film, &player, args.episodes)?;
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
    let returns = player.play_watched(
        Who::Agent,
        &world,
        args.episodes as usize,
        args.seed,
        &mut |step| {
            if let Some(film) = &mut film {
                film.see(step);
            }
        },
    );
    let returns = match (returns, film) {
        (Ok(returns), None) => returns,
        (Ok(returns), Some(film)) => {
            print(&film.finish()?)?;
            returns
        }
        (Err(e), film) => {
            if let Some(film) = film {
                film.discard();
            }
            return Err(e);
        }
    };
    describe(&spec.agent, &returns)?;
    let returns = player.play(Who::Random, &world, args.episodes as usize, args.seed)?;
    describe("random", &returns)
}

fn describe(name: &str, returns: &[f64]) -> anyhow::Result<()> {
    let (mean, deviation) = mean_and_deviation(returns);
    print(&format!(
        "{name:12} mean return {mean:8.3}, standard deviation {deviation:.3}\n"
    ))
}
