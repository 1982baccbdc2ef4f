//! `driml evaluate`: whole episodes with a run's newest checkpoint, and a random policy's beside them.
//! It trains nothing and changes nothing in the run folder.

use std::path::Path;

use anyhow::Context;
use driml_actor::{NetworkPolicy, Policy, RandomPolicy, episode_returns};
use driml_envs::WorldConfig;
use driml_learner::{Compute, checkpoint};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    cli::{EvaluateArgs, Levels},
    config::RunConfig,
    console::print,
    error::{Usage, usage},
};

/// Probability of a random action. Source: section 2 of the project's specification, after rlpyt.
const EPSILON: f64 = 0.001;
/// Copies of the world that are played at once.
const COPIES_MAX: usize = 32;
/// Steps of each copy after which an evaluation is given up; Procgen's longest episode has 6,000.
const STEPS_A_ROUND_MAX: u64 = 20_000;
/// Levels to draw unseen ones from, right after those trained on.
const UNSEEN_LEVELS: u32 = 100_000;
/// The stream of the exploring policy's generator. A world seeded alike gives its copies streams that count from 0.
const POLICY_STREAM: u64 = u64::MAX;

/// Plays, and prints mean and standard deviation.
///
/// # Errors
/// A folder that is no run's, a damaged checkpoint, levels that the world does not have.
pub(crate) fn run(args: &EvaluateArgs) -> anyhow::Result<()> {
    let player = Player::load(&args.run)?;
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

/// Who chooses the actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Who {
    /// The run's network.
    Agent,
    /// Every action equally likely.
    Random,
}

/// A run's newest weights and its world, ready to play.
pub(crate) struct Player {
    config: RunConfig,
    /// As safetensors.
    weights: Vec<u8>,
    updates: u64,
}

impl Player {
    /// Reads the newest checkpoint of a run's folder.
    ///
    /// # Errors
    /// A folder that is no run's or has no checkpoint, a damaged checkpoint.
    pub(crate) fn load(folder: &Path) -> anyhow::Result<Self> {
        let path = folder.join("config.toml");
        let text = std::fs::read_to_string(&path).map_err(|e| {
            usage!(
                "{} is not the folder of a run: reading {}: {e}",
                folder.display(),
                path.display()
            )
        })?;
        let config = RunConfig::parse(&path.display().to_string(), &text)?;
        let restored = checkpoint::load_latest(
            &folder.join("checkpoints"),
            &config.model,
            &config.learner.update,
            &Compute::CPU,
            config.run.hash(),
        )?
        .ok_or_else(|| {
            usage!(
                "{} has no checkpoint yet: let the run go on",
                folder.display()
            )
        })?;
        let weights = restored.learner.weights()?;
        let updates = restored.learner.updates();
        Ok(Self {
            config,
            weights,
            updates,
        })
    }

    /// Returns of whole episodes on the levels asked for; none if the world does not have them.
    ///
    /// # Errors
    /// The policy or the world failed, or episodes do not end.
    pub(crate) fn returns(
        &self,
        who: Who,
        which: Levels,
        episodes: u32,
        seed: u64,
    ) -> anyhow::Result<Option<Vec<f64>>> {
        match levels(&self.config.world, which) {
            Ok(world) => self.play(who, &world, episodes as usize, seed).map(Some),
            Err(_) => Ok(None),
        }
    }

    fn play(
        &self,
        who: Who,
        world: &WorldConfig,
        episodes: usize,
        seed: u64,
    ) -> anyhow::Result<Vec<f64>> {
        let spec = &self.config.run;
        let frame = (spec.frame_height as usize, spec.frame_width as usize);
        let mut policy: Box<dyn Policy> = match who {
            Who::Agent => Box::new(NetworkPolicy::new(
                &self.config.model,
                frame,
                &self.weights,
            )?),
            Who::Random => Box::new(RandomPolicy::new(u8::try_from(spec.num_actions)?)),
        };
        let copies = episodes.min(COPIES_MAX);
        let rounds = episodes.div_ceil(copies) as u64;
        episode_returns(
            driml_envs::make_world(world, copies, seed, 0)?,
            spec.frame_stack as usize,
            policy.as_mut(),
            EPSILON,
            episodes,
            rounds * STEPS_A_ROUND_MAX,
            policy_rng(seed),
        )
        .with_context(|| format!("playing {}", spec.world))
    }
}

