//! Builds a world from its settings, and tells its shape and actions without building it.
//! It adds nothing to the worlds: no stacking, no statistics, no threads of its own.

use crate::{
    ChainWorld, EnvError, Environment, FrameShape, IsingWorld, PacmanWorld, ProcgenWorld,
    WorldConfig,
};

/// Builds `num_envs` copies of a world. Copy i depends on (`seed`, i) and its actions only.
///
/// `threads` is how many threads Procgen's engine may start, 0 for none; the other worlds are stepped in microseconds and
/// use none. The chain has nothing to seed.
///
/// # Errors
/// Settings that cannot work, or an engine that cannot be had.
pub fn make_world(
    config: &WorldConfig,
    num_envs: usize,
    seed: u64,
    threads: usize,
) -> Result<Box<dyn Environment>, EnvError> {
    Ok(match config {
        WorldConfig::Procgen(config) => {
            Box::new(ProcgenWorld::new(config, num_envs, seed, threads)?)
        }
        WorldConfig::MsPacman(config) => Box::new(PacmanWorld::new(config, num_envs, seed)?),
        WorldConfig::Ising(config) => Box::new(IsingWorld::new(config, num_envs, seed)?),
        WorldConfig::Chain(config) => Box::new(ChainWorld::new(config, num_envs)?),
    })
}

/// The shape of one frame of the world that these settings make.
pub fn frame_shape(config: &WorldConfig) -> FrameShape {
    match config {
        WorldConfig::Procgen(_) => ProcgenWorld::FRAME_SHAPE,
        WorldConfig::MsPacman(config) => config.frame_shape(),
        WorldConfig::Ising(config) => config.frame_shape(),
        WorldConfig::Chain(config) => config.frame_shape(),
    }
}

/// The names of a world's actions; an action is a place in this list.
pub fn action_names(config: &WorldConfig) -> &'static [&'static str] {
    match config {
        WorldConfig::Procgen(_) => &ProcgenWorld::ACTION_NAMES,
        WorldConfig::MsPacman(_) => &PacmanWorld::ACTION_NAMES,
        WorldConfig::Ising(_) => &IsingWorld::ACTION_NAMES,
        WorldConfig::Chain(_) => &ChainWorld::ACTION_NAMES,
    }
}

/// Number of a world's actions; valid ones are below it.
pub fn num_actions(config: &WorldConfig) -> usize {
    action_names(config).len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Boundary, ChainConfig, IsingConfig, PacmanConfig};

    /// One set of settings for each world that needs no engine.
    fn configs() -> [WorldConfig; 3] {
        [
            WorldConfig::Chain(ChainConfig {
                cells: 8,
                height: 9,
                width: 12,
                step_limit: 30,
                reward_left: 0.1,
                reward_right: 1.0,
            }),
            WorldConfig::Ising(IsingConfig {
                lattice_size: 84,
                patch_size: 42,
                temperature: 0.4,
                boundary: Boundary::Free,
                sweeps_per_step: 1,
                episode_steps: 32,
            }),
            WorldConfig::MsPacman(PacmanConfig {
                epsilon: 0.0,
                switch_probability: 0.5,
                lethal: [true; 4],
                lethal_schedule: None,
                boost_steps: 10,
                step_limit: 100,
                reward_pellet: 1.0,
                reward_boost: 1.0,
                reward_ghost: 1.0,
                reward_death: -1.0,
                reward_cleared: 1.0,
                ising: None,
            }),
        ]
    }

    #[test]
    fn shapes_and_actions_are_those_of_the_built_world() {
        for config in configs() {
            let mut world = make_world(&config, 3, 1, 0).unwrap();
            assert_eq!(
                (world.frame_shape(), world.num_actions()),
                (frame_shape(&config), num_actions(&config))
            );
            assert_eq!(world.num_envs(), 3);
            world.observe(&mut vec![0; 3 * frame_shape(&config).bytes()]);
        }
    }

    #[test]
    fn no_copies_and_wrong_buffers_are_errors() {
        for config in configs() {
            assert!(make_world(&config, 0, 1, 0).is_err());
            let mut world = make_world(&config, 2, 1, 0).unwrap();
            let (mut rewards, mut ends) = ([0.0; 2], [Default::default(); 2]);
            let error = world
                .step(&[0], &mut rewards, &mut ends)
                .unwrap_err()
                .to_string();
            assert_eq!(error, "actions has 1 entries, but the world has 2 copies");
            assert!(world.step(&[0; 2], &mut rewards[..1], &mut ends).is_err());
            assert!(world.step(&[0; 2], &mut rewards, &mut ends[..1]).is_err());
            assert!(world.step(&[0, 200], &mut rewards, &mut ends).is_err());
        }
    }
}
