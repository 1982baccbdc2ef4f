//! Frames through an actor's policy, forward only.
//! It takes no action in a world.

use driml_learner::DeviceName;
use driml_model::{Parameters, PolicyNetwork};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    effort::Effort,
    flags::BenchFlags,
    report::{Measurement, named},
    settings,
};

/// Frames that are given to the policy at once.
const BATCHES: [usize; 2] = [32, 256];
/// The two sizes of a frame, by their presets.
const PRESETS: [&str; 2] = ["paper", "paper-observation"];

/// Frames a second in each precision.
pub(super) fn measure(flags: &BenchFlags, effort: &Effort) -> anyhow::Result<Vec<Measurement>> {
    let mut figures = Vec::new();
    for precision in flags.precisions(DeviceName::Cpu) {
        for preset in PRESETS {
            let config = settings::of_run(settings::WORLD, "c51", preset, &[])?;
            let model = config.with_whole_frames()?.model;
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let parameters = Parameters::init(&model, &mut rng, &candle_core::Device::Cpu)?;
            let weights = parameters.to_safetensors(|_| true)?;
            let mut policy = PolicyNetwork::new(&model, &weights, precision)?;
            for batch in BATCHES {
                let mut frames = vec![0; batch * model.frame_len()];
                rng.fill_bytes(&mut frames);
                let mut actions = vec![0; batch];
                let rate = effort.rate_by_median(|| {
                    policy.greedy_actions(&frames, &mut actions)?;
                    Ok(())
                })?;
                let name = format!("{batch} frames of {}x{}x3", model.height, model.width);
                let name = named(&name, precision);
                figures.push(Measurement::found(name, rate * batch as f64, "frames/s"));
            }
        }
    }
    Ok(figures)
}
