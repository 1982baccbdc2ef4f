//! Measures steps of Procgen through our wrapper, or of other worlds. Frames are copied out after each step as an actor does.
//! No policy is measured: actions are drawn beforehand.

use driml_envs::StepEnd;
use driml_launch::console;
use driml_machine::speed_meter::SpeedMeter;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{report::Bench, settings};

pub(super) const GAMES: [&str; 4] = ["bigfish", "coinrun", "maze", "starpilot"];
const ENVS: usize = 32;
/// The numbers of engine threads. With 0 the caller's thread steps every environment.
pub(super) const ENGINE_THREADS: [usize; 2] = [0, 2];
const STEPS: usize = 64;

pub(super) fn label(game: &str, threads: usize) -> String {
    format!("{game}, {ENVS} environments, {threads} engine threads")
}

/// Measures steps per second of the named worlds, or of Procgen if none is named. The steps of each environment count.
pub(super) fn measure(worlds: &[String], bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let mut cases = Vec::new();
    for world in worlds {
        cases.push((format!("{world}, {ENVS} environments"), world.clone(), 0));
    }
    if worlds.is_empty() {
        procgen_sys::Engine::install(&mut console::eprintln)?;
        for game in GAMES {
            let case = |threads| (label(game, threads), format!("procgen:{game}"), threads);
            cases.extend(ENGINE_THREADS.map(case));
        }
    }
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for (name, world, threads) in cases {
        let rate = rate(&world, threads, &bench.meter, &mut rng)?;
        bench.figures.record(name, rate, "steps/s");
    }
    Ok(())
}

fn rate(
    world: &str,
    threads: usize,
    meter: &SpeedMeter,
    rng: &mut ChaCha8Rng,
) -> anyhow::Result<f64> {
    let config = settings::run_config(world, "c51", "paper", &[])?;
    let mut world = config.world.build(ENVS, 1, threads)?;
    let num_actions = world.num_actions() as u8;
    let mut draw_actions = |_| std::array::from_fn(|_| rng.random_range(0..num_actions));
    let actions: Vec<[u8; ENVS]> = (0..STEPS).map(&mut draw_actions).collect();
    let mut frames = vec![0; ENVS * world.frame_shape().bytes()];
    let (mut rewards, mut ends) = ([0.0; ENVS], [StepEnd::Running; ENVS]);
    // A step that starts episodes takes longer than others, so measure the mean.
    let calls = meter.rate_overall(|| {
        for actions in &actions {
            world.step(actions, &mut rewards, &mut ends)?;
            world.observe(&mut frames);
        }
        Ok(())
    })?;
    Ok(calls * (STEPS * ENVS) as f64)
}