/// What the policy explores with: other numbers than those of any copy of the world, which has the same seed.
fn policy_rng(seed: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(POLICY_STREAM);
    rng
}

/// The world with the levels asked for.
fn levels(world: &WorldConfig, levels: Levels) -> Result<WorldConfig, Usage> {
    let mut world = world.clone();
    match (&mut world, levels) {
        (_, Levels::Train) => {}
        (WorldConfig::Procgen(procgen), Levels::TrainSingle) => {
            procgen.use_sequential_levels = false;
        }
        (WorldConfig::Procgen(procgen), Levels::Unseen) => {
            if procgen.num_levels == 0 {
                return Err(usage!(
                    "this run trained on all levels there are: none is unseen"
                ));
            }
            procgen.start_level += procgen.num_levels;
            procgen.num_levels = UNSEEN_LEVELS;
            procgen.use_sequential_levels = false;
        }
        _ => return Err(usage!("this run's world has no levels: use --levels train")),
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
    use driml_envs::{ChainConfig, ProcgenConfig};
    use rand::Rng;

    use super::*;

    #[test]
    fn an_evaluation_hardly_explores() {
        // Source: section 2 of the project's specification.
        assert_eq!(EPSILON, 0.001);
    }

    #[test]
    fn exploration_and_the_world_do_not_share_random_numbers() {
        for seed in [0, 1, u64::MAX] {
            let first = policy_rng(seed).random::<u64>();
            // The streams of a world's copies: two for each.
            for stream in 0..2 * COPIES_MAX as u64 {
                let mut copy = ChaCha8Rng::seed_from_u64(seed);
                copy.set_stream(stream);
                assert_ne!(copy.random::<u64>(), first, "stream {stream}");
            }
        }
    }

    fn procgen(start_level: u32, num_levels: u32) -> WorldConfig {
        WorldConfig::Procgen(ProcgenConfig {
            game: "coinrun".parse().unwrap(),
            distribution_mode: "easy".parse().unwrap(),
            num_levels,
            start_level,
            use_sequential_levels: true,
            paint_vel_info: true,
            use_backgrounds: true,
            center_agent: true,
            restrict_themes: false,
        })
    }

    /// The levels of a world, and whether an episode goes on from one to the next.
    fn levels_of(world: &WorldConfig, which: Levels) -> (std::ops::Range<u32>, bool) {
        match levels(world, which).unwrap() {
            WorldConfig::Procgen(it) => {
                let levels = it.start_level..it.start_level + it.num_levels;
                (levels, it.use_sequential_levels)
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn unseen_levels_are_none_of_those_trained_on() {
        for (start, count) in [(0, 500), (70, 1), (1000, 200)] {
            let world = procgen(start, count);
            let (train, goes_on) = levels_of(&world, Levels::Train);
            assert_eq!((train.clone(), goes_on), (start..start + count, true));
            let (single, goes_on) = levels_of(&world, Levels::TrainSingle);
            assert_eq!((single, goes_on), (train.clone(), false));
            let (unseen, goes_on) = levels_of(&world, Levels::Unseen);
            assert!(
                unseen.start >= train.end && unseen.len() == 100_000,
                "{unseen:?}"
            );
            assert!(!goes_on);
        }
    }

    #[test]
    fn levels_that_a_world_does_not_have_are_refused() {
        let all = levels(&procgen(0, 0), Levels::Unseen).unwrap_err();
        assert!(all.to_string().contains("none is unseen"), "{all}");
        let chain = WorldConfig::Chain(ChainConfig {
            cells: 8,
            height: 12,
            width: 12,
            step_limit: 30,
            reward_left: 0.1,
            reward_right: 1.0,
        });
        assert!(levels(&chain, Levels::Train).is_ok());
        for which in [Levels::TrainSingle, Levels::Unseen] {
            let said = levels(&chain, which).unwrap_err().to_string();
            assert!(said.contains("has no levels"), "{said}");
        }
    }

    #[test]
    fn the_deviation_is_the_samples() {
        assert_eq!(mean_and_deviation(&[1.0, 3.0]), (2.0, 2.0_f64.sqrt()));
        assert_eq!(mean_and_deviation(&[4.0]), (4.0, 0.0));
    }
}
