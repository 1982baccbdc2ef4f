//! `driml evaluate`: whole episodes with a run's newest checkpoint, and a random policy's beside them.
//! It trains nothing and changes nothing in the run folder.

use anyhow::Context;
use driml_actor::{
    evaluate::episode_returns,
    policy::{NetworkPolicy, Policy, RandomPolicy},
};
use driml_envs::WorldConfig;
use driml_learner::checkpoint;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    cli::{EvaluateArgs, Levels},
    config::RunConfig,
    error::usage,
    print,
};

/// Probability of a random action. Source: section 2 of the project's specification, after rlpyt.
const EPSILON: f64 = 0.001;
/// Copies of the world that are played at once.
const COPIES_MAX: usize = 32;
/// Steps of each copy after which an evaluation is given up; Procgen's longest episode has 6,000.
const STEPS_A_ROUND_MAX: u64 = 20_000;
/// Levels to draw unseen ones from, right after those trained on.
const UNSEEN_LEVELS: u32 = 100_000;

/// Plays, and prints mean and standard deviation.
///
/// # Errors
/// A folder that is no run's, a damaged checkpoint, levels that the world does not have.
pub(crate) fn run(args: &EvaluateArgs) -> anyhow::Result<()> {
    let path = args.run.join("config.toml");
    let text = std::fs::read_to_string(&path).map_err(|e| {
        usage!(
            "{} is not the folder of a run: reading {}: {e}",
            args.run.display(),
            path.display()
        )
    })?;
    let config = RunConfig::parse(&path.display().to_string(), &text)?;
    let world = levels(&config.world, args.levels)?;
    let restored = checkpoint::load_latest(
        &args.run.join("checkpoints"),
        &config.model,
        &config.learner.update,
        config.run.hash(),
    )?
    .ok_or_else(|| {
        usage!(
            "{} has no checkpoint yet: let the run go on",
            args.run.display()
        )
    })?;

    let spec = &config.run;
    let frame = (spec.frame_height as usize, spec.frame_width as usize);
    let weights = restored.learner.weights()?;
    let mut network = NetworkPolicy::new(&config.model, frame, &weights)?;
    let mut random = RandomPolicy::new(u8::try_from(spec.num_actions)?);
    let policies: [(&str, &mut dyn Policy); 2] =
        [(&spec.agent, &mut network), ("random", &mut random)];
    let which = match args.levels {
        Levels::Train => "as trained on",
        Levels::Unseen => "on unseen levels",
    };
    print(&format!(
        "{} {which}, {} episodes each, weights after {} updates, seed {}\n",
        spec.world,
        args.episodes,
        restored.learner.updates(),
        args.seed
    ))?;
    let episodes = args.episodes as usize;
    for (name, policy) in policies {
        let copies = episodes.min(COPIES_MAX);
        let world = driml_envs::make_world(&world, copies, args.seed, 0)?;
        let rounds = episodes.div_ceil(copies) as u64;
        let rng = ChaCha8Rng::seed_from_u64(args.seed);
        let returns = episode_returns(
            world,
            spec.frame_stack as usize,
            policy,
            EPSILON,
            episodes,
            rounds * STEPS_A_ROUND_MAX,
            rng,
        )
        .with_context(|| format!("playing {} with the policy {name}", spec.world))?;
        let (mean, deviation) = mean_and_deviation(&returns);
        print(&format!(
            "{name:12} mean return {mean:8.3}, standard deviation {deviation:.3}\n"
        ))?;
    }
    Ok(())
}

/// The world with the levels asked for.
fn levels(world: &WorldConfig, levels: Levels) -> anyhow::Result<WorldConfig> {
    let mut world = world.clone();
    match (&mut world, levels) {
        (_, Levels::Train) => {}
        (WorldConfig::Procgen(procgen), Levels::Unseen) => {
            if procgen.num_levels == 0 {
                return Err(
                    usage!("this run trained on all levels there are: none is unseen").into(),
                );
            }
            procgen.start_level += procgen.num_levels;
            procgen.num_levels = UNSEEN_LEVELS;
            procgen.use_sequential_levels = false;
        }
        _ => return Err(usage!("this run's world has no levels: use --levels train").into()),
    }
    Ok(world)
}

/// Mean and sample standard deviation; 0 for a single value.
fn mean_and_deviation(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (
        mean,
        if values.len() > 1 {
            (squares / (count - 1.0)).sqrt()
        } else {
            0.0
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deviation_is_the_samples() {
        assert_eq!(mean_and_deviation(&[1.0, 3.0]), (2.0, 2.0_f64.sqrt()));
        assert_eq!(mean_and_deviation(&[4.0]), (4.0, 0.0));
    }
}
