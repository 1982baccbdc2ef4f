//! Measures an actor's policy: the forward pass alone.
//! No action is taken in a world.

use driml_learner::DeviceName;
use driml_model::{Parameters, PolicyNetwork};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{report::Bench, settings};

const BATCHES: [usize; 2] = [32, 256];
/// The networks, as [`settings::case`] reads them.
const NETWORKS: &str = "\
64x64x3|c51|paper
104x80x3|c51|paper-observation
64x64x3, impala|c51|paper|model.torso=impala
64x64x3, impala, half width|c51|paper|model.torso=impala|model.channels=[8,16,16]";

pub(super) fn measure(bench: &mut Bench<'_>) -> anyhow::Result<()> {
    for precision in bench.flags.precisions(DeviceName::Cpu) {
        for case in NETWORKS.lines() {
            let (network, config) = settings::case(case)?;
            let model = config.model;
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let parameters = Parameters::init(&model, &mut rng, &candle_core::Device::Cpu)?;
            let weights = parameters.to_safetensors(|_| true)?;
            let mut policy = PolicyNetwork::new(&model, &weights, precision)?;
            for batch in BATCHES {
                let mut frames = vec![0; batch * model.frame_len()];
                rng.fill_bytes(&mut frames);
                let mut actions = vec![0; batch];
                let rate = bench.meter.rate_by_median(|| {
                    policy.greedy_actions(&frames, &mut actions)?;
                    Ok(())
                })?;
                let name = format!("{batch} frames of {network}");
                bench.record(&name, precision, rate * batch as f64, "frames/s");
            }
        }
    }
    Ok(())
}
